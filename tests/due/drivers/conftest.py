"""Small disks, and what fills them."""

import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.requirements import missing

Disk = Callable[[int], Path]


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Disk]:
    """Makes a file system of so many MiB."""
    if os.geteuid() != 0 or shutil.which("mount") is None:
        missing("mounting a small disk needs root")
    with ExitStack() as stack:

        def make(size: int) -> Path:
            folder = tmp_path / f"disk{size}"
            folder.mkdir()
            subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}m", "tmpfs", str(folder)], check=True)
            stack.callback(subprocess.run, ["umount", "--lazy", str(folder)], check=True)
            return folder

        yield make


def fill(folder: Path) -> Path:
    """A file that leaves no byte."""
    path = folder / "filler"
    with path.open("wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(4096))
        except OSError:
            return path
