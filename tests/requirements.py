"""What a test may need of its machine, and what happens where that is missing.

On a user's machine the test is skipped with the reason; with CI=true it fails, because there a
missing part is a defect of the set-up.
"""

import os
import shutil
import subprocess
from pathlib import Path
from typing import NoReturn

import pytest

_ROOT = Path(__file__).resolve().parent.parent
IN_CI = os.environ.get("CI", "").lower() == "true"


def missing(reason: str) -> NoReturn:
    """Fail in CI, skip elsewhere."""
    if IN_CI:
        pytest.fail(f"{reason} (CI must provide it)")
    pytest.skip(reason)


def shared_data(name: str) -> Path:
    """A file of the test data, `SDNATOR_TEST_DATA` or `../shared/data` beside the checkout."""
    folder = Path(os.environ.get("SDNATOR_TEST_DATA", _ROOT.parent / "shared" / "data"))
    path = folder / name
    if not path.exists():
        missing(f"test data {name} not found in {folder}; set SDNATOR_TEST_DATA to the folder that holds it")
    return path


def require_program(name: str) -> str:
    """Path of a program that CI installs."""
    found = shutil.which(name)
    if found is None:
        missing(f"program {name} is not installed")
    return found


def optional_program(name: str) -> str:
    """Path of a program that CI does not install; its tests are skipped wherever it is missing."""
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"program {name} is not installed (CI does without it)")
    return found


def require_root() -> None:
    """Network namespaces and raw sockets need root."""
    if os.geteuid() != 0:
        missing("needs root")


def require_netns() -> None:
    """The machine can make network namespaces and veth pairs."""
    require_root()
    ip = require_program("ip")
    name = f"sdnator-probe-{os.getpid()}"
    made = subprocess.run([ip, "netns", "add", name], capture_output=True, text=True, check=False)
    if made.returncode != 0:
        missing(f"network namespaces are not available: {made.stderr.strip()}")
    subprocess.run([ip, "netns", "delete", name], check=True)
