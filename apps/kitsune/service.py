"""Kitsune as an app: receives packet batches, writes scores and alerts.

One instance is active, others stand by: the statistics of a packet depend on all packets before it,
so instances cannot share one stream without changing scores.  With `instances = "sharded"` every switch has a detector
of its own, and the instances divide the switches: `sharded.py`.
"""

import importlib
import logging
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import Any, Final, Literal

import msgspec
import numpy as np

import due.service
from apps.evidence import DRIFT, EVIDENCE, TRAINING, DriftState, PortTraining, TrainingState
from apps.kitsune.blocked import Blocked
from apps.kitsune.checkpoint import dump, load
from apps.kitsune.detector import Detector, DetectorSettings, Scored
from apps.kitsune.kept_model import KeptModel, trained_for
from apps.kitsune.kernel import PACKET_FIELDS, load_kernel
from apps.kitsune.model_file import ModelFileError, load_model
from apps.kitsune.model_instructions import ANSWER, INSTRUCTIONS, ModelInstruction, instruction_in, late
from apps.kitsune.packed_arrays import CheckpointError
from apps.kitsune.plain_values import Kinds, built, read, restore
from apps.kitsune.successor import Comparison, Successor
from apps.kitsune.top_talkers import TalkerTable
from apps.kitsune.training_progress import TrainingProgress
from apps.messages import Alert, Answer, Decision, Intake, Message, Name, Number, Time, sender_of
from apps.packets import PACKET_COLUMNS, SteadyTime, read_columns
from apps.talkers import TALKERS
from due import NO_WAIT, PUB_ONLY, Capability, Engine, Interest, Item, RecordBatch

PACKETS: Final = "network.packets.p4runtime_ctrl.*.all"
BLOCKS: Final = "network.block.firewall.*"
SWITCHES: Final = "network.switch.p4runtime_ctrl.*"
SCORE: Final = "network.anomaly.kitsune.score"
ALERT: Final = "network.anomaly.kitsune.alert"
EVIDENCE_KEY: Final = f"{EVIDENCE}.kitsune"
TRAINING_KEY: Final = f"{TRAINING}.kitsune"
DRIFT_KEY: Final = f"{DRIFT}.kitsune"
TALKERS_KEY: Final = f"{TALKERS}.kitsune"

INTERESTS = (Interest(PACKETS), Interest(BLOCKS), Interest(SWITCHES), Interest(INSTRUCTIONS))
CAPABILITIES = (
    Capability(SCORE, delivery="reliable", archive="always"),
    Capability(ALERT, delivery="reliable", archive="always"),
    Capability(f"{EVIDENCE_KEY}.*", delivery="reliable", archive="always"),
    Capability(TRAINING_KEY, delivery="reliable", archive="always"),
    Capability(DRIFT_KEY, delivery="reliable", archive="always"),
    Capability(ANSWER, delivery="reliable", archive="always"),
    Capability(f"{TALKERS_KEY}.*"),
)

_USED: Final = {
    name: PACKET_COLUMNS[name]
    for name in (
        *("time_us", "arrival", "port", "quoted", "tcp_flags", "tcp_seq", "icmp6_type"),
        *(name for name, _, _ in PACKET_FIELDS if name != "time"),
    )
}
"""The columns of packets that Kitsune reads."""
_MOST_SWITCHES: Final = 256
_MOST_CHECKPOINT_S: Final = 3600.0
_SECOND: Final = 1_000_000_000
_SECOND_US: Final = 1_000_000
_STEP_US: Final = 86_400_000_000
"""A longer step of capture time is accepted only after several packets agree."""

_KEPT: Final[Kinds] = {
    "_told": bool,
    "_arrived": dict[str, int],
    "_is_open": bool,
    "_packets": int,
    "_alerts": int,
    "_found": int,
    "_training_step": int,
}
_KEPT_OF_TIME: Final[Kinds] = {"now": int | None, "doubted": int, "_doubt": int | None, "_agreed": int}
_KEPT_OF_PROGRESS: Final[Kinds] = {
    "packets": int,
    "ports": Counter[tuple[str, int]],
    "_samples": deque[tuple[int, int]],
}
"""What a checkpoint holds of the service, of `SteadyTime` and of `TrainingProgress`."""

_log = logging.getLogger("kitsune")


def packets_in(item: Item) -> RecordBatch:
    """Packets of a switch; raises `MessageError`."""
    sender_of(item)
    return read_columns(item.value, _USED, "packets")


class ClockTick(Message, frozen=True, kw_only=True):
    """The fields that Kitsune needs of a switch's state: its time, and the newest packet that it has sent."""

    switch: Name
    event_time: Time = 0
    arrival: Number = 0


def tick_in(item: Item) -> ClockTick:
    """The state of a switch; raises `MessageError`."""
    sender_of(item)
    return ClockTick.from_value(item.value)


class Settings(DetectorSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the detector, and of the app around it."""

    load_model: str = ""
    """File of a trained model; empty: train on the first packets."""
    save_model: str = ""
    """File to which the model is written when training ends and when the app stops; empty: nowhere."""
    keep_model: str = ""
    """File that is loaded if its model was trained for the same switches, ports and settings, and written otherwise;
    empty: none; `load_model` and `save_model` apply. `sdnator up` sets it."""
    keep_for: dict[str, tuple[str, ...]] = msgspec.field(default_factory=dict)
    """Switches and their ports, to compare `keep_model` with. `sdnator up` sets it."""
    archive_scores: bool = True
    """Archive the score of each packet; False: scores are published only. Alerts and evidence are archived either way."""
    instances: Literal["standby", "sharded"] = "standby"
    """`standby`: one detector for all switches, one instance works and the others wait; `sharded`: one detector for each
    switch, the instances divide the switches, and a switch moves with its detector."""
    checkpoint_seconds: float = 30.0
    """Sharded: seconds between two checkpoints of a detector in Data Archives; packets since the last one are scored
    again after an instance has died."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.checkpoint_seconds <= _MOST_CHECKPOINT_S:
            raise ValueError(
                f"checkpoint_seconds={self.checkpoint_seconds}: must be greater than 0 and at most {_MOST_CHECKPOINT_S:g}"
            )


class KitsuneService:
    """Scores each batch on arrival; a slow batch causes back-pressure, and nothing is dropped.

    Args:
        engine: initialised.
        settings: all options.
        detector: that of a checkpoint; None: as the settings say.
    """

    def __init__(self, engine: Engine, settings: Settings, detector: Detector | None = None) -> None:
        self._engine = engine
        self._settings = settings
        self._score_flags = [NO_WAIT] if settings.archive_scores else [NO_WAIT, PUB_ONLY]
        self._kernel = load_kernel()
        self._belongs = trained_for(settings, settings.keep_for)
        self._kept = KeptModel(Path(settings.keep_model), self._belongs) if settings.keep_model else None
        self._detector = detector or self._first_detector()
        self._successor: Successor | None = None
        """The model that trains beside the one in use."""
        self._told = self._detector.model.is_trained
        self._progress = TrainingProgress(self._detector.model.training_packets)
        self._intake = Intake(_log)
        self._time = SteadyTime(_STEP_US)
        self._talkers = TalkerTable()
        self._lock = threading.Lock()
        self._arrived: dict[str, int] = {}
        """Arrival number of the newest packet scored, by switch."""
        self._ticks: dict[str, ClockTick] = {}
        self._is_open = False
        """Packets of the newest second may raise alerts when it is over."""
        self._packets = 0
        self._alerts = 0
        self._found = 0
        self._numbers = count(1)
        """Of evidence and states of training, which come under keys of their own."""
        self._training_step = -1
        self._subscriptions: list[Any] = []

    def start(self) -> None:
        """Subscribes; the engine is initialised."""
        observe, reading = self._engine.observe, self._intake.reading
        self._subscriptions = [
            observe(BLOCKS).subscribe(reading(BLOCKS, Decision.from_item, self._on_decision)),
            observe(PACKETS).subscribe(reading(PACKETS, packets_in, self.score)),
            observe(SWITCHES).subscribe(reading(SWITCHES, tick_in, self.hear_tick)),
            observe(INSTRUCTIONS).subscribe(reading(INSTRUCTIONS, instruction_in, self._on_instruction)),
        ]
        if self._kept is not None:
            _log.info("%s", self._kept.text)

    def ready(self) -> dict[str, str]:
        """For the ready line: what happened to the kept model."""
        return {"model": self._kept.text} if self._kept is not None else {}

    def checkpoint(self) -> bytes:
        """The detector and what is kept beside it; `continued` is the inverse."""
        following = next(self._numbers)
        self._numbers = count(following)
        return dump(self._detector, [following, *read(self._kept_beside())])

    @classmethod
    def continued(cls, engine: Engine, settings: Settings, data: bytes) -> "KitsuneService":
        """A service that goes on where a checkpoint was made.

        Args:
            engine: initialised.
            settings: all options.
            data: what `checkpoint` returned, from anywhere.

        Raises:
            CheckpointError: it is none, or belongs to other settings or another version.
        """
        detector, beside = load(data, settings, load_kernel())
        self = cls(engine, settings, detector)
        try:
            following, *values = beside
            restore(self._kept_beside(), values)
            self._numbers = count(built(following, int))
        except (TypeError, ValueError) as error:
            raise CheckpointError(f"a damaged checkpoint: {error}") from error
        return self

    def block(self, blocked: Blocked) -> None:
        """From now on heed these blocks; whoever keeps them may change them."""
        self._detector.senders.blocked = blocked

    def save_model(self) -> None:
        """Write the model to where it is kept, if there is one."""
        with self._lock:
            self._save()

    def _kept_beside(self) -> list[tuple[object, Kinds]]:
        """What a checkpoint holds besides the detector."""
        return [(self, _KEPT), (self._time, _KEPT_OF_TIME), (self._progress, _KEPT_OF_PROGRESS)]

    def _first_detector(self) -> Detector:
        settings = self._settings
        if settings.load_model:
            path = Path(settings.load_model)
            model = load_model(path, clip=settings.scale_limit, kernel=self._kernel)
            return Detector(settings, model=model, kernel=self._kernel)
        kept = self._kept.detector(settings, self._kernel) if self._kept is not None else None
        return kept or Detector(settings, kernel=self._kernel)

    def tick(self) -> None:
        """Does nothing: no state depends on wall time."""

    def stop(self) -> None:
        """Raises the alerts of the second that is still open."""
        for subscription in self._subscriptions:
            subscription.dispose()
        with self._lock:
            self._write_alerts(self._detector.finish())
            self._save()

    def _save(self) -> None:
        """Write the model to where it is kept."""
        if not self._detector.model.is_trained:
            return
        self._detector.trained_for = self._belongs
        if self._settings.save_model:
            self._detector.save(Path(self._settings.save_model))
        if self._kept is not None:
            try:
                self._kept.keep(self._detector)
            except (ModelFileError, OSError) as error:
                _log.error("the model could not be kept: %s", error)

    def health(self) -> dict[str, Any]:
        """Counters and settings for metrics and the dashboard."""
        return {
            "packets": self._packets,
            "trained": self._detector.trained,
            "training_packets": self._detector.model.training_packets,
            "alerts": self._alerts,
            "evidence": self._found,
            "threshold": self._detector.threshold,
            "training_warnings": self._detector.training_warnings,
            "model": self._model_health(),
            "clock_jumps": self._detector.senders.clock_jumps,
            "times_doubted": self._time.doubted,
            "blocked": len(self._detector.senders.blocked),
            **self._intake.health(),
            "subjects": self._detector.behaviour.subjects,
            **self._detector.afterimage.counts,
        }

    def _model_health(self) -> dict[str, Any]:
        """Its life, for `sdnator status`, `sdnator model show` and the page."""
        detector, progress = self._detector, self._progress
        drift = detector.drift.reading if detector.drift is not None else None
        return {
            "done": detector.model.is_trained,
            "packets": detector.model.trained,
            "wanted": detector.model.training_packets,
            "seconds_left": None if self._told else progress.seconds_left(self._capture_us()),
            "ports": [
                {"name": f"{switch} port {port}", "packets": count}
                for (switch, port), count in list(progress.ports.items())
            ],
            "trained_at_us": detector.trained_at_us,
            "trained_s": detector.behaviour.seconds,
            "senders": len(detector.behaviour.senders),
            "file": self._settings.keep_model or self._settings.save_model or self._settings.load_model,
            "beside": self._beside(),
            "drifted": drift is not None and drift.drifted,
            "drift_share": None if drift is None else drift.share,
            "drift_limit": None if detector.drift is None else detector.drift.limit,
            "drift_blocks": 0 if drift is None else drift.blocks,
        }

    def _beside(self) -> dict[str, int] | None:
        """How far the model is that trains beside the one in use."""
        if (successor := self._successor) is None:
            return None
        model = successor.detector.model
        return {
            "packets": model.trained,
            "wanted": model.training_packets,
            "compared": successor.compared,
            "to_compare": successor.wanted,
        }

    def _capture_us(self) -> int:
        """Capture time by packets and by the clocks of switches."""
        return max([self._time.now or 0, *(tick.event_time // 1_000 for tick in list(self._ticks.values()))])

    def _on_instruction(self, _: Item, instruction: ModelInstruction) -> None:
        """An operator wants another model."""
        with self._lock:
            train = self._renew if instruction.verb == "renew" else self._retrain
            answer = late(instruction, time.time_ns()) or Answer(id=instruction.id, done=True, text=train())
        self._engine.write(ANSWER, answer.to_value(), [NO_WAIT])

    def _renew(self) -> str:
        """Train a second model beside the one in use; if none is in use yet, training continues."""
        if not self._detector.model.is_trained:
            return "a model is being trained already, and none is in use before it"
        self._successor = Successor(self._settings, self._detector, self._kernel)
        wanted = self._successor.detector.model.training_packets
        text = f"a second model trains on the next {wanted:,} packets, beside the one in use; it takes over if it is no worse"
        _log.warning("an operator asked for it: %s", text)
        return text

    def _take_over(self, found: Comparison) -> None:
        """The successor is trained and compared: it takes over, or is discarded."""
        successor, self._successor = self._successor, None
        if successor is None:
            return
        if not found.no_worse:
            _log.warning("the model in use stays, the one trained beside it is worse: %s", found.text)
            return
        self._write_alerts(self._detector.finish())
        successor.detector.accused = self._detector.accused
        self._detector, self._training_step = successor.detector, -1
        if self._kept is not None:
            self._kept.set_aside()
        self._save()
        _log.warning("the model trained beside the one in use takes over: %s", found.text)

    def _retrain(self) -> str:
        """Throw the model away and train on the next packets."""
        self._successor = None
        aside = self._kept.set_aside() if self._kept is not None else None
        self._write_alerts(self._detector.finish())
        before, self._detector = self._detector, Detector(self._settings, kernel=self._kernel)
        self._detector.senders.blocked = before.senders.blocked
        self._progress = TrainingProgress(self._detector.model.training_packets)
        self._told, self._training_step = False, -1
        text = f"training again, on the next {self._progress.wanted:,} packets; nobody is blocked until then"
        text += f"; the old model is kept as {aside}" if aside is not None else ""
        _log.warning("an operator asked for it: %s", text)
        return text

    def _on_decision(self, _: Item, decision: Decision) -> None:
        with self._lock:
            self._detector.senders.blocked.decide(decision)

    def score(self, item: Item, batch: RecordBatch) -> None:
        """Packets of a switch."""
        if not len(batch):
            return
        switch = item.key.split(".")[3]
        with self._lock:
            batch = self._steady(batch)
            before = self._detector.trained
            scored, alerts = self._detector.process(batch, switch)
            trained = self._detector.trained - before
            if trained:
                self._progress.see(batch, switch, trained)
            self._packets += len(batch)
            self._is_open = True
            self._note_arrival(switch, int(batch["arrival"][-1]))
            event_time = int(batch["time_us"][-1]) * 1_000
            # evidence rests on training: what ends it comes first, at the time of its last packet
            self._tell_training(int(batch["time_us"][trained - 1]) * 1_000 if trained else event_time)
            self._write_evidence()
            summary = self._summary(batch, switch, scored)
            self._engine.write(SCORE, summary, self._score_flags, event_time=event_time)
            self._write_alerts(alerts)
            self._tell_talkers(batch, switch)
            self._tell_drift(event_time)
            if self._detector.model.is_trained and not self._told:
                self._end_of_training()
            if self._successor is not None:
                found = self._successor.add(batch, switch, self._detector, scored)
                if found is not None:
                    self._take_over(found)
                    self._tell_training(event_time)

    def hear_tick(self, _: Item, tick: ClockTick) -> None:
        """The time of a switch: close the open second where capture time has left it, and no packet of it is under way."""
        with self._lock:
            if tick.switch in self._arrived:
                self._ticks[tick.switch] = tick
            newest_us = self._time.now
            if not self._is_open or newest_us is None:
                return
            ticks = self._ticks
            settled = all(
                switch in ticks and ticks[switch].arrival == arrival
                for switch, arrival in self._arrived.items()
            )
            left = all(each.event_time // _SECOND > newest_us // _SECOND_US for each in ticks.values())
            if settled and left:
                self._is_open = False
                self._write_alerts(self._detector.finish())

    def _steady(self, batch: RecordBatch) -> RecordBatch:
        """The batch with impossible times replaced by the newest valid one, since every packet is scored."""
        times, before = batch["time_us"], self._time.now or 0
        believed = self._time.believed(times)
        if believed is None:
            return batch
        newest = np.maximum.accumulate(np.where(believed, times, before))
        return RecordBatch({**batch, "time_us": np.where(believed, times, newest)})

    def _note_arrival(self, switch: str, arrival: int) -> None:
        if switch in self._arrived or len(self._arrived) < _MOST_SWITCHES:
            self._arrived[switch] = arrival

    def _end_of_training(self) -> None:
        self._told = True
        for warning in self._detector.training_warnings:
            _log.warning("training: %s", warning)
        self._save()

    def _summary(self, batch: Any, switch: str, scored: Scored) -> dict[str, Any]:
        arrival = batch["arrival"]
        return {
            "switch": switch,
            "count": len(batch),
            "trained": self._detector.trained,
            "over": scored.over,
            "evidence": self._found,
            "max": float(scored.scores.max()),
            "first_arrival": int(arrival[0]),
            "last_arrival": int(arrival[-1]),
            "arrival": arrival,
            "score": scored.scores,
            "time_us": batch["time_us"],
            "state": scored.state,
        }

    def _write_evidence(self) -> None:
        for evidence in self._detector.take_evidence():
            self._found += 1
            key = f"{EVIDENCE_KEY}.{evidence.source}"
            numbered = msgspec.structs.replace(evidence, number=next(self._numbers))
            self._engine.write(key, numbered.to_value(), [NO_WAIT], event_time=evidence.event_time)

    def _tell_training(self, event_time: int) -> None:
        """Every hundredth of training, and its end."""
        model, behaviour = self._detector.model, self._detector.behaviour
        step = 100 if model.is_trained else 100 * model.trained // model.training_packets
        if step == self._training_step:
            return
        self._training_step = step
        state = TrainingState(
            packets=model.trained,
            wanted=model.training_packets,
            done=model.is_trained,
            seconds=behaviour.seconds,
            senders=len(behaviour.senders),
            hosts=len({mac for _, _, mac, _ in behaviour.senders}) if model.is_trained else 0,
            event_time=event_time,
            seconds_left=0.0 if model.is_trained else self._progress.seconds_left(event_time // 1_000),
            ports=tuple(
                PortTraining(switch=switch, port=port, packets=count)
                for (switch, port), count in self._progress.ports.items()
            ),
            number=next(self._numbers),
        )
        self._engine.write(TRAINING_KEY, state.to_value(), [NO_WAIT], event_time=event_time)

    def _tell_talkers(self, batch: RecordBatch, switch: str) -> None:
        """Top talkers, while somebody looks."""
        if switch not in self._arrived or not self._engine.wanted(key := f"{TALKERS_KEY}.{switch}"):
            return
        if (found := self._talkers.add(batch, switch)) is not None:
            self._engine.write(key, found.to_value(), [NO_WAIT], event_time=found.event_time)

    def _tell_drift(self, event_time: int) -> None:
        """Once when scores have left training's distribution, and once when they are back."""
        drift = self._detector.drift
        if not self._detector.drift_changed or drift is None or drift.reading is None:
            return
        self._detector.drift_changed = False
        reading = drift.reading
        now = (
            f"{reading.share:.1%} of benign packets of the last day score over what 1 % of training did, in "
            f"{reading.blocks} half hours; up to {reading.limit:.0%} would be no drift"
        )
        text = f"benign scores have drifted: {now}; `sdnator model retrain --beside` trains a second model"
        if not reading.drifted:
            text = f"benign scores are like those of training again: {now}"
        _log.warning("%s", text)
        state = DriftState(
            drifted=reading.drifted,
            share=reading.share,
            limit=reading.limit,
            blocks=reading.blocks,
            event_time=event_time,
            text=text,
        )
        self._engine.write(DRIFT_KEY, state.to_value(), [NO_WAIT], event_time=event_time)

    def _write_alerts(self, alerts: list[Alert]) -> None:
        for alert in alerts:
            self._alerts += 1
            _log.warning("%s", alert.reason)
            self._engine.write(ALERT, alert.to_value(), [NO_WAIT], event_time=alert.event_time)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the app until SIGTERM or SIGINT."""
    try:
        return due.service.run("kitsune", _service, Settings, INTERESTS, CAPABILITIES, argv)
    except ModelFileError as error:
        print(f"kitsune: {error}", file=sys.stderr)
        return 2


def _service(engine: Engine, settings: Settings) -> due.service.Service:
    if settings.instances == "sharded":
        from apps.kitsune.sharded import ShardedKitsune

        return ShardedKitsune(engine, settings)
    return KitsuneService(engine, settings)


if __name__ == "__main__":
    # not as `__main__`: `sharded` imports this module
    sys.exit(importlib.import_module("apps.kitsune.service").main())
