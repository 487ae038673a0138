"""Learners that shape sand. Runs from a checkout: `python -m train --help`."""
