"""Running an app as a process: options, signals, the ready line, ticks, health and an orderly shutdown.

    python -m apps.kitsune.service --updates URL --archive URL --settings FILE.json
                                   [--metrics HOST:PORT] [--log-format console|json] [--heartbeat-fd N]

The app prints one JSON line on standard output when it is ready, with "metrics": "HOST:PORT" if requested,
and with the fields that its `ready()` adds. Logs go to standard error, and so does what the app prints after
that line, since nobody need be reading the pipe any more. SIGTERM or SIGINT calls `stop()`, flushes, sends
an offline heartbeat and exits with 0. The process ends when its parent ends (on Linux: the thread that
started it).

If a thread of the engine dies, the process ends: otherwise its work would silently stop. About once a second
the main loop writes a byte to `--heartbeat-fd`, but only if the dispatcher and the heartbeat thread have
answered since the last one. A supervisor that receives no bytes may assume that the process hangs.

Exit codes: 2 wrong options, 1 a backend or the app failed, or a thread died.
"""

import argparse
import gc
import json
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol, TypeVar, cast, get_args, runtime_checkable

import msgspec

from due import logs, metrics
from due.config import Options
from due.drivers.embedded_redis import die_with_parent
from due.engine import Engine
from due.errors import DueError, EngineFailed, InvalidOption
from due.heap import HeapTrim
from due.liveness import HeartbeatPipe, Liveness
from due.messages import CONSUMER, PRODUCER, PUB_ONLY, Capability, Instances, Interest
from due.status_server import StatusServer, metrics_token

log = logging.getLogger("due.service")

TICK_SECONDS = 0.05
_HEALTH_SECONDS = 1.0
_LAST_SECONDS = 15.0
"""How long a process with a dead thread may take to end in order."""
_SETTINGS_BYTES = 16 << 20
HEALTH = "due.health"
"""`due.health.<app>`: the app's and the engine's health, every second, best effort."""

PARENT_VARIABLE = "DUE_PARENT"
"""Environment variable by which a starter may tell its process id: we end where it has ended already."""

S = TypeVar("S")


class Service(Protocol):
    """The methods that `run` calls, all of them in the main thread."""

    def start(self) -> None:
        """Subscribe; the engine is initialised."""
        ...

    def tick(self) -> None:
        """Do periodic work; called about every 50 ms."""
        ...

    def stop(self) -> None:
        """Write what is still pending; called once, before the engine closes."""
        ...

    def health(self) -> dict[str, Any]:
        """Counters of the app.

        Returns:
            Name to plain value; shown by `sdnator status` and exported to Prometheus.
        """
        ...


@runtime_checkable
class Announcing(Protocol):
    """A service that adds fields to its ready line."""

    def ready(self) -> dict[str, str]:
        """Fields for the ready line; called after `start`.

        Returns:
            Name to value, for instance the address of an API.
        """
        ...


def _status_server(arguments: argparse.Namespace) -> StatusServer:
    return StatusServer(arguments.metrics, metrics_token(arguments.metrics_token))


def run(
    app_id: str,
    service: Callable[[Engine, Any], Service],
    settings: type[Any],
    interests: Iterable[Interest] = (),
    capabilities: Iterable[Capability] = (),
    argv: Sequence[str] | None = None,
    *,
    instances: Instances = "standby",
    shards: Callable[[Any], Iterable[str]] | None = None,
) -> int:
    """Run one app until a signal ends it.

    Args:
        app_id: name of the app.
        service: makes the service from the initialised engine and the settings.
        settings: a msgspec Struct with a default for every field; read from the file given with --settings.
        interests: declared to the Coordinator.
        capabilities: declared to the Coordinator.
        argv: command line without the program's name; None takes that of the process.
        instances: "standby", "shared" or "sharded", unless --instances, or a field `instances` of the settings, says
            otherwise; the two must not contradict each other.
        shards: from the settings the names of what the instances divide if they are "sharded"; None: reliable paths.

    Returns:
        The exit code: 0, 1 or 2 as above.
    """
    arguments = _parser(app_id).parse_args(argv)
    logs.set_up(app_id, arguments.log, arguments.log_format)
    # told by our parent, which may die while we are still importing
    parent = int(os.environ.pop(PARENT_VARIABLE, "0")) or os.getppid()
    if not arguments.stay:
        die_with_parent(signal.SIGTERM)
    status: StatusServer | None = None
    try:
        heartbeat = HeartbeatPipe(arguments.heartbeat_fd) if arguments.heartbeat_fd >= 0 else None
        chosen = read_struct(arguments.settings, settings)
        status = _status_server(arguments) if arguments.metrics else None
        engine = Engine(_options(arguments))
        engine.when_failed = _end_soon
        chosen_instances = _instances(arguments.instances, getattr(chosen, "instances", None)) or instances
        roles = PRODUCER | CONSUMER
        named = shards(chosen) if shards is not None and chosen_instances == "sharded" else ()
        engine.init(
            app_id,
            roles,
            interests=interests,
            capabilities=capabilities,
            instances=chosen_instances,
            shards=named,
        )
    except (DueError, OSError) as error:
        print(f"{app_id}: {logs.without_passwords(str(error))}", file=sys.stderr)
        if status is not None:
            status.close()
        return 2 if isinstance(error, InvalidOption) else 1
    stopped = _stop_signals()
    if os.getppid() != parent and not arguments.stay:
        stopped.append(signal.SIGTERM)
    try:
        return _Run(app_id, service(engine, chosen), engine, status, heartbeat).drive(stopped)
    finally:
        engine.close()
        if status is not None:
            status.close()


def _instances(given: str, chosen: Instances | None) -> Instances | None:
    """How instances work together: as an app's settings say, which has a part of its own for each way; else as given."""
    if given and chosen is not None and given != chosen:
        raise InvalidOption(
            f"--instances {given}: the settings say instances = {chosen!r}; change them there"
        )
    return chosen or (cast("Instances", given) if given else None)


def read_struct(path: str, kind: type[S]) -> S:
    """Read a JSON file as a settings Struct.

    Args:
        path: the file; empty gives all defaults.
        kind: a msgspec Struct.

    Returns:
        The settings.

    Raises:
        InvalidOption: the file cannot be read or is not valid; the message names the field.
    """
    try:
        text = _read(path) if path else b"{}"
        return msgspec.json.decode(text, type=kind)
    except OSError as error:
        raise InvalidOption(f"settings file {path}: {error.strerror}") from None
    except (
        msgspec.MsgspecError,
        ValueError,
        RecursionError,
    ) as error:  # text that is not UTF-8, or is nested deeply
        raise InvalidOption(f"settings file {path}: {error}") from None


def _read(path: str) -> bytes:
    with Path(path).open("rb") as file:
        text = file.read(_SETTINGS_BYTES + 1)
    if len(text) > _SETTINGS_BYTES:
        raise InvalidOption(f"settings file {path}: over {_SETTINGS_BYTES} bytes")
    return text


def _parser(app_id: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog=app_id, description=f"Run the app {app_id}.")
    parser.add_argument(
        "--updates",
        default="",
        help="Data Updates URL: redis://, rediss://, redis+sentinel://, unix:// or kafka://",
    )
    parser.add_argument("--archive", default="", help="Data Archives URL: sqlite:///file.db or mongodb://")
    parser.add_argument("--settings", default="", help="JSON file with the app's settings")
    parser.add_argument("--engine", default="", help="JSON file with options of the DUE engine")
    parser.add_argument("--directory", default="", help="folder for spool and embedded defaults")
    parser.add_argument("--instances", default="", choices=("", *get_args(Instances)))
    parser.add_argument("--log", default="info", choices=("debug", "info", "warning", "error"))
    parser.add_argument("--log-format", default="console", choices=("console", "json"))
    parser.add_argument(
        "--metrics",
        default="",
        metavar="HOST:PORT",
        help="serve /metrics (Prometheus) and /healthz there; port 0 takes a free one, the ready line names it",
    )
    parser.add_argument(
        "--metrics-token",
        default="",
        metavar="FILE",
        help="what requests for /metrics bring as Authorization: Bearer …",
    )
    parser.add_argument(
        "--heartbeat-fd",
        type=int,
        default=-1,
        metavar="N",
        help="an inherited descriptor: a byte is written to it about every second while all threads answer",
    )
    parser.add_argument("--stay", action="store_true", help="do not end with the parent process")
    return parser


def _options(arguments: argparse.Namespace) -> Options:
    options = read_struct(arguments.engine, Options)
    given = {
        name: value for name in ("updates", "archive", "directory") if (value := getattr(arguments, name))
    }
    return msgspec.structs.replace(options, **given)


def _stop_signals() -> list[int]:
    """A list to which each stop signal is appended as it arrives."""
    came: list[int] = []
    # no threading.Event: the handler may run while the main thread holds the event's own lock, for ever then
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda got, _frame: came.append(got))
    return came


class _Run:
    """One app from start to stop."""

    def __init__(
        self,
        app_id: str,
        app: Service,
        engine: Engine,
        status: StatusServer | None,
        heartbeat: HeartbeatPipe | None,
    ) -> None:
        self._app_id = app_id
        self._app = app
        self._engine = engine
        self._status = status
        self._heartbeat = heartbeat

    def drive(self, stopped: Sequence[int]) -> int:
        """Start, tick until `stopped` has something in it, end; returns the exit code."""
        try:
            self._app.start()
        except (DueError, OSError) as error:
            log.error("could not start: %s", error)  # noqa: TRY400 - one clear line
            return 1
        liveness = self._engine.liveness
        if self._status is not None:
            self._report()
            self._status.liveness = liveness.state
            self._status.start()
        # modules and what was restored stay: scanning them again and again took a twentieth of all CPU of a replay
        gc.freeze()
        print(json.dumps(self._ready()), flush=True)
        with suppress(OSError):  # without a standard error
            # our starter reads no further: what the app prints would fill the pipe, and then block it for ever
            os.dup2(2, 1)
        try:
            self._go_round(stopped, liveness)
        except EngineFailed as error:
            return self._failed(error)
        finally:
            if self._engine.failed is None:
                self._app.stop()
        return 0

    def _go_round(self, stopped: Sequence[int], liveness: Liveness) -> None:
        health_at = 0.0
        heap = HeapTrim(time.monotonic())
        while not stopped:
            # a signal wakes nobody here: it is noted, and seen a tick later at the most
            time.sleep(TICK_SECONDS)
            self._app.tick()
            now = time.monotonic()
            heap.tick(now)
            if now >= health_at:
                health_at = now + _HEALTH_SECONDS
                self._engine.tend()
                self._engine.write(f"{HEALTH}.{self._app_id}", self._report(), [PUB_ONLY])
                if liveness.beat() and self._heartbeat is not None:
                    self._heartbeat.beat()

    def _failed(self, error: EngineFailed) -> int:
        """A thread has died: end with code 1, so that the supervisor restarts the app."""
        log.critical("%s ends: %s", self._app_id, error)
        return 1

    def _ready(self) -> dict[str, Any]:
        line: dict[str, Any] = {"ready": True, "app": self._app_id, "pid": os.getpid()}
        if self._status is not None:
            line["metrics"] = self._status.address
        if isinstance(self._app, Announcing):
            line |= self._app.ready()
        return line

    def _report(self) -> dict[str, Any]:
        """Health of the app and the engine; also handed to the metrics endpoint."""
        health, engine = self._app.health(), self._engine.health()
        if self._status is not None:
            state = {name: engine[name] for name in ("app", "instance", "phase", "active")}
            self._status.report(metrics.render(self._app_id, engine, health), {**state, "pid": os.getpid()})
        return {"app": health, "engine": engine}


def _end_soon() -> None:
    """End the process if the main thread does not within 15 s: it may be waiting for the dead thread."""
    last = threading.Timer(_LAST_SECONDS, os._exit, (1,))
    last.daemon = True
    last.start()
