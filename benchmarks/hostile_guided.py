"""The worker process with a product whose branches are counted, for inputs guided by coverage (atheris).

python -m benchmarks.hostile_guided MODULE …     as benchmarks.hostile_worker
"""

import importlib
import os
import sys

import atheris

_PRODUCT = ("due", "coordinator", "apps", "dataplane", "sdnator")


def main() -> None:
    """Everything of the product must be imported here first: only then is it instrumented."""
    words, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 2)  # a line for each module
    try:
        with atheris.instrument_imports(include=list(_PRODUCT)):
            worker = importlib.import_module("benchmarks.hostile_worker")
            for module in sys.argv[1:]:
                importlib.import_module(module)
    finally:
        os.dup2(words, 2)
    worker.main(sys.argv[1:])


if __name__ == "__main__":
    main()
