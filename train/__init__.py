"""Learners that shape sand. They run from a checkout of the repository: `python -m train --help`."""
