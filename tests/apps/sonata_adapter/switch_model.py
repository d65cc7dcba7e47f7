"""The classifier and the counting stages of p4/sdnator.p4, one frame at a time: slow and obvious.

Takes what the adapter tells the controller (offers, table updates) and returns what the controller
would publish: copied packets and reports, by name of the offer.
"""

from dataclasses import dataclass, field
from ipaddress import ip_network
from typing import Any
from zlib import crc32

import numpy as np

from due import RecordBatch

CELLS = 65_536


@dataclass
class SwitchModel:
    """A switch; `base_us` is its clock zero."""

    base_us: int = 0
    offers: dict[str, Any] = field(default_factory=dict)
    stages: list[dict[int, dict[str, int]]] = field(default_factory=lambda: [{} for _ in range(8)])
    cells: list[dict[Any, Any]] = field(default_factory=lambda: [{} for _ in range(8)])
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
        for row in range(len(batch)):
            packet = {name: batch[name][row] for name in batch.columns}
            matched = {o["bit"] for o in self.offers.values() if matches(o["conditions"], packet)}
            for offer in self.offers.values():
                if offer["copy"] and offer["bit"] in matched:
                    copies.setdefault(offer["name"], []).append(row)
            crossed, overflow = self._count(set(matched), packet)
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
        return found

    def read(self, question):
        """The count of a cell, 0 where the key has none in the window."""
        packet = (question.source, question.destination, question.port, question.length, question.source_port)
        for stage, cells in zip(self.stages, self.cells, strict=True):
            if 1 << question.bit in stage:
                p = stage[1 << question.bit]
                key = (p["query"], *packet)
                epoch = (question.time_us - self.base_us) * p["reciprocal"] >> 64
                held = cells.get(self._slot(key, epoch, p), (-1, None, 0))
                return held[2] if held[:2] == (epoch, key) else 0
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
        crossed, overflow = set(), set()
        source, destination, port, length, now = numbers(packet, self.base_us)
        source_port = max(int(packet["tcp_sport"]), int(packet["udp_sport"]), 0)
        for stage, cells in zip(self.stages, self.cells, strict=True):
            hit = [params for bit, params in stage.items() if bit.bit_length() - 1 in matched]
            assert len(hit) <= 1, "two entries of one stage match one frame"
            if not hit:
                continue
            p = hit[0]
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
            held = cells.get(slot, (-1, None, 0))
            empty, mine = held[0] != epoch, held[0] == epoch and held[1] == key
            if empty or mine:
                before = held[2] if mine else 0
                after = before + (length if p["by_bytes"] else 1)
                cells[slot] = (epoch, key, after)
                if p["threshold"] and before < p["threshold"] <= after:
                    crossed.add(p["query"])
            else:
                overflow.add(p["query"])
            if not empty:
                matched -= {bit for bit in range(256) if p["repeated"] >> bit & 1}
        return crossed, overflow


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
        "ethertype": int(packet["eth_type"]) if packet["ip_version"] else 0,
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
