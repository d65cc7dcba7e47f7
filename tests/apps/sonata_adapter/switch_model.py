"""The classifier and the counting stages of p4/sdnator.p4, one frame at a time: slow and obvious.

Takes what the adapter tells the controller (offers, table updates) and returns what the controller
would publish: copied packets, reports and counts, by name of the offer.
"""

from dataclasses import dataclass, field
from ipaddress import ip_network
from typing import Any
from zlib import crc32

import numpy as np

from apps.sonata_adapter.planner.placement import SwitchLimits
from due import RecordBatch

CELLS = 65_536
STAGES = SwitchLimits().stages
ZERO = 1 << 31
"""A difference of 0."""


@dataclass
class Ring:
    """Keys of a difference that wait for the end of their windows: (slot, epoch)."""

    generation: int = 0
    newest: int = -1
    waits: list[tuple[Any, int]] = field(default_factory=list)


@dataclass
class SwitchModel:
    """A switch; `base_us` is its clock zero."""

    base_us: int = 0
    offers: dict[str, Any] = field(default_factory=dict)
    stages: list[dict[int, dict[str, int]]] = field(default_factory=lambda: [{} for _ in range(STAGES)])
    cells: list[dict[Any, Any]] = field(default_factory=lambda: [{} for _ in range(STAGES)])
    rings: dict[int, Ring] = field(default_factory=dict)
    """By query."""
    shrink: int = 0
    """Divides the cells of every entry, to see keys without a cell; 0: every key has a cell."""

    def change(self, changes):
        """What the controller does with the adapter's wishes; an update that does not fit is an error."""
        for offer in changes.withdraw:
            del self.offers[offer["name"]]
        for update in changes.updates:
            stage = self.stages[int(update.table.split("_")[1].split(".")[0])]
            bit = int(update.match["query_map"][0], 16)
            assert (bit in stage) == (update.kind != "insert"), update
            if update.kind == "delete":
                del stage[bit]
            else:
                stage[bit] = {name: int(value, 16) for name, value in update.params.items()}
        for offer in changes.offer:
            self.offers[offer["name"]] = offer

    @property
    def empty(self):
        return not self.offers and not any(self.stages)

    def process(self, batch):
        """(kind, name) -> record batch of what is sent for these packets."""
        copies: dict[str, list[int]] = {}
        reports: dict[str, list[tuple[int, bool, bool]]] = {}
        counts: dict[str, list[dict[str, int]]] = {}
        for row in range(len(batch)):
            packet = {name: batch[name][row] for name in batch.columns}
            mine = [offer for offer in self.offers.values() if not offer.get("by_stage")]
            matched = {offer["bit"] for offer in mine if matches(offer["conditions"], packet)}
            copied = {offer["bit"] for offer in mine if offer["copy"]} & matched
            crossed, overflow, passed, ripe = self._count(set(matched), packet)
            for offer in self.offers.values():
                if offer["bit"] in copied | passed:
                    copies.setdefault(offer["name"], []).append(row)
            if ripe is not None and not crossed and not overflow:
                for told in self._swept(ripe, int(packet["time_us"])):
                    counts.setdefault(f"q{told['query']}", []).append(told)
            for bit in crossed | overflow:
                reports.setdefault(f"q{bit}", []).append((row, bit in crossed, bit in overflow))
        found = {("copies", name): batch.take(np.array(rows)) for name, rows in copies.items()}
        for name, rows in reports.items():
            chosen = batch.take(np.array([row for row, _, _ in rows]))
            flags = {
                "crossed": np.array([c for _, c, _ in rows], dtype=np.uint8),
                "overflow": np.array([o for _, _, o in rows], dtype=np.uint8),
            }
            found["digests", name] = RecordBatch({**chosen, **flags})
        for name, told in counts.items():
            found["counts", name] = counts_of(told)
        return found

    def answer(self, question):
        """(what is answered or None, counts that are reported besides)."""
        if not question.sweep:
            return self.read(question), []
        ring = self.rings.get(question.bit, Ring())
        if question.time_us > self.base_us:
            ring.newest = (question.time_us - self.base_us) << 20
        ripe = [wait for wait in ring.waits if wait[1] < ring.newest]
        told = self._swept(question.bit, question.time_us) if ripe else []
        more = int(len(ripe) > 1)
        return (more if more or question.sweep == 2 else None), told

    def _swept(self, query, time_us):
        """The first that waits, if it is still over the threshold."""
        slot, _ = self.rings[query].waits.pop(0)
        cells, p = next(
            (cells, stage[1 << query])
            for stage, cells in zip(self.stages, self.cells, strict=True)
            if 1 << query in stage
        )
        epoch, key, count, _ = cells[slot]
        cells[slot] = (epoch, key, count, False)
        if count >= p["threshold"]:
            names = ("query", "source", "destination", "port", "length", "source_port")
            yield {
                **dict(zip(names, key, strict=True)),
                "window": epoch,
                "count": count - ZERO,
                "time_us": time_us,
            }

    def read(self, question):
        """The count of a cell; that of nothing where the key has none in the window."""
        packet = (question.source, question.destination, question.port, question.length, question.source_port)
        for stage, cells in zip(self.stages, self.cells, strict=True):
            if 1 << question.bit in stage:
                p = stage[1 << question.bit]
                key = (p.get("query", p.get("count_of")), *packet)
                epoch = (question.time_us - self.base_us) * p["reciprocal"] >> 64
                held = cells.get(self._slot(key, epoch, p), (-1, None, 0, False))
                return held[2] if held[:2] == (epoch, key) else ZERO * ("count_of" in p)
        raise AssertionError(question)

    def _slot(self, key, epoch, p):
        if not self.shrink:
            return key, epoch & 1
        return (
            p["base"]
            + crc32(repr(key).encode()) % max(1, p["size"] // self.shrink)
            + CELLS // 2 * (epoch & 1)
        )

    def _count(self, matched, packet):
        crossed, overflow, passed, ripe = set(), set(), set(), None
        source, destination, port, length, now = numbers(packet, self.base_us)
        source_port = max(int(packet["tcp_sport"]), int(packet["udp_sport"]), 0)
        for stage, cells in zip(self.stages, self.cells, strict=True):
            hit = [params for bit, params in stage.items() if bit.bit_length() - 1 in matched]
            assert len(hit) <= 1, "two entries of one stage match one frame"
            if not hit:
                continue
            p = hit[0]
            if "looks" in p:
                passed.add(self._gate(p, cells, packet).bit_length() - 1)
                continue
            if "count_of" in p:
                if not self._differ(p, cells, packet, now):
                    overflow.add(p["bit_of_query"].bit_length() - 1)
                ring = self.rings.get(p["count_of"])
                if ring is not None and ring.waits and ring.waits[0][1] < ring.newest:
                    ripe = p["count_of"]
                continue
            key = (
                p["query"],
                source & p["source_mask"],
                destination & p["destination_mask"],
                port & p["port_mask"],
                length & p["length_mask"],
                source_port & p["source_port_mask"],
            )
            epoch = now * p["reciprocal"] >> 64
            slot = self._slot(key, epoch, p)
            held = cells.get(slot, (-1, None, 0, False))
            empty, mine = held[0] != epoch, held[0] == epoch and held[1] == key
            if empty or mine:
                before = held[2] if mine else 0
                after = before + (length if p["by_bytes"] else 1)
                cells[slot] = (epoch, key, after, False)
                if p["threshold"] and before < p["threshold"] <= after:
                    crossed.add(p["query"])
            else:
                overflow.add(p["query"])
            if not empty:
                matched -= {bit for bit in range(256) if p["repeated"] >> bit & 1}
        return crossed, overflow, passed - {-1}, ripe

    def _gate(self, p, cells, packet):
        """Map of the query that gets the frame."""
        source, destination, _, _, now = numbers(packet, self.base_us)
        if p["answers"]:
            source, destination = destination, source
        key = (p["query"], source & p["source_mask"], destination & p["destination_mask"])
        epoch = now * p["reciprocal"] >> 64
        slot = self._slot(key, epoch, p)
        held = cells.get(slot, (-1, None, 0, False))
        if held[0] == epoch and held[1] != key:
            return p["uncounted"]
        count = held[2] if held[0] == epoch else 0
        if not p["looks"]:
            count += 1
            cells[slot] = (epoch, key, count, False)
        return p["opens"] if count >= p["threshold"] else 0

    def _differ(self, p, cells, packet, now):
        """Count up or down; returns whether the key has a cell."""
        source, destination, port, length, _ = numbers(packet, self.base_us)
        source_port = max(int(packet["tcp_sport"]), int(packet["udp_sport"]), 0)
        if p["answers"]:
            source, destination, port, source_port = destination, source, source_port, port
        key = (
            p["count_of"],
            source & p["source_mask"],
            destination & p["destination_mask"],
            port & p["port_mask"],
            length & p["length_mask"],
            source_port & p["source_port_mask"],
        )
        epoch = now * p["reciprocal"] >> 64
        ring = self.rings.get(p["count_of"], Ring())
        if ring.generation != p["generation"]:
            ring = self.rings[p["count_of"]] = Ring(p["generation"])
        ring.newest = max(ring.newest, epoch)
        slot = self._slot(key, epoch, p)
        held = cells.get(slot, (-1, None, ZERO, False))
        mine = held[:2] == (epoch, key)
        marked = held[3] == p["generation"]
        if not mine and (held[0] == epoch or marked):
            return False
        step = length if p["by_bytes"] else 1
        count = (held[2] if mine else ZERO) + (-step if p["subtracts"] else step)
        waits = mine and marked
        if count >= p["threshold"] and not waits:
            ring.waits.append((slot, epoch))
            waits = True
        cells[slot] = (epoch, key, count, p["generation"] if waits else 0)
        return True


def counts_of(told):
    """What the controller publishes of reports at a window's end."""
    low = (1 << 64) - 1
    return RecordBatch(
        {
            "window": np.array([each["window"] for each in told], dtype=np.uint32),
            "count": np.array([each["count"] for each in told], dtype=np.int64),
            "src_hi": np.array([each["source"] >> 64 for each in told], dtype=np.uint64),
            "src_lo": np.array([each["source"] & low for each in told], dtype=np.uint64),
            "dst_hi": np.array([each["destination"] >> 64 for each in told], dtype=np.uint64),
            "dst_lo": np.array([each["destination"] & low for each in told], dtype=np.uint64),
            "port": np.array([each["port"] for each in told], dtype=np.uint16),
            "length": np.array([each["length"] for each in told], dtype=np.uint16),
            "source_port": np.array([each["source_port"] for each in told], dtype=np.uint16),
            "time_us": np.array([each["time_us"] for each in told], dtype=np.int64),
        }
    )


def numbers(packet, base_us):
    """(source, destination, destination port, length, time) as the parser's metadata has them."""
    source = int(packet["ip_src_hi"]) << 64 | int(packet["ip_src_lo"])
    destination = int(packet["ip_dst_hi"]) << 64 | int(packet["ip_dst_lo"])
    port = max(int(packet["tcp_dport"]), int(packet["udp_dport"]), 0)
    return source, destination, port, int(packet["length"]) & 0xFFFF, int(packet["time_us"]) - base_us


def matches(conditions, packet):
    """Whether a frame meets the conditions of an offer."""
    source, destination, dport, _, _ = numbers(packet, 0)
    fields = {
        "protocol": max(int(packet["ip_proto"]), 0),
        "l4_valid": int(
            max(packet["tcp_dport"], packet["udp_dport"], packet["icmp_type"], packet["icmp6_type"]) >= 0
        ),
        "ethertype": int(packet["eth_type"]) if packet["ip_version"] or packet["arp_op"] >= 0 else 0,
        "tcp_flags": int(packet["tcp_flags"]),
        "sport": max(int(packet["tcp_sport"]), int(packet["udp_sport"]), 0),
        "dport": dport,
        "vid": max(int(packet["vlan"]), 0),
        "ingress_port": int(packet["port"]),
    }
    for name, value in conditions.items():
        if name in ("src", "dst"):
            network = ip_network(value)
            address = source if name == "src" else destination
            if packet["ip_version"] != network.version or address & int(network.netmask) != int(network[0]):
                return False
        elif name in ("sport", "dport"):
            if not value[0] <= fields[name] <= value[1]:
                return False
        else:
            wanted, mask = value if isinstance(value, list) else (value, -1)
            if fields[name] & mask != wanted:
                return False
    return True
