"""The dashboard as a DUE app: data in, pages out, instructions of people to the firewall.

Callbacks run in the engine's thread and only note what came; pages are served in a thread of their own
and look at the board a few times a second.
"""

import json
import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any
from uuid import uuid4

import due.service
from apps.enforcement import CONFIRMED
from apps.incidents import INCIDENTS, Incident
from apps.messages import Alert, Answer, Confirmation, Decision, Instruction, sender_of
from apps.sonata_adapter.plan_answer import plan_key
from apps.talkers import TALKERS, TopTalkers
from due import NO_WAIT, Capability, Engine, Interest, Item
from due.drivers.query_time import time_limit
from due.errors import DueError, InvalidOption
from sdnator.dashboard.board import ALERTS_KEPT, Board
from sdnator.dashboard.settings import Settings
from sdnator.dashboard.sign_in import Sessions, WeakToken, token_from
from sdnator.errors import BadInput, SdnatorError
from sdnator.rights import sign_in_link
from sdnator.rights.audited_deed import REFUSED, AuditedDeed, MinuteLimit
from sdnator.rights.users import Users

ANSWERS = "network.answer.firewall.dashboard"
INSTRUCTION = "network.instruction.dashboard.firewall"
AUDIT = "network.audit.dashboard.page"
DECISIONS = ("network.block.firewall.*", "network.protect.firewall.*", "network.meter.firewall.*")
CONFIRMATIONS = f"{CONFIRMED}.*.*"
_ALERT = "network.anomaly.kitsune.alert"
_STATE = "network.switch.p4runtime_ctrl"
_TALKERS = f"{TALKERS}.kitsune.*"

INTERESTS = (
    Interest("network.anomaly.kitsune.score"),
    Interest(_ALERT),
    *(Interest(key) for key in DECISIONS),
    Interest(CONFIRMATIONS),
    Interest(INCIDENTS),
    Interest(f"{_STATE}.*"),
    Interest("due.health.*"),
    Interest(ANSWERS),
    Interest(_TALKERS),
)
CAPABILITIES = (
    Capability(INSTRUCTION, delivery="reliable", archive="always"),
    Capability(AUDIT, delivery="reliable", archive="always"),
)

_POLL_SECONDS = 2.0
_REFUSALS = 30
"""Refused sign-ins of a minute that are kept in the archive: guessing must not fill it."""
_NAME_CHARACTERS = 64
_WAITING = 64
_EXPLAINED = 16
_DECISIONS, _CONFIRMATIONS, _REPORTS = 2_000, 5_000, 5_000
"""Archived items that are read at the start, the newest: of each key of decisions, of what enforcers said of those in
force, and of incidents."""
_QUERY_SECONDS = 10.0
"""For a search, and for reading all of the history at the start."""
_DAY_NS = 86_400 * 10**9
_COORDINATOR_TOKEN = "DUE_COORDINATOR_TOKEN"  # noqa: S105 - a variable's name

log = logging.getLogger(__name__)


class DashboardService:
    """Fills the board; `instruct` and `find` are what pages ask for."""

    def __init__(self, engine: Engine, settings: Settings) -> None:
        self.settings = settings
        self.board = Board(settings.history_s)
        self.sessions = Sessions("")
        self._engine = engine
        self._waiting: dict[str, Callable[[Answer], None]] = {}
        self._misunderstood = 0
        self._refusals = MinuteLimit(_REFUSALS)
        self._unnoted = 0
        """Refused sign-ins that are not in the audit trail."""
        self._explained = 0
        """Pages that hear what is done for a key."""
        self._stopping = threading.Event()
        self._threads: list[threading.Thread] = []
        self._socket: socket.socket | None = None
        self._stop_server: Callable[[], None] = lambda: None

    def start(self) -> None:
        """Subscribe, listen, and serve as soon as the page's library is loaded.  Raises InvalidOption."""
        try:
            self.sessions = self._sessions()
        except (WeakToken, OSError) as error:
            raise InvalidOption(f"dashboard.token_file: {error}") from None
        except BadInput as error:
            raise InvalidOption(str(error)) from None
        self._socket = listening(self.settings.host, self.settings.port)
        self._subscribe()
        self._take_up_history()
        for work, name in ((self._serve, "pages"), (self._poll, "coordinator")):
            thread = threading.Thread(target=work, name=f"dashboard {name}", daemon=True)
            thread.start()
            self._threads.append(thread)

    def _sessions(self) -> Sessions:
        token, state = token_from(self.settings.token_file, os.environ), self.settings.state
        return (
            Sessions(token, Users(Path(state)), Path(state) / sign_in_link.FILE) if state else Sessions(token)
        )

    def ready(self) -> dict[str, Any]:
        """For the ready line."""
        return {"dashboard": self.url}

    @property
    def url(self) -> str:
        """Of the page."""
        if self._socket is None:
            return ""
        host, port = self._socket.getsockname()[:2]
        shown = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)  # noqa: S104
        return f"http://{shown}:{port}/"

    def tick(self) -> None:
        """All work is done in threads of its own."""

    def stop(self) -> None:
        """Close the pages."""
        self._stopping.set()
        self._stop_server()
        for thread in self._threads:
            thread.join(5)

    def health(self) -> dict[str, Any]:
        """Counters for people."""
        with self.board.lock:
            return {
                **self.board.counts,
                "misunderstood": self._misunderstood,
                "degraded": bool(self.board.degraded),
            }

    def _subscribe(self) -> None:
        observe = self._engine.observe
        board = self.board
        handlers: dict[str, Callable[[Item], None]] = {
            "network.anomaly.kitsune.score": lambda item: board.score(item.value, time.time()),
            _ALERT: lambda item: board.alert(Alert.from_value(item.value)),
            **dict.fromkeys(DECISIONS, lambda item: board.decide([Decision.from_value(item.value)])),
            CONFIRMATIONS: lambda item: board.confirm(Confirmation.from_value(item.value), sender_of(item)),
            INCIDENTS: lambda item: board.incident(Incident.from_value(item.value)),
            f"{_STATE}.*": lambda item: board.switch(item.value, time.monotonic()),
            "due.health.*": lambda item: board.healthy(item.app_id, item.value, time.monotonic()),
            ANSWERS: self._on_answer,
            _TALKERS: lambda item: board.talks(TopTalkers.from_value(item.value), time.monotonic()),
        }
        for key, handler in handlers.items():
            observe(key).subscribe(self._tolerant(handler))

    def _tolerant(self, handler: Callable[[Item], None]) -> Callable[[Item], None]:
        """A value that is not understood is counted: a viewer must not have reliable items sent again."""

        def handle(item: Item) -> None:
            try:
                handler(item)
            except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError) as error:
                self._misunderstood += 1
                log.warning("%s: not understood: %s", item.key, error)

        return handle

    def _take_up_history(self) -> None:
        """Decisions in force, what enforcers said of them, and the last alerts and incidents, from the archive."""
        board, since = self.board, {"$gte": time.time_ns() - _DAY_NS}
        try:
            with time_limit(_QUERY_SECONDS):
                self._take_up(
                    DECISIONS, lambda item: board.decide([Decision.from_value(item.value)]), _DECISIONS
                )
                if standing := [decision.id for decision in board.standing()]:
                    self._take_up(
                        [{"dataKey": CONFIRMATIONS, "value.id": {"$in": standing}}],
                        lambda item: board.confirm(Confirmation.from_value(item.value), sender_of(item)),
                        _CONFIRMATIONS,
                    )
                self._take_up(
                    [{"dataKey": _ALERT, "timestamp": since}],
                    lambda item: board.alert(Alert.from_value(item.value)),
                    ALERTS_KEPT,
                )
                self._take_up(
                    [{"dataKey": INCIDENTS, "timestamp": since}],
                    lambda item: board.incident(Incident.from_value(item.value)),
                    _REPORTS,
                )
        except DueError as error:
            log.warning("Data Archives do not answer, not all history is shown: %s", error)

    def _take_up(
        self, queries: Iterable[str | Mapping[str, Any]], handler: Callable[[Item], None], limit: int
    ) -> None:
        """Handle the newest archived items of each query, the oldest of all of them first."""
        items = [item for query in queries for item in self._engine.get(query, limit=limit)]
        handle = self._tolerant(handler)
        for item in sorted(items, key=lambda one: (one.timestamp, one.sequence)):
            handle(item)

    def _take_up_switches(self) -> None:
        """What switches said before anybody knew of our interest: then it went to the archive alone."""
        now = time.time_ns()
        for place in self.settings.switches:
            if self.board.knows_switch(place.name):
                continue
            try:
                last, _ = self.find(f"{_STATE}.{place.name}", now - _DAY_NS, now, 1)
            except DueError as error:
                log.warning("Data Archives do not answer, switch %s is not shown: %s", place.name, error)
                return
            for item in last:
                self.board.switch(item.value)

    def note(self, who: str, deed: str, source: str) -> None:
        """Keep in the archive what somebody did; refusals beyond the limit of a minute are counted only."""
        if deed == REFUSED and not self._refusals.pass_on(time.monotonic()):
            self._unnoted += 1
            return
        # the name was chosen by a client that was refused
        name = "".join(one if one.isprintable() else "?" for one in who[:_NAME_CHARACTERS])
        log.info("%s: %s, from %s", name, deed, source or "the page")
        deed_done = AuditedDeed(who=name, deed=deed, source=source, unnoted=self._unnoted)
        try:
            self._engine.write(AUDIT, deed_done.to_value(), [NO_WAIT])
        except DueError as error:
            log.warning("not in the audit trail: %s: %s: %s", name, deed, error)

    def instruct(self, verb: Any, subject: str, who: str, answered: Callable[[Answer], None]) -> str:
        """Tell the firewall; `answered` is called in the engine's thread.  Returns the instruction's id."""
        instruction = Instruction(
            id=uuid4().hex[:12], verb=verb, subject=subject, reason=f"by {who} on the dashboard"
        )
        while len(self._waiting) >= _WAITING:
            self._waiting.pop(next(iter(self._waiting)))
        self._waiting[instruction.id] = answered
        self._engine.write(INSTRUCTION, instruction.to_value(), [NO_WAIT])
        self.note(who, f"{verb} {subject}", "")
        return instruction.id

    def forget(self, instruction: str) -> None:
        """Nobody waits for this answer any more."""
        self._waiting.pop(instruction, None)

    def _on_answer(self, item: Item) -> None:
        answer = Answer.from_value(item.value)
        waiting = self._waiting.pop(answer.id, None)
        if waiting is not None:
            waiting(answer)

    def find(self, key: str, start: int, end: int, limit: int) -> tuple[list[Item], bool]:
        """The latest items of the archive, and whether there are older ones; times in ns.  Raises DueError."""
        from sdnator.northbound import latest

        with time_limit(_QUERY_SECONDS):
            return latest(self._engine.get, {"dataKey": key}, start, end, limit)

    def explain(self, key: str, told: Callable[[Mapping[str, Any]], None]) -> Callable[[], None]:
        """Hear what the Sonata adapter does for a key, in the engine's thread, until what is returned is called."""
        if self._explained >= _EXPLAINED:
            raise BadInput(f"{_EXPLAINED} pages are already asking; close one")
        handler = self._tolerant(lambda item: told(item.value))
        subscriptions = [self._engine.observe(plan_key(key)).subscribe(handler)]
        self._explained += 1

        def end() -> None:
            while subscriptions:
                subscriptions.pop().dispose()
                self._explained -= 1

        return end

    def _poll(self) -> None:
        from sdnator.northbound import ask, with_token, without_user

        while not self._stopping.wait(_POLL_SECONDS if self.board.versions["apps"] else 0.2):
            self.board.supervised(_health_of_parts(self.settings.run_file))
            try:
                told = Path(self.settings.coordinator_file).read_text(encoding="utf-8").strip()
                url = with_token(told, os.environ.get(_COORDINATOR_TOKEN, ""))
                apps, instances, flow = (ask(url, path) for path in ("/apps", "/instances", "/flow"))
            except (OSError, ValueError, SdnatorError) as error:
                self.board.uncoordinated(str(error))
                continue
            try:
                self.board.coordinated(apps, instances, flow, time.monotonic())
            except (ValueError, TypeError, LookupError, AttributeError) as error:
                self.board.uncoordinated(
                    f"{without_user(url)} does not answer as a Coordinator does: {error!r}"
                )
            self._take_up_switches()

    def _serve(self) -> None:
        from sdnator.dashboard.server import serve

        assert self._socket is not None  # noqa: S101 - opened by start
        try:
            serve(self, self._socket, self._server_started)
        except Exception:
            # a thread's end is silent, and a dashboard without pages is none
            log.exception("the pages cannot be served")
            os._exit(1)

    def _server_started(self, stop: Callable[[], None]) -> None:
        self._stop_server = stop


def _health_of_parts(run_file: str) -> dict[str, Any]:
    """What `sdnator up` has written of its parts; empty where there is nothing to read."""
    try:
        found = json.loads(Path(run_file).read_bytes())["health"] if run_file else {}
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def listening(host: str, port: int) -> socket.socket:
    """A socket that listens; where the port is taken, on a free one.  Raises OSError."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OSError as error:
        if not port:
            raise
        log.warning("port %d: %s; using a free one", port, error.strerror)
        return socket.create_server((host, 0), family=family)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the dashboard until it is told to stop."""
    return due.service.run("dashboard", DashboardService, Settings, INTERESTS, CAPABILITIES, argv)
