"""Working in another network namespace for a while.  Linux; needs root."""

import ctypes
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from sdnator.errors import BadInput

_CLONE_NEWNET: Final = 0x4000_0000


@contextmanager
def inside(namespace: str) -> Iterator[None]:
    """Sockets made and children started within, by this thread, live in the namespace.

    Args:
        namespace: name, as `ip netns` shows it.

    Raises:
        BadInput: this process may not enter it.
    """
    home = os.open(f"/proc/self/task/{threading.get_native_id()}/ns/net", os.O_RDONLY)
    try:
        there = os.open(Path("/run/netns", namespace), os.O_RDONLY)
        try:
            _enter(there)
        finally:
            os.close(there)
        yield
    finally:
        _enter(home)
        os.close(home)


def _enter(descriptor: int) -> None:
    library = ctypes.CDLL(None, use_errno=True)  # os.setns came with Python 3.12
    if library.setns(descriptor, _CLONE_NEWNET) != 0:
        raise BadInput(f"entering a network namespace: {os.strerror(ctypes.get_errno())}; run as root")
