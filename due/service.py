"""Running an app as a process: options, signals, the ready line, ticks, health, an orderly end.

    python -m apps.kitsune.service --updates URL --archive URL --settings FILE.json
                                   [--metrics HOST:PORT] [--log-format console|json]

One JSON line on stdout when the app is ready (with "metrics": "HOST:PORT" where asked for, and what the app's
`ready()` adds), logs on stderr; SIGTERM or SIGINT: `stop()`, flush, offline heartbeat, exit 0.  The process ends with the one that started it (Linux: with the starting thread).
Exit codes: 2 wrong options, 1 a backend or the app failed.
"""

import argparse
import json
import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

import msgspec

from due import logs, metrics
from due.config import Options
from due.drivers.embedded_redis import die_with_parent
from due.engine import Engine
from due.errors import DueError, InvalidOption
from due.messages import CONSUMER, PRODUCER, PUB_ONLY, Capability, Instances, Interest
from due.status_server import StatusServer

log = logging.getLogger("due.service")

TICK_SECONDS = 0.05
_TICKS_PER_HEALTH = 20
HEALTH = "due.health"
"""`due.health.<app>`: the app's and the engine's health, every second, best effort."""

PARENT_VARIABLE = "DUE_PARENT"
"""Environment variable by which a starter may tell its process id: we end where it has ended already."""

S = TypeVar("S")


class Service(Protocol):
    """What `run` drives; all methods are called in the main thread."""

    def start(self) -> None:
        """The engine is initialised: subscribe."""
        ...

    def tick(self) -> None:
        """Called about every 50 ms."""
        ...

    def stop(self) -> None:
        """Write what is still to be written."""
        ...

    def health(self) -> dict[str, Any]:
        """Counters, for people and metrics."""
        ...


@runtime_checkable
class Announcing(Protocol):
    """A service with more to say in its ready line."""

    def ready(self) -> dict[str, str]:
        """Fields of the ready line, such as the address of an API; called after `start`."""
        ...


def run(
    app_id: str,
    service: Callable[[Engine, Any], Service],
    settings: type[Any],
    interests: Iterable[Interest] = (),
    capabilities: Iterable[Capability] = (),
    argv: Sequence[str] | None = None,
    *,
    instances: Instances = "standby",
) -> int:
    """Run one app until a signal ends it; returns the exit code."""
    arguments = _parser(app_id).parse_args(argv)
    logs.set_up(app_id, arguments.log, arguments.log_format)
    # told by whoever starts us, for it may die while we are still importing
    parent = int(os.environ.pop(PARENT_VARIABLE, "0")) or os.getppid()
    if not arguments.stay:
        die_with_parent(signal.SIGTERM)
    status: StatusServer | None = None
    try:
        chosen = read_struct(arguments.settings, settings)
        status = StatusServer(arguments.metrics) if arguments.metrics else None
        engine = Engine(_options(arguments))
        chosen_instances = arguments.instances or instances
        roles = PRODUCER | CONSUMER
        engine.init(app_id, roles, interests=interests, capabilities=capabilities, instances=chosen_instances)
    except (DueError, OSError) as error:
        print(f"{app_id}: {error}", file=sys.stderr)
        if status is not None:
            status.close()
        return 2 if isinstance(error, InvalidOption) else 1
    stopped = _stop_signals()
    if os.getppid() != parent and not arguments.stay:
        stopped.append(signal.SIGTERM)
    try:
        return _Run(app_id, service(engine, chosen), engine, status).drive(stopped)
    finally:
        engine.close()
        if status is not None:
            status.close()


def read_struct(path: str, kind: type[S]) -> S:
    """A JSON file as a settings Struct, all defaults where no file is named; raises `InvalidOption`."""
    try:
        text = Path(path).read_bytes() if path else b"{}"
        return msgspec.json.decode(text, type=kind)
    except OSError as error:
        raise InvalidOption(f"settings file {path}: {error.strerror}") from None
    except msgspec.MsgspecError as error:
        raise InvalidOption(f"settings file {path}: {error}") from None


def _parser(app_id: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog=app_id, description=f"Run the app {app_id}.")
    parser.add_argument("--updates", default="", help="Data Updates URL: redis://, rediss:// or unix://")
    parser.add_argument("--archive", default="", help="Data Archives URL: sqlite:///file.db or mongodb://")
    parser.add_argument("--settings", default="", help="JSON file with the app's settings")
    parser.add_argument("--engine", default="", help="JSON file with options of the DUE engine")
    parser.add_argument("--directory", default="", help="folder for spool and embedded defaults")
    parser.add_argument("--instances", default="", choices=("", "standby", "shared"))
    parser.add_argument("--log", default="info", choices=("debug", "info", "warning", "error"))
    parser.add_argument("--log-format", default="console", choices=("console", "json"))
    parser.add_argument(
        "--metrics",
        default="",
        metavar="HOST:PORT",
        help="serve /metrics (Prometheus) and /healthz there; port 0 takes a free one, the ready line names it",
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
    """The signals that came, as they come."""
    came: list[int] = []
    # no threading.Event: the handler may run while the main thread holds the event's own lock, for ever then
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda got, _frame: came.append(got))
    return came


class _Run:
    """One app from start to stop."""

    def __init__(self, app_id: str, app: Service, engine: Engine, status: StatusServer | None) -> None:
        self._app_id = app_id
        self._app = app
        self._engine = engine
        self._status = status

    def drive(self, stopped: Sequence[int]) -> int:
        """Start, tick until `stopped` has something in it, end; returns the exit code."""
        try:
            self._app.start()
        except (DueError, OSError) as error:
            log.error("could not start: %s", error)  # noqa: TRY400 - one clear line
            return 1
        if self._status is not None:
            self._report()
            self._status.start()
        print(json.dumps(self._ready()), flush=True)
        ticks = 0
        try:
            time.sleep(TICK_SECONDS)
            while not stopped:
                self._app.tick()
                ticks += 1
                if ticks % _TICKS_PER_HEALTH == 0:
                    self._engine.write(f"{HEALTH}.{self._app_id}", self._report(), [PUB_ONLY])
                # a signal wakes nobody here: it is noted, and seen a tick later at the most
                time.sleep(TICK_SECONDS)
        finally:
            self._app.stop()
        return 0

    def _ready(self) -> dict[str, Any]:
        line: dict[str, Any] = {"ready": True, "app": self._app_id, "pid": os.getpid()}
        if self._status is not None:
            line["metrics"] = self._status.address
        if isinstance(self._app, Announcing):
            line |= self._app.ready()
        return line

    def _report(self) -> dict[str, Any]:
        """The app's and the engine's health, as of now; the scraper gets the same."""
        health, engine = self._app.health(), self._engine.health()
        if self._status is not None:
            state = {name: engine[name] for name in ("app", "instance", "phase", "active")}
            self._status.report(metrics.render(self._app_id, engine, health), {**state, "pid": os.getpid()})
        return {"app": health, "engine": engine}
