"""The Sonata adapter's part of `benchmarks.soak_state`: its service lives hours of a soak run in minutes.

    office traffic, at 4,000 packets a second ──► what the switch was asked for: copies and reports of counts
                                                  └──► SonataAdapterService ──► results, which count as read
    SYNs of the traffic ──► CountedEntry, a counting stage as the switch has them

It serves what the firewall and a soak run's client ask for.
"""

import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
import numpy.typing as npt

import apps.sonata_adapter.service
from apps.evidence import TRAINING, TrainingState
from apps.sonata_adapter.service import CAPABILITIES, Settings, SonataAdapterService
from benchmarks.decisions_core import SWITCH
from benchmarks.soak_state_recording import PPS, office
from benchmarks.soak_state_recording import TRAINING as TRAINED
from benchmarks.soak_state_stage import START_NS, FastClock, FastEngine, watched
from due import Assignment, Engine, RecordBatch
from due.codec import encode_value

HOURS: Final = 4.0
WANTED: Final = (
    "network.handshake.sonata.tcp",
    "network.traffic_query.sonata.new_tcp:threshold=100,window=200ms",
    "network.traffic_query.sonata.new_tcp:threshold=5,window=3s",
    "network.traffic_capture.sonata.tcp:flag=syn+ack",
    "network.traffic_capture.sonata.arp",
)
_COMMANDS: Final = "network.p4_command.sonata_adapter."
_STATES: Final = f"network.switch.p4runtime_ctrl.{SWITCH}"
_BATCH: Final = 512
"""Rows of one item: an eighth of a second."""
_CELLS: Final = 8_192
_FIELDS: Final = {"ethertype": "eth_type", "protocol": "ip_proto", "tcp_flags": "tcp_flags"}

Rows = npt.NDArray[np.intp]


class CountedEntry:
    """Counts packets by destination in windows, one cell for each, as a counting stage does.

    Args:
        threshold: a report is sent when a count reaches it.
        window_us: length of the windows.
    """

    def __init__(self, threshold: int, window_us: int) -> None:
        self._threshold = threshold
        self._window_us = window_us
        self._window = -1
        self._counts: Counter[int] = Counter()
        self._owners: dict[int, int] = {}

    def reports(self, batch: RecordBatch, rows: Rows) -> RecordBatch | None:
        """Packets with which a key came to the threshold, or whose key has no cell; None: none."""
        chosen, crossed = [], []
        windows = (batch["time_us"][rows] // self._window_us).tolist()
        keys = batch["ip_dst_lo"][rows].tolist()
        for row, window, key in zip(rows.tolist(), windows, keys, strict=True):
            if window != self._window:
                self._window = window
                self._counts.clear()
                self._owners.clear()
            if self._owners.setdefault(key * 0x9E3779B1 % _CELLS, key) != key:
                chosen.append(row)
                crossed.append(0)
                continue
            self._counts[key] += 1
            if self._counts[key] == self._threshold:
                chosen.append(row)
                crossed.append(1)
        if not chosen:
            return None
        some = batch.take(np.array(chosen))
        marks = np.array(crossed, np.uint8)
        return RecordBatch({**some, "crossed": marks, "overflow": 1 - marks})


class AdapterRun:
    """The service and its surroundings.

    Args:
        folder: of the archive.
    """

    def __init__(self, folder: Path) -> None:
        self._clock = FastClock()
        self._clock.rule(apps.sonata_adapter.service)
        self._engine = FastEngine("sonata_adapter", self._clock, CAPABILITIES, folder, self._on_written)
        self._copies: dict[str, Mapping[str, Any]] = {}
        """Conditions by the stream of their copies."""
        self._matches: dict[str, Mapping[str, Any]] = {}
        """Conditions by the stream of their reports."""
        self._entries: dict[str, CountedEntry] = {}
        self.results = 0
        self.service = SonataAdapterService(cast(Engine, self._engine), Settings())
        self.service.start()
        self._state(START_NS)
        self._engine.assigned(tuple(Assignment(key=key) for key in WANTED))
        self._train()

    def hours(self, hours: float) -> Iterator[float]:
        """Let so many pass; how many have, from time to time."""
        fed = 0
        for whole in office(round(hours * 3600 * PPS)):
            for start in range(0, len(whole), _BATCH):
                batch = whole.take(slice(start, start + _BATCH))
                at_us = int(batch["time_us"][-1])
                self._clock.seconds = at_us / 1_000_000 - START_NS / 1_000_000_000
                self._deliver(batch)
                self.service.tick()
            fed += len(whole)
            self._state(at_us * 1000)
            yield fed / PPS / 3600

    def health(self) -> Mapping[str, Any]:
        """Counters of the service, and what the engine keeps beside it."""
        found = {
            name: value for name, value in self.service.health().items() if isinstance(value, int | float)
        }
        return {**found, "retained_kb": self._engine.retained_bytes >> 10}

    def _deliver(self, batch: RecordBatch) -> None:
        for name, conditions in list(self._copies.items()):
            rows = _meeting(batch, conditions)
            if len(rows):
                self._hand("packets", name, batch.take(rows))
        for name, entry in list(self._entries.items()):
            rows = _meeting(batch, self._matches.get(name, {}))
            found = entry.reports(batch, rows) if len(rows) else None
            if found is not None:
                self._hand("digests", name, found)

    def _hand(self, kind: str, name: str, batch: RecordBatch) -> None:
        key = f"network.{kind}.p4runtime_ctrl.{SWITCH}.{name}"
        self._engine.hand(key, encode_value(batch), "p4runtime_ctrl", int(batch["time_us"][-1]) * 1000)

    def _state(self, now: int) -> None:
        value = {"switch": SWITCH, "primary": True, "base_us": 0, "event_time": now}
        self._engine.hand(_STATES, encode_value(value), "p4runtime_ctrl", now)

    def _train(self) -> None:
        state = TrainingState(
            packets=TRAINED,
            wanted=TRAINED,
            done=True,
            seconds=TRAINED / PPS,
            senders=286,
            event_time=START_NS,
        )
        self._engine.hand(f"{TRAINING}.kitsune", encode_value(state.to_value()), "kitsune", START_NS)

    def _on_written(self, key: str, value: Any) -> None:
        if not key.startswith(_COMMANDS):
            self.results += 1
            return
        for each in value["updates"]:
            name = f"q{int(each['match']['query_map'][0], 16).bit_length() - 1}"
            self._entries.pop(name, None)
            if each["kind"] != "delete":
                params = {name: int(number, 16) for name, number in each["params"].items()}
                window_us = (1 << 64) // params["reciprocal"]
                self._entries[name] = CountedEntry(params["threshold"], window_us)
        for each in value["requests"]:
            place = self._copies if each.get("copy") else self._matches
            if each["active"]:
                place[each["name"]] = each["conditions"]
            else:
                self._copies.pop(each["name"], None)
                self._matches.pop(each["name"], None)


def _meeting(batch: RecordBatch, conditions: Mapping[str, Any]) -> Rows:
    """Rows that meet conditions of the switch's classifier."""
    chosen = np.ones(len(batch), bool)
    for name, wanted in conditions.items():
        if name == "l4_valid":
            chosen &= batch["tcp_sport"] >= 0
            continue
        value, mask = wanted if isinstance(wanted, list | tuple) else (wanted, 0xFFFF)
        chosen &= batch[_FIELDS[name]].astype(np.int64) & mask == value
    return np.flatnonzero(chosen)


def figures(scale: float = 1.0, *, objects: bool = False) -> dict[str, Any]:
    """Run the part.

    Args:
        scale: share of the hours.
        objects: count Python's objects, too.

    Returns:
        Figures; see `benchmarks.soak_state`.
    """
    hours = scale * HOURS
    with tempfile.TemporaryDirectory(prefix="soak-state-") as folder:
        run = AdapterRun(Path(folder))
        found = watched(run.hours(hours), hours, run.health, objects=objects)
    return {**found, "results": run.results}
