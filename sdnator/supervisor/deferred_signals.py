"""Defers stop signals while a process is started and recorded, so that every started process is stopped."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextmanager
def deferred_signals() -> Iterator[None]:
    """SIGINT, SIGTERM and SIGHUP that come inside reach their handlers on leaving, in the order they came.

    A handler that raises does so between any two steps of the interpreter, also between the fork of a child
    and the assignment that makes it known.  The handlers wait, not the kernel: a blocked signal would stay
    blocked in the child.  Threads other than the main one run no handlers, and are left as they are.

        with held_signals():
            children.append(subprocess.Popen(command))
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []

    def note(number: int, _: FrameType | None) -> None:
        came.append(number)

    # ignored ones (nohup) and the kernel's default action stay: nothing of ours runs on them
    before = {one: handler for one in _STOPS if callable(handler := signal.getsignal(one))}
    for one in before:
        signal.signal(one, note)
    try:
        yield
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)
        for number in came:
            signal.raise_signal(number)
