"""Random and spoilt input to every entrance of the package: `python -m tests.fuzz`."""
