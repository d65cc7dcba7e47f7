"""The folder of the test data: `--data FOLDER`, else SDNATOR_TEST_DATA, else `../shared/data` beside the checkout."""

import argparse
import os
from pathlib import Path

VARIABLE = "SDNATOR_TEST_DATA"
DEFAULT = Path(__file__).resolve().parents[2] / "shared" / "data"


def add_data_option(parser: argparse.ArgumentParser) -> None:
    """Add `--data`, a Path with a default, to the options of a benchmark."""
    parser.add_argument(
        "--data",
        type=Path,
        metavar="FOLDER",
        default=Path(os.environ.get(VARIABLE, DEFAULT)),
        help=f"folder of the test data; default: {VARIABLE}, else %(default)s",
    )


def data_file(folder: Path, name: str) -> Path:
    """A file of the test data.  Ends the benchmark with a message where it is missing."""
    path = folder / name
    if not path.exists():
        raise SystemExit(
            f"benchmarks: test data {name} not found in {folder}; give its folder with --data or {VARIABLE}"
        )
    return path
