"""`python -m sdnator.dashboard`: the same options as every app."""

import sys

from sdnator.dashboard.service import main

if __name__ == "__main__":
    sys.exit(main())
