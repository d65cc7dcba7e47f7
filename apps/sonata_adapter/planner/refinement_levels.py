"""Prefixes of refinement: which address a query counts by, and what its prefixes are in the switch.

A level is a length of IPv4 prefixes; IPv6 prefixes are four times as long (8 → /32, 16 → /64).
"""

from collections.abc import Sequence
from ipaddress import ip_network
from typing import Final

import msgspec
import numpy as np

from apps.sonata_adapter.keys import QueryRequest
from apps.sonata_adapter.planner.conditions import Match
from apps.sonata_adapter.query.dataflow import Crossing, ReduceNode, compile_query
from apps.sonata_adapter.query.expressions import Field
from apps.sonata_adapter.query.language import Filter, Query
from apps.sonata_adapter.query.language import field as packet_field
from apps.sonata_adapter.query.parameters import UNREFINED
from due import RecordBatch

PARAMETER: Final = "refine"
_IPV4, _IPV6 = 0x0800, 0x86DD
_FAMILIES: Final = {_IPV4: (32, 1), _IPV6: (128, 4)}
"""EtherType to bits of an address, and by what a level is multiplied."""
_MASKS: Final = {"ip.src": "source_mask", "ip.dst": "destination_mask"}
_COLUMNS: Final = {"ip.src": "ip_src", "ip.dst": "ip_dst"}
_HALF: Final = 64


def levels_of(request: QueryRequest) -> tuple[int, ...]:
    """Levels that a key asks for, the whole address last; none: it asks for no refinement."""
    text = str(dict(request.values).get(PARAMETER, UNREFINED))
    return () if text == UNREFINED else tuple(int(part) for part in text.split("/"))


def address_of(query: Query) -> str:
    """The one address that a query counts by, `ip.src` or `ip.dst`; empty: it cannot be refined.

    Its count must only grow, or a prefix would not count as much as the addresses in it.
    """
    outcome = compile_query(query)
    if not isinstance(outcome, Crossing) or not isinstance(outcome.node, ReduceNode):
        return ""
    found = [key.name for key in outcome.node.keys if isinstance(key, Field) and key.name in _MASKS]
    return found[0] if len(found) == 1 else ""


def narrowed(query: Query, name: str, prefix: str) -> Query:
    """The query under another name, for packets whose address that it counts by is in a prefix; any: empty."""
    steps = query.steps
    if prefix:
        steps = (Filter(packet_field(address_of(query)).within(prefix).node), *steps)
    return msgspec.structs.replace(query, name=name, steps=steps)


def by_family(matches: Sequence[Match]) -> list[Match]:
    """The same conditions, each for IPv4 or for IPv6, whose prefixes are other bits."""
    return [
        {**match, "ethertype": family}
        for match in matches
        for family in _FAMILIES
        if match.get("ethertype", family) == family
    ]


def cut(
    masks: Sequence[tuple[str, int]], address: str, level: int, match: Match
) -> tuple[tuple[str, int], ...]:
    """Masks of a counting entry with the address cut to the level's prefix."""
    width, factor = _FAMILIES[match["ethertype"]]
    mask = (1 << width) - (1 << width - level * factor)
    return tuple((name, mask if name == _MASKS[address] else old) for name, old in masks)


def prefixes(batch: RecordBatch, address: str, level: int) -> dict[str, int]:
    """Prefixes of the packets' addresses, each with the time of its last packet (us)."""
    column = _COLUMNS[address]
    found: dict[str, int] = {}
    for version, (width, factor) in zip((4, 6), _FAMILIES.values(), strict=True):
        rows = np.flatnonzero(batch["ip_version"] == version)
        bits = level * factor
        high, low = batch[f"{column}_hi"][rows], batch[f"{column}_lo"][rows]
        whole = np.zeros(len(rows), dtype=[("high", np.uint64), ("low", np.uint64)])
        # a prefix of IPv6 has at most 124 bits, one of IPv4 at most 31, in the lower half
        in_high = min(bits, _HALF) if version == 6 else 0
        in_low = bits - in_high if version == 6 else _HALF - width + bits
        whole["high"] = high & np.uint64(_leading(in_high))
        whole["low"] = low & np.uint64(_leading(in_low))
        pairs, place = np.unique(whole, return_inverse=True)
        latest = np.zeros(len(pairs), dtype=np.int64)
        np.maximum.at(latest, place, batch["time_us"][rows])
        for pair, time_us in zip(pairs, latest.tolist(), strict=True):
            number = int(pair["high"]) << _HALF | int(pair["low"])
            found[str(ip_network((number.to_bytes(width // 8, "big"), bits)))] = time_us
    return found


def _leading(bits: int) -> int:
    """A 64-bit number whose first bits are set."""
    return (1 << _HALF) - (1 << _HALF - bits)
