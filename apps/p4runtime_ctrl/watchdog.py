"""Removes port forwarding from the switches of a controller that was killed (`fail = closed`).  I/O.

    controller ── settings, later "bye" ──► standard input of this process
         │ killed: the input ends without "bye"
         ▼
    the watchdog waits long enough for a backup controller to become primary, then asks to be primary with
    the lowest rank; if no other controller is primary it removes port forwarding, and ends.

It is a separate process in its own session, so that what ends the controller does not end it.  If the switch
cannot be reached, port forwarding stays.
"""

import logging
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path
from typing import Any, Final

import msgspec

from apps.p4runtime_ctrl.errors import ControllerError, SwitchError
from apps.p4runtime_ctrl.settings import Settings, SwitchSettings
from apps.p4runtime_ctrl.southbound.connection import Connection
from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
from apps.p4runtime_ctrl.southbound.session import CompiledProgram, P4RuntimeSession, address_of
from apps.p4runtime_ctrl.state.desired_state import deletion
from apps.p4runtime_ctrl.state.port_forwarding import wires_of

_BYE: Final = b"bye\n"
_PATIENCE_S: Final = 1.5
"""Seconds; a backup controller replaces a lost primary in less time."""
_UNDER_CONTROL_S: Final = 3.0
_GIVE_UP_S: Final = 60.0
_DISMISS_S: Final = 5.0
_LOG = logging.getLogger(__name__)


class FailClosedWatchdog:
    """The controller's side: `start`, `keep` at intervals, `dismiss`."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._needed = bool(_closed(settings))
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def watches(self) -> bool:
        """Whether the watchdog process runs."""
        return self._process is not None and self._process.poll() is None

    def start(self) -> None:
        """Start the process, if a switch is to fail closed."""
        if not self._needed:
            return
        self._process = subprocess.Popen(
            [sys.executable, "-m", "apps.p4runtime_ctrl.watchdog"],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            start_new_session=True,
        )
        self._say(msgspec.json.encode(self._settings) + b"\n")

    def keep(self) -> None:
        """Restart it if it has ended."""
        if self._process is not None and self._process.poll() is not None:
            _LOG.error("the watchdog has ended with code %s; it is restarted", self._process.returncode)
            self._close()
            self.start()

    def dismiss(self) -> None:
        """The controller ends normally, so the watchdog does, too."""
        if self._process is not None:
            self._say(_BYE)
            self._close()
            try:
                self._process.wait(_DISMISS_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()

    def _say(self, line: bytes) -> None:
        assert self._process is not None  # noqa: S101 - called when it runs
        assert self._process.stdin is not None  # noqa: S101 - opened as a pipe
        try:
            self._process.stdin.write(line)
            self._process.stdin.flush()
        except BrokenPipeError:
            _LOG.error("the watchdog does not read its input")

    def _close(self) -> None:
        assert self._process is not None  # noqa: S101 - called when it runs
        assert self._process.stdin is not None  # noqa: S101 - opened as a pipe
        self._process.stdin.close()


class Closer:
    """Removes port forwarding from one switch, unless a controller is primary."""

    def __init__(self, settings: Settings, mine: SwitchSettings, program: ProgramInfo) -> None:
        self._name = mine.name
        self._wires = wires_of(program, mine.forward)
        self.done = threading.Event()
        self._backup_since: float | None = None
        pipeline = CompiledProgram(b"", program.message)
        self._connection = Connection(
            address_of(settings, mine), pipeline, self, active=False, patience_s=_PATIENCE_S
        )
        self._connection.open()

    def look(self) -> None:
        """Seconds after which another primary is taken to be in control."""
        since = self._backup_since
        if since is not None and time.monotonic() - since > _UNDER_CONTROL_S:
            _LOG.warning("%s: another controller is primary; port forwarding stays", self._name)
            self.done.set()

    def close(self) -> None:
        self._connection.close()

    def became_primary(self, session: P4RuntimeSession) -> None:
        self._backup_since = None
        try:
            session.write([deletion(entry) for entry in self._wires])
        except SwitchError as error:
            _LOG.error("%s: port forwarding could not be removed: %s", self._name, error)
            return
        _LOG.warning("%s: its controller was killed: fail closed, port forwarding is removed", self._name)
        self.done.set()

    def became_backup(self) -> None:
        self._backup_since = time.monotonic()

    def lost(self, cause: str) -> None:
        self._backup_since = None
        _LOG.info("%s: %s", self._name, cause)

    def packets(self, messages: list[Any]) -> None: ...
    def digests(self, lists: list[Any]) -> None: ...
    def other(self, message: Any) -> None: ...


def _closed(settings: Settings) -> list[SwitchSettings]:
    return [each for each in settings.switches if each.fail == "closed" and each.forward]


def close_all(settings: Settings, program: ProgramInfo, give_up_s: float = _GIVE_UP_S) -> bool:
    """Close the switches that are to fail closed; False if one could not be reached in time."""
    closers = [Closer(settings, mine, program) for mine in _closed(settings)]
    deadline = time.monotonic() + give_up_s
    while not all(closer.done.wait(0.05) for closer in closers) and time.monotonic() < deadline:
        for closer in closers:
            closer.look()
    for closer in closers:
        closer.close()
    return all(closer.done.is_set() for closer in closers)


def main() -> int:
    logging.basicConfig(format="%(asctime)s watchdog %(levelname)s %(message)s")
    stdin = sys.stdin.buffer
    settings = msgspec.json.decode(stdin.readline(), type=Settings)
    try:
        program = ProgramInfo.from_text(Path(settings.p4info).read_text(encoding="utf-8"))
    except (OSError, ControllerError) as error:
        _LOG.error("%s", error)
        return 2
    words = b"".join(iter(partial(stdin.read, 64), b""))
    if words == _BYE:
        return 0
    return 0 if close_all(settings, program) else 1


if __name__ == "__main__":
    sys.exit(main())
