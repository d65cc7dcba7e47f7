"""An installed app as a process: `python -m sdnator.run_app APP --engine FILE --settings FILE …`.

Arguments after the app's id are passed to `due.service.run`.
"""

import sys
from collections.abc import Sequence

from sdnator.app_catalogue import of
from sdnator.errors import SdnatorError


def main(argv: Sequence[str]) -> int:
    """Run the app that the first argument names; returns the exit code."""
    if not argv:
        print("usage: python -m sdnator.run_app APP [OPTION …]", file=sys.stderr)
        return 2
    try:
        return of(argv[0]).main(argv[1:])
    except SdnatorError as error:
        print(f"{argv[0]}: {error}", file=sys.stderr)
        return error.exit_code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
