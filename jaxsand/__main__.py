"""`python -m jaxsand`, the command line; see `jaxsand.cli.parser`."""

import sys

from jaxsand.cli.parser import main

if __name__ == "__main__":
    sys.exit(main())
