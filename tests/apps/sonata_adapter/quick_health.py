"""The adapter as a program that reports its health ten times a second, so that tests do not wait for the next report."""

import sys

from apps.sonata_adapter.service import main
from due import service

if __name__ == "__main__":
    service._HEALTH_SECONDS = 0.1
    sys.exit(main())
