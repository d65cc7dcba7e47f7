"""A server that speaks MongoDB's protocol, over a real connection: that of $MONGODB_URL, else `nx-27017`.

$MONGODB_URL is mongodb://[USER:PASSWORD@]HOST:PORT/DATABASE without options; tests make collections there, and empty them.
"""

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.requirements import require_program

_STARTED = re.compile(r"Listening on 127\.0\.0\.1:(\d+)\D")

PATIENT = "serverSelectionTimeoutMS=60000"
"""Option for the URL of a server that is there, but may be slow to answer where cores are short."""


@contextmanager
def nx_server(folder: Path, *, db: str = "memory", port: int = 0) -> Iterator[str]:
    """URL of a fresh server on a free loopback port, stopped at the end.

    It takes one server per host unless each has a pid file of its own.
    """
    program = Path(sys.executable).with_name("nx-27017")
    command = str(program) if program.exists() else require_program("nx-27017")
    log = folder / "nx.log"
    log.unlink(missing_ok=True)
    arguments = [
        "--db",
        db,
        "--port",
        str(port),
        "--pid-file",
        str(folder / "nx.pid"),
        "--log-file",
        str(log),
    ]
    process = subprocess.Popen(
        [command, *arguments], cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        yield f"mongodb://127.0.0.1:{_port(log, process)}/due_test"
    finally:
        process.terminate()
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:  # it waits for connections that its clients still hold
            process.kill()
            process.wait()


def _port(log: Path, process: "subprocess.Popen[bytes]") -> int:
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and process.poll() is None:
        found = _STARTED.search(log.read_text() if log.exists() else "")
        if found:
            return int(found[1])
        time.sleep(0.05)
    raise RuntimeError(f"nx-27017 did not start: {log.read_text() if log.exists() else 'no log'}")


@contextmanager
def mongo_server(folder: Path) -> Iterator[str]:
    """$MONGODB_URL, or a server of our own."""
    given = os.environ.get("MONGODB_URL")
    if given:
        yield given
        return
    with nx_server(folder) as url:
        yield url
