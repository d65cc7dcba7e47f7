"""Processes of a benchmark that end with it, however it ends: also when it is killed."""

import multiprocessing
import os
import subprocess
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Any, Final

from due.drivers.embedded_redis import die_with_parent

_END_S: Final = 60
_spawn = multiprocessing.get_context("spawn")


def start(target: Callable[..., None], *arguments: Any) -> tuple[SpawnProcess, Connection]:
    """Run `target(pipe, ...)` in a process of its own; that process and the other end of its pipe."""
    here, there = _spawn.Pipe()
    process = _spawn.Process(target=_run, args=(os.getpid(), target, there, *arguments), daemon=True)
    process.start()
    there.close()
    return process, here


def _run(parent: int, target: Callable[..., None], pipe: Connection, *arguments: Any) -> None:
    die_with_parent()
    if os.getppid() != parent:  # it was gone before we asked to be told
        return
    target(pipe, *arguments)


def end_in_order(process: "subprocess.Popen[Any]") -> None:
    """Ask a program to end, and kill it where it still runs after a minute."""
    process.terminate()
    try:
        process.wait(_END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
