"""Apps of the benchmark that write, read, instruct and listen while the pipeline is broken, and note all of it."""

import random
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from uuid import uuid4

from apps.firewall.evidence.history import decisions_in
from apps.messages import Answer, Confirmation, Instruction
from apps.p4runtime_ctrl.errors import SwitchError
from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
from apps.p4runtime_ctrl.southbound.session import Address, CompiledProgram, P4RuntimeSession
from benchmarks.chaos_checker import Asked, Decided, RunRecord, Word, in_force
from benchmarks.chaos_schedule import JUMP_S
from benchmarks.faults_programs import SPEECH
from due import CONSUMER, PRODUCER, Capability, DueError, Engine, Item, Options
from due.backends import open_archive
from p4rt import INSECURE, P4RuntimeStub
from sdnator import p4_program
from sdnator.blocks.blocks_archive import INSTRUCTION

RELIABLE = "chaos.number.chaos_writer.reliable"
ARCHIVED = "chaos.number.chaos_writer.archived"
_ANSWER = "network.answer.firewall.operator"
_CONFIRMATIONS = "network.confirmation.p4runtime_ctrl.*"
_REPORTS = "network.switch.p4runtime_ctrl.*"
_SCORES = "network.anomaly.kitsune.score"
_COORDINATORS = "due.health.coordinator"
_TABLES = ("ingress.block_src", "ingress.block_mac")
"""The firewall decides by itself, too, and blocks a MAC that has one address only."""
_BLOCK_S = 86_400
_FLUSH_S = 120.0
_BATCH = 50
_WRITE_S = 0.1
_ASK_S = (0.5, 2.0)
_BLOCKS = 20
"""Above so many in force one is lifted."""


class Probes:
    """All engines of the benchmark and their threads.

    Args:
        folder: of their spools: not on the disk that is filled.
        updates: Data Updates, without a relay.
        archive: Data Archives.
        seed: of what is blocked and lifted when.
    """

    def __init__(self, folder: Path, updates: str, archive: str, seed: int) -> None:
        self.record = RunRecord()
        self.errors: list[str] = []
        self.scores = 0
        self.pruned: dict[str, int] = {}
        """Items that the quota has taken, by instance of the Coordinator that deleted them."""
        self.unwanted_instructions = 0
        self._began = time.time()
        self._draw = random.Random(seed)
        self._folder, self._updates, self._archive = folder, updates, archive
        self._ended = threading.Event()
        self._written = 0
        self._asking: str | None = None
        self._blocked: dict[str, None] = {}
        self._lock = threading.Lock()
        self._engines: list[Engine] = []
        self._reader = self._engine("chaos_reader", CONSUMER)
        self._writer = self._engine("chaos_writer", PRODUCER, _reliable(RELIABLE), _reliable(ARCHIVED))
        self._operator = self._engine("operator", PRODUCER | CONSUMER, _reliable(INSTRUCTION))
        self._threads = [threading.Thread(target=each, daemon=True) for each in (self._write, self._instruct)]

    def start(self) -> None:
        """Observe, then write."""
        self._reader.observe(RELIABLE).subscribe(lambda item: self.record.delivered.append(item.value))
        self._reader.observe(SPEECH).subscribe(self._heard)
        self._reader.observe(_SCORES).subscribe(self._scored)
        self._reader.observe(_COORDINATORS).subscribe(self._deleted)
        self._operator.observe(_ANSWER).subscribe(self._answered)
        self._operator.observe(_CONFIRMATIONS).subscribe(self._confirmed)
        self._reader.observe(_REPORTS).subscribe(self._reported)
        for each in self._threads:
            each.start()

    def finish(self) -> None:
        """No more writes; what was written is flushed."""
        self._ended.set()
        for each in self._threads:
            each.join(2 * _FLUSH_S)

    def close(self) -> None:
        for engine in self._engines:
            engine.close()

    def blocked(self) -> list[str]:
        """Addresses whose entry was confirmed, and whose end nobody has asked for."""
        with self._lock:
            return [each for each in self._blocked if each in self.record.installed]

    def settled(self) -> bool:
        """Whether everything that was acknowledged has got where it should."""
        record = self.record
        if len(record.delivered) < record.acknowledged - len(record.unwanted) or len(record.answers) < len(
            record.asked
        ):
            return False
        self.read_decisions()
        wanted = in_force(record.decisions)
        switch = record.entries is not None and not (record.entries ^ wanted) - record.forgotten
        return switch and len({*record.archived, *record.excused}) >= record.archive_acknowledged

    def read_decisions(self) -> None:
        """Decisions and numbers as the archive has them now."""
        with self._noted("reading the archive"):
            found = decisions_in(self._reader.get("network.block.firewall.*"))
            self.record.decisions = [Decided(each.id, each.action, each.target.address) for each in found]
            self.record.archived = [item.value for item in self._reader.get(ARCHIVED)]

    def excuse(self, copy: Path) -> None:
        """A damaged archive was replaced by this copy: what it had beyond the copy is lost."""
        driver = open_archive(f"sqlite://{copy}")
        try:
            numbers = {item.value for item in driver.find({"dataKey": ARCHIVED})}
            found = decisions_in(driver.find({"dataKey": "network.block.firewall.*"}))
        finally:
            driver.close()
        decided = {(each.action, each.target.address) for each in found}
        self.record.excused |= set(range(self._written)) - numbers
        self.record.forgotten |= {
            each.address for each in list(self.record.asked) if (each.verb, each.address) not in decided
        }
        if self._asking is not None:
            self.record.forgotten.add(self._asking)

    def read_entries(self, address: str) -> None:
        """What the switch drops now."""
        self.record.entries = held(address)

    def _engine(self, app: str, role: object, *capabilities: Capability) -> Engine:
        engine = Engine(
            Options(directory=str(self._folder / app), updates=self._updates, archive=self._archive)
        )
        engine.init(app, role, capabilities=capabilities, instances="shared")  # type: ignore[arg-type]
        self._engines.append(engine)
        return engine

    def _noted(self, what: str) -> "suppress":
        return _Noted(what, self.errors)

    def _write(self) -> None:
        written = 0
        while not self._ended.is_set():
            self._written = written + _BATCH
            for number in range(written, self._written):
                if not self._writer.write(RELIABLE, number):
                    self.record.unwanted.add(number)
                self._writer.write(ARCHIVED, number)
            written = self._written
            with self._noted("flush of numbers"):
                self._writer.flush(_FLUSH_S)
                self.record.acknowledged = self.record.archive_acknowledged = written
            time.sleep(_WRITE_S)

    def _instruct(self) -> None:
        asked = 0
        while not self._ended.wait(self._draw.uniform(*_ASK_S)):
            standing = self.blocked()
            lifts = len(standing) > _BLOCKS
            address = standing[0] if lifts else f"{20 + asked % 90}.{asked // 90}.7.9"
            asked += not lifts
            verb = "unblock" if lifts else "block"
            said = Instruction(id=uuid4().hex[:12], verb=verb, subject=address, seconds=_BLOCK_S)  # type: ignore[arg-type]
            if lifts:
                self.record.lifted[address] = time.monotonic()
            self._asking = address
            with self._noted("flush of an instruction"):
                taken = self._operator.write(INSTRUCTION, said.to_value())
                self._operator.flush(_FLUSH_S)
                self._note(Asked(said.id, verb, address, time.time() - self._began), taken=taken)

    def _note(self, asked: Asked, *, taken: bool) -> None:
        if not taken:
            # nobody wanted it at the moment, and `write` has said so: it was promised to nobody
            self.unwanted_instructions += 1
            return
        self.record.asked.append(asked)
        with self._lock:
            if asked.verb == "unblock":
                self._blocked.pop(asked.address, None)
            else:
                self._blocked.setdefault(asked.address)

    def _answered(self, item: Item) -> None:
        answer = Answer.from_value(item.value)
        self.record.answers[answer.id] = self.record.answers.get(answer.id, False) or answer.done

    def _confirmed(self, item: Item) -> None:
        said = Confirmation.from_value(item.value)
        if said.target is not None and said.state in ("installed", "exists") and said.action == "block":
            self.record.installed.setdefault(said.target.address, time.monotonic())

    def _heard(self, item: Item) -> None:
        self.record.words.append(Word(item.timestamp / 1e9 - self._began, item.instance_id))

    def _reported(self, item: Item) -> None:
        if item.value.get("primary"):
            written, came = item.timestamp / 1e9 - self._began, time.time() - self._began
            self.record.reports.append(Word(by_the_right_clock(written, came), item.instance_id))

    def _scored(self, item: Item) -> None:
        self.scores += len(item.value["score"]) if "score" in item.value else 1

    def _deleted(self, item: Item) -> None:
        self.pruned[item.instance_id] = item.value["app"]["retention_deleted"]


class _Noted(suppress):
    """DUE's errors are noted, with what was being done; the probe goes on."""

    def __init__(self, what: str, errors: list[str]) -> None:
        super().__init__(DueError)
        self._what, self._errors = what, errors

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        if error is not None:
            self._errors.append(f"{self._what}: {type(error).__name__}: {error}")
        return bool(super().__exit__(kind, error, trace))


def by_the_right_clock(written: float, came: float) -> float:
    """When an item was written by a clock that a fault may have set wrong by an hour.

    Args:
        written: seconds of the run by the writer's clock.
        came: when the item came, less than half an hour later.
    """
    return written - JUMP_S * round((written - came) / JUMP_S)


def _reliable(key: str) -> Capability:
    return Capability(key, delivery="reliable", archive="always")


def held(address: str) -> frozenset[str] | None:
    """Addresses that a switch drops, read from it; None while it does not answer."""
    info = ProgramInfo.from_text(p4_program.find().p4info.read_text(encoding="utf-8"))
    where = Address(address, 1, 0, security=INSECURE)
    with where.channel() as channel:
        session = P4RuntimeSession(P4RuntimeStub(channel), where, CompiledProgram(b"", info.message), None)
        try:
            entries = [entry for name in _TABLES for entry in session.read_counters(info.table(name).id)]
        except SwitchError:
            return None
    return frozenset(_sources(map(info.describe, entries)))


def _sources(described: Iterable[str]) -> list[str]:
    return [text.partition("src=")[2].partition("]")[0].partition(",")[0] for text in described]


def until(condition: Callable[[], bool], seconds: float, between: Callable[[], None]) -> bool:
    """Whether the condition came true in time; `between` runs before each look."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        between()
        if condition():
            return True
    return False
