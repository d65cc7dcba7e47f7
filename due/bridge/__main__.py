"""`python -m due.bridge --settings FILE`."""

import sys

from due.bridge.service import main

if __name__ == "__main__":
    sys.exit(main())
