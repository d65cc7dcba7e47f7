"""The adapter's decisions on the product's program, on the embedded switch; the classifier is played in Python."""

from typing import Any

import numpy as np

from apps.sonata_adapter.control import Control
from apps.sonata_adapter.query.catalogue import CATALOGUE
from dataplane.compiler.c_machine import CMachine
from dataplane.v1model.tables import TableEntry, Ternary
from due import RecordBatch
from sdnator.testing.query_traffic import BASE_US, batch_of
from tests.apps.sonata_adapter.switch_model import counts_of, matches
from tests.apps.sonata_adapter.test_control import rows
from tests.dataplane.loading import sdnator
from tests.p4.sdnator_switch import made

COUNT = ("query", "window", "count", "source", "destination", "port", "length", "source_port", "time_us")
_CHUNK = 64


class CrowdedSwitch:
    """A switch whose queries are weighed as its capture goes on; its clock is the adapter's."""

    def __init__(self, keys, limits):
        self.switch = made(sdnator(), CMachine)
        self.control = Control(CATALOGUE, limits=limits)
        self.control.switch("s1", BASE_US)
        self.offers: dict[str, Any] = {}
        self.written: list[Any] = []
        self._arrived = 0
        self._change(self.control.want(keys))

    def close(self):
        self.switch.close()

    def play(self, frames):
        """Frames in the order of time."""
        for begin in range(0, len(frames), _CHUNK):
            chunk = frames[begin : begin + _CHUNK]
            self._chunk(chunk)
            now = (chunk[-1].time_us - BASE_US) / 1e6
            self.control.advance("s1", chunk[-1].time_us)
            self.written += self.control.tick(now)
            changes = self.control.weigh(now)
            if changes is not None:
                self._change(changes)

    def rest(self, seconds, from_us):
        """Nothing comes for a while; the switch's clock goes on."""
        for second in range(0, seconds, 10):
            self.control.advance("s1", from_us + second * 1_000_000)
            self.control.weigh((from_us - BASE_US) / 1e6 + second)

    def results(self, key):
        """What was written under a key: what naive evaluation gives, and in the same form."""
        return rows([one.output for one in self.written if any(each.startswith(key) for each in one.keys)])

    def cells(self, key):
        """Cells of a query's counts, by the place where it is counted; none: on the host."""
        return [
            entry.size
            for one in self.control.plan.queries
            for entry in one.entries
            if one.identity.startswith(key) and entry.has_cells
        ]

    def _change(self, changes):
        for offer in changes.withdraw:
            del self.offers[offer["name"]]
        for update in changes.updates:
            table = self.switch.tables[update.table]
            match = (Ternary(*(int(text, 16) for text in update.match["query_map"])),)
            if update.kind == "delete":
                table.delete(match, update.priority)
                continue
            spec = next(each for each in table.spec.actions if each.name == update.action)
            numbers = tuple(int(update.params[param.name], 16) for param in spec.params)
            put = table.insert if update.kind == "insert" else table.modify
            put(TableEntry(match, spec.name, numbers, priority=update.priority))
        for offer in changes.offer:
            self.offers[offer["name"]] = offer

    def _chunk(self, frames):
        batch = batch_of(frames, self._arrived)
        self._arrived += len(frames)
        copies: dict[str, list[int]] = {}
        reports: dict[int, list[tuple[int, bool, bool]]] = {}
        for row, frame in enumerate(frames):
            packet = {name: batch[name][row] for name in batch.columns}
            mine = [offer for offer in self.offers.values() if matches(offer["conditions"], packet)]
            for offer in mine:
                if offer["copy"]:
                    copies.setdefault(offer["name"], []).append(row)
            for digest in self._process(frame, sum(1 << offer["bit"] for offer in mine)):
                if digest.name == "count_digest_t":
                    self._counted(digest, frame)
                    continue
                _, crossed, overflow = (int(value) for value in digest.values[:3])
                for bit in range((crossed | overflow).bit_length()):
                    if (crossed | overflow) >> bit & 1:
                        told = (row, bool(crossed >> bit & 1), bool(overflow >> bit & 1))
                        reports.setdefault(bit, []).append(told)
        now = (frames[-1].time_us - BASE_US) / 1e6
        for bit, told in reports.items():
            chosen = batch.take(np.array([row for row, _, _ in told]))
            flags = {
                "crossed": np.array([each for _, each, _ in told]),
                "overflow": np.array([each for _, _, each in told]),
            }
            self.written += self.control.digests("s1", f"q{bit}", RecordBatch({**chosen, **flags}))
        for name, places in copies.items():
            self.written += self.control.packets("s1", name, batch.take(np.array(places)), now)

    def _process(self, frame, bits):
        for name in ("link", "src", "dst", "l4", "sport", "dport"):
            self.switch.tables[f"ingress.telemetry_{name}"].set_default(f"ingress.match_{name}", (bits,))
        self.switch.tables["ingress.telemetry_active"].set_default("ingress.set_active", (bits, 0, 0))
        data = frame.data.ljust(frame.length, b"\0")
        return self.switch.process(1, data, frame.time_us - BASE_US).digests

    def _counted(self, digest, frame):
        told = dict(zip(COUNT, (int(value) for value in digest.values), strict=True))
        told["time_us"] += BASE_US
        now = (frame.time_us - BASE_US) / 1e6
        self.written += self.control.counts("s1", f"q{told['query']}", counts_of([told]), now)
