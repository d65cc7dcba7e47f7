"""The control side: entries written per second, and how soon a block on DUE drops packets."""

import statistics
import time
from pathlib import Path
from typing import Any

from apps.messages import Decision, Target
from benchmarks.switch_stage import (
    BLOCK_KEY,
    PACKETS_KEY,
    SwitchProcess,
    SwitchStage,
    frame,
    primary,
    program,
)
from dataplane.ports.capture_port import COPIED, CaptureFeed
from due import NO_WAIT, Capability
from sdnator.testing.p4runtime_client import EntryBuilder, P4RuntimeClient, delete, insert

_PATIENCE_S = 5.0


def _update(names: EntryBuilder, number: int) -> Any:
    match = {field.name: 0 for field in names.tables["ingress.block_src"].match_fields}
    match |= {"src": 0x0B000000 + number}
    if "is_ipv4" in match:
        match["is_ipv4"] = 1
    return names.entry("ingress.block_src", match, _drop_action(names))


def _drop_action(names: EntryBuilder) -> Any:
    actions = {action.preamble.id: action for action in names.info.actions}
    table = names.tables["ingress.block_src"]
    default = table.initial_default_action.action_id or table.const_default_action_id
    return next(
        actions[r.id].preamble.name for r in table.action_refs if r.id != default and not actions[r.id].params
    )


def writes(controller: P4RuntimeClient, count: int, batch: int, rounds: int) -> dict[str, float]:
    """Inserts per second in batches, and the 99th percentile of single ones in ms."""
    names = EntryBuilder(program().p4info)
    entities = [_update(names, number) for number in range(count)]
    rates = []
    for _ in range(rounds):
        batches = [map(insert, entities[start : start + batch]) for start in range(0, count, batch)]
        requests = [controller.write_request(*updates) for updates in batches]
        start = time.perf_counter()
        for request in requests:
            controller.stub.Write(request)
        rates.append(count / (time.perf_counter() - start))
        for first in range(0, count, batch):
            controller.write(*map(delete, entities[first : first + batch]))
    single = []
    for entity in entities[: min(500, count)]:
        update = insert(entity)
        start = time.perf_counter()
        controller.write(update)
        single.append((time.perf_counter() - start) * 1000)
    controller.write(*map(delete, entities[: min(500, count)]))
    return {
        "entries_per_s": statistics.median(rates),
        "entry_ms_p99": statistics.quantiles(single, n=100)[98],
    }


def entries(folder: Path, rounds: int, count: int, batch: int = 500) -> dict[str, float]:
    """`writes` on the embedded switch."""
    switch = SwitchProcess(folder)
    controller = primary(switch.address)
    try:
        return writes(controller, count, batch, rounds)
    finally:
        controller.close()
        switch.close()


def block_latency(folder: Path, rounds: int) -> dict[str, float]:
    """From a decision on DUE to the first frame that makes no copy any more, ms; one frame under way at a time."""
    stage = SwitchStage(folder)
    try:
        block = Capability(BLOCK_KEY, delivery="reliable", archive="always")
        firewall = stage.engine("firewall", capabilities=[block])
        subscription = stage.engine("watcher").observe(PACKETS_KEY).subscribe(lambda _: None)
        with CaptureFeed(stage.switch.socket) as feed:
            probe = _Probe(feed)
            probe.until(1, copied=True)
            while not firewall.wanted(BLOCK_KEY):
                time.sleep(0.01)
            found = [_one_block(firewall, probe, number) for number in range(2, 2 + rounds)]
        subscription.dispose()
    finally:
        stage.close()
    return {
        "block_latency_ms_p50": statistics.median(found),
        "block_latency_ms_p99": statistics.quantiles(found, n=100)[98],
    }


def _one_block(firewall: Any, probe: "_Probe", number: int) -> float:
    address = f"10.0.{number >> 8}.{number & 255}"
    decision = Decision(
        id=f"bench-{number}",
        action="block",
        switch="s1",
        target=Target(kind="ip", address=address),
        reason="benchmark",
        event_time=1,
        expires=0,
    )
    probe.until(number, copied=True)
    start = time.perf_counter()
    firewall.write(BLOCK_KEY, decision.to_value(), [NO_WAIT])
    probe.until(number, copied=False)
    return (time.perf_counter() - start) * 1000


class _Probe:
    """Sends one frame after the other and looks at each verdict."""

    def __init__(self, feed: CaptureFeed) -> None:
        self._feed = feed
        self._time_us = 0

    def until(self, source: int, *, copied: bool) -> None:
        """Send frames of a source until they are copied, or no longer."""
        sent, deadline = frame(source), time.monotonic() + 60 * _PATIENCE_S
        while time.monotonic() < deadline:
            self._time_us += 1
            self._feed.send([self._time_us], [len(sent)], [sent])
            if bool(self._verdict() & COPIED) == copied:
                return
        raise RuntimeError(f"frames of source {source} stay {'not ' if copied else ''}copied")

    def _verdict(self) -> int:
        while not (found := self._feed.verdicts()):
            time.sleep(0.00005)
        return found[-1]
