"""Kitsune by switch: every switch has a detector of its own, the instances divide the switches.  I/O.

    packets of a switch ──► its KitsuneService ──► scores, alerts, evidence
                                 │ every few seconds, and when the switch moves
                                 └──► checkpoint, place ──► Data Archives ──► the next instance of the switch

Packets are acknowledged when a checkpoint contains them.  After an instance has died, its successor begins with the
checkpoint and is sent every later batch: it scores those once more, with the same scores.

Blocks concern all switches, and a reliable path has one reader among the instances; so each of them reads in the
archive which blocks there are.
"""

import logging
import time
from pathlib import Path
from typing import Any, Final

import msgspec

from apps.intake import Intake
from apps.kitsune.blocked import Blocked
from apps.kitsune.checkpoint_store import CheckpointStore
from apps.kitsune.model_instructions import ANSWER, INSTRUCTIONS, ModelInstruction, instruction_in
from apps.kitsune.packed_arrays import CheckpointError
from apps.kitsune.service import (
    BLOCKS,
    PACKETS,
    SWITCHES,
    ClockTick,
    KitsuneService,
    Settings,
    packets_in,
    tick_in,
)
from apps.messages import Answer, Decision, MessageError, read_latest
from due import NO_WAIT, Engine, Item, RecordBatch
from due.errors import BackendError
from due.shards import Place

CHECKPOINT: Final = "network.checkpoint.kitsune"
_MOST_BLOCKS: Final = 4_096
"""Decisions that are read from the archive at a time."""
_BLOCKS_EVERY_S: Final = 1.0
_OVERLAP_NS: Final = 10_000_000_000
"""Decisions are read again for this long: others' clocks may be behind."""
_NOT_HERE: Final = (
    "this Kitsune has a detector for each switch, divided among its instances; instructions about the model are for "
    'instances = "standby"'
)

_log = logging.getLogger("kitsune")


class ShardedKitsune:
    """One instance: the detectors of its switches.

    Args:
        engine: initialised as sharded.
        settings: all options.
    """

    def __init__(self, engine: Engine, settings: Settings) -> None:
        self._engine = engine
        self._settings = settings
        self._store = CheckpointStore(engine, CHECKPOINT)
        self._works: dict[str, KitsuneService] = {}
        """By path."""
        self._intake = Intake(_log)
        self._blocked = Blocked()
        self._blocks_due = 0.0
        self._blocks_since = 0
        self._archive_away = False

    def start(self) -> None:
        """Subscribes; the engine is initialised."""
        self._read_blocks()
        self._engine.keep_state(self, every=self._settings.checkpoint_seconds)
        observe, reading = self._engine.observe, self._intake.reading
        observe(PACKETS).subscribe(reading(PACKETS, packets_in, self._score))
        observe(SWITCHES).subscribe(reading(SWITCHES, tick_in, self._on_tick))
        observe(INSTRUCTIONS).subscribe(reading(INSTRUCTIONS, instruction_in, self._on_instruction))

    def tick(self) -> None:
        """Read new blocks, once a second."""
        now = time.monotonic()
        if now >= self._blocks_due:
            self._blocks_due = now + _BLOCKS_EVERY_S
            self._read_blocks()

    def stop(self) -> None:
        """Keep the models; the engine saves the checkpoints when it closes."""
        for work in list(self._works.values()):
            work.save_model()

    def health(self) -> dict[str, Any]:
        """Sums over the switches of this instance, and which they are."""
        found = {_switch_of(path): work.health() for path, work in list(self._works.items())}
        sums: dict[str, Any] = {}
        for health in found.values():
            for name, value in health.items():
                if isinstance(value, int | float) and not isinstance(value, bool):
                    sums[name] = sums.get(name, 0) + value
        sums["threshold"] = self._settings.threshold
        sums["blocked"] = len(self._blocked)
        models = {str(switch): health["model"] for switch, health in found.items()}
        # whoever looks at one model sees the one that has most to learn
        model = min(models.values(), key=lambda each: each["packets"] / each["wanted"], default=None)
        found_here = {"switches": sorted(models), "models": models, "model": model}
        return {**sums, **self._intake.health(), **found_here}

    def load(self, path: str) -> Place | None:
        """Take up a switch with the checkpoint that was saved last."""
        found = self._store.load(path)
        if (switch := _switch_of(path)) is None:
            return found[1] if found else None
        settings = _settings_for(self._settings, switch)
        work: KitsuneService | None = None
        if found is not None:
            try:
                if isinstance(found[0], CheckpointError):
                    raise found[0]
                work = KitsuneService.continued(self._engine, settings, found[0])
                _log.info("switch %s: goes on from its checkpoint of %s bytes", switch, f"{len(found[0]):,}")
            except CheckpointError as error:
                _log.error("switch %s: its checkpoint cannot be used, training again: %s", switch, error)
        work = work or KitsuneService(self._engine, settings)
        work.block(self._blocked)
        self._works[path] = work
        return found[1] if found else None

    def save(self, path: str, place: Place) -> None:
        """Archive a checkpoint of the switch."""
        work = self._works.get(path)
        self._store.save(path, work.checkpoint() if work is not None else b"", place)

    def drop(self, path: str) -> None:
        """Another instance has the switch from now on."""
        if self._works.pop(path, None) is not None:
            _log.info("switch %s: another instance has it now", _switch_of(path))

    def _score(self, item: Item, batch: RecordBatch) -> None:
        self._works[item.key.partition(":")[0]].score(item, batch)

    def _on_tick(self, item: Item, tick: ClockTick) -> None:
        work = self._works.get(PACKETS.replace("*", tick.switch, 1))
        if work is not None:
            work.hear_tick(item, tick)

    def _on_instruction(self, _: Item, instruction: ModelInstruction) -> None:
        answer = Answer(id=instruction.id, done=False, text=_NOT_HERE)
        self._engine.write(ANSWER, answer.to_value(), [NO_WAIT])

    def _read_blocks(self) -> None:
        try:
            since = max(0, self._blocks_since - _OVERLAP_NS)
            found = read_latest(self._engine, {"dataKey": BLOCKS}, since, _MOST_BLOCKS)
        except BackendError as error:
            if not self._archive_away:
                _log.warning("the blocks in force cannot be read: %s; trying again", error)
            self._archive_away = True
            return
        self._archive_away = False
        for item in found:
            self._blocks_since = max(self._blocks_since, item.timestamp)
            try:
                self._blocked.decide(Decision.from_item(item))
            except MessageError as error:
                self._intake.refuse(BLOCKS, error, item.key)


def _switch_of(path: str) -> str | None:
    """The switch whose packets a path carries; None: it carries something else."""
    before, _, after = PACKETS.partition("*")
    if not (path.startswith(before) and path.endswith(after)):
        return None
    return path[len(before) : len(path) - len(after)]


def _settings_for(settings: Settings, switch: str) -> Settings:
    """Each switch has a model file of its own; the checkpoint is what is kept."""
    file = Path(settings.save_model)
    named = str(file.with_name(f"{file.stem}.{switch}{file.suffix}")) if settings.save_model else ""
    ports = {switch: settings.keep_for[switch]} if switch in settings.keep_for else {}
    return msgspec.structs.replace(settings, save_model=named, keep_model="", keep_for=ports)
