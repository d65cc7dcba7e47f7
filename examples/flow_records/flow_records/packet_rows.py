"""Flow records as packets, so that what works on packets works on flows: a bridge, with counts.

    flow ─► groups of packets alike (`packets` each): SYN, FIN, RST, all others ─► as many packet rows, up to a limit

A record has the flags of all its packets together.  A TCP flow of several packets therefore becomes one SYN, one FIN
and one RST, of those that are among its flags, and for the rest packets without them.  Whether a flow with SYN and ACK
began the connection or answered is not in the record: of two records that face each other the earlier one began, else
the side with the lower port is taken for the server.

Rows have mean lengths, and times spread evenly between the flow's first and last packet.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from apps.packets import PACKET_COLUMNS
from due import RecordBatch

DEFAULT_MOST: Final = 1 << 16
_FIN, _SYN, _RST, _PSH, _ACK = 1, 2, 4, 8, 16
_TCP, _UDP, _UDP_LITE, _ICMP, _ICMP6 = 6, 17, 136, 1, 58
_ETHERTYPES: Final = {4: 0x0800, 6: 0x86DD}
_LONGEST: Final = (1 << 32) - 1

_Numbers = NDArray[Any]
_Mask = NDArray[np.bool_]


def packet_groups(flows: RecordBatch) -> RecordBatch:
    """Packets of a flow that are alike, as one row.

    Args:
        flows: columns of `FLOW_COLUMNS`.

    Returns:
        The packet columns, with the group's first packet in `time_us` and the mean in `length`; and `last_us`,
        `packets` and `bytes` (u8): how many packets a row stands for, and their bytes. Groups of one flow follow each
        other.
    """
    packets = np.maximum(flows["packets"], 1)
    rows, flags, counts, at_start, at_end = _split(flows, packets)
    columns = _same(flows, rows)
    columns["tcp_flags"] = flags.astype(np.uint8)
    columns["packets"] = counts
    mean = flows["bytes"] // packets
    columns["bytes"] = _shared(flows["bytes"], mean, rows, counts)
    columns["length"] = np.minimum(mean[rows], _LONGEST).astype(np.uint32)
    first, last = flows["first_us"][rows], flows["last_us"][rows]
    columns["time_us"] = np.where(at_end, last, first)
    columns["last_us"] = np.where(at_start, first, last)
    return RecordBatch(columns)


def single_packets(groups: RecordBatch, most: int = DEFAULT_MOST) -> RecordBatch:
    """A row for each packet, in order of time, with the columns of `apps.packets`.

    Args:
        groups: as `packet_groups` makes them.
        most: rows, if there are not more groups. Where there are more packets, each group gets fewer rows in
            proportion, at least one; its bytes are divided between these, so that sums of bytes stay.
    """
    counts, size = groups["packets"], len(groups)
    total = float(counts.sum(dtype=np.float64))
    if total > most:
        counts = np.maximum(counts * (most / total), 1)
    counts = counts.astype(np.int64)
    rows = np.repeat(np.arange(size), counts)
    place = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
    count = counts[rows]
    columns = {name: groups[name][rows] for name in PACKET_COLUMNS}
    length, rest = np.divmod(groups["bytes"][rows], count.astype(np.uint64))
    length += (place == 0) * rest
    columns["length"] = np.minimum(length, _LONGEST).astype(np.uint32)
    span = groups["last_us"][rows] - columns["time_us"]
    columns["time_us"] = columns["time_us"] + (span * ((2 * place + 1) / (2 * count))).astype(np.int64)
    order = np.argsort(columns["time_us"], kind="stable")
    found = {name: column[order] for name, column in columns.items()}
    found["arrival"] = np.arange(len(order), dtype=np.uint64)
    found["sequence"] = found["arrival"] + np.uint64(1)
    return RecordBatch(found)


def _split(flows: RecordBatch, packets: _Numbers) -> tuple[_Numbers, _Numbers, _Numbers, _Mask, _Mask]:
    """Rows of flows, and of each group its flags, its packets, and whether all are at the flow's start or end."""
    flags = np.where(flows["ip_proto"] == _TCP, flows["tcp_flags"], 0).astype(np.int64)
    sampled = np.minimum(flows["sampling"].astype(np.uint64), packets)
    answers = _answers(flows)
    mixed = _mixed(flags, answers) & (packets > sampled)
    acknowledged = flags & _ACK
    left = packets.copy()
    parts = []
    for flag, shown in (
        (_SYN, _SYN | np.where(answers, acknowledged, 0)),
        (_FIN, _FIN | acknowledged),
        (_RST, _RST | acknowledged),
    ):
        # a SYN that was seen in one of 100 packets stands for 100 SYNs
        rows = np.flatnonzero(mixed & (flags & flag != 0) & (left > 0))
        counts = np.minimum(sampled[rows], left[rows])
        left[rows] -= counts
        parts.append((rows, shown[rows], counts, flag))
    rest = np.flatnonzero(left > 0)
    plain = np.where(mixed, flags & ~(_SYN | _FIN | _RST), flags)
    parts.append((rest, plain[rest], left[rest], 0))
    rows = np.concatenate([part[0] for part in parts])
    kinds = np.concatenate([np.full(len(part[0]), part[3]) for part in parts])
    order = np.argsort(rows, kind="stable")
    shown = np.concatenate([part[1] for part in parts])[order]
    counts = np.concatenate([part[2] for part in parts])[order]
    kinds = kinds[order]
    return rows[order], shown, counts, kinds == _SYN, (kinds == _FIN) | (kinds == _RST)


def _answers(flows: RecordBatch) -> _Mask:
    """Whether a flow is that of the side that was called."""
    ends = [
        flows[name] for name in ("ip_src_hi", "ip_src_lo", "src_port", "ip_dst_hi", "ip_dst_lo", "dst_port")
    ]
    swapped = _is_less(ends[3:], ends[:3])
    keys = [
        *(np.where(swapped, there, here) for here, there in zip(ends[:3], ends[3:], strict=True)),
        *(np.where(swapped, here, there) for here, there in zip(ends[:3], ends[3:], strict=True)),
        flows["ip_proto"],
    ]
    lower: _Mask = flows["src_port"] < flows["dst_port"]
    order = np.lexsort(keys)
    if not len(order):
        return lower
    begins = np.logical_or.reduce([np.diff(key[order], prepend=key[order[:1]]) != 0 for key in keys])
    pair = np.empty(len(order), dtype=np.intp)
    pair[order] = np.cumsum(begins)
    first = np.full((pair.max() + 1, 2), np.iinfo(np.int64).max)
    np.minimum.at(first, (pair, swapped.astype(np.intp)), flows["first_us"])
    mine, theirs = first[pair, swapped.astype(np.intp)], first[pair, 1 - swapped.astype(np.intp)]
    facing = (theirs != np.iinfo(np.int64).max) & (mine != theirs)
    found: _Mask = np.where(facing, theirs < mine, lower)
    return found


def _is_less(left: list[_Numbers], right: list[_Numbers]) -> _Mask:
    """Comparison of tuples, element by element from the first."""
    found: _Mask = np.zeros(len(left[0]), dtype=np.bool_)
    for here, there in zip(reversed(left), reversed(right), strict=True):
        found = (here < there) | ((here == there) & found)
    return found


def _mixed(flags: _Numbers, answers: _Mask) -> _Mask:
    """Whether flags must come from packets of several kinds: not SYNs, ACKs, RSTs alone, nor unanswered SYN-ACKs."""
    several = flags & (_FIN | _SYN | _RST | _ACK)
    alone = (several & (several - 1)) == 0
    repeated = answers & ((flags & (_FIN | _SYN | _RST | _PSH | _ACK)) == (_SYN | _ACK))
    found: _Mask = (flags & (_FIN | _SYN | _RST) != 0) & ~alone & ~repeated
    return found


def _shared(total: _Numbers, mean: _Numbers, rows: _Numbers, counts: _Numbers) -> _Numbers:
    """Bytes of each group: the mean for each packet, and what remains for the first group of the flow."""
    shares: _Numbers = mean[rows] * counts
    first = np.flatnonzero(np.diff(rows, prepend=-1))
    spent = np.add.reduceat(shares, first) if len(first) else shares
    shares[first] += total[rows[first]] - spent
    return shares


def _same(flows: RecordBatch, rows: _Numbers) -> dict[str, _Numbers]:
    """Packet columns that all packets of a flow share; those that flows do not tell are absent."""
    size = len(rows)
    found: dict[str, _Numbers] = {
        name: flows[name][rows] if name in flows else np.full(size, -1 if kind[0] == "i" else 0, dtype=kind)
        for name, kind in PACKET_COLUMNS.items()
        if name not in ("icmp_type", "icmp_code")
    }
    protocol = found["ip_proto"]
    for name, protocols in (("tcp", (_TCP,)), ("udp", (_UDP, _UDP_LITE))):
        those = np.isin(protocol, protocols)
        for side in ("src", "dst"):
            column = f"{name}_{side[0]}port"
            found[column] = np.where(those, flows[f"{side}_port"][rows], -1).astype(np.int32)
    for name, number in (("icmp", _ICMP), ("icmp6", _ICMP6)):
        for part in ("type", "code"):
            told = np.where(protocol == number, flows[f"icmp_{part}"][rows], -1)
            found[f"{name}_{part}"] = told.astype(np.int32)
    for version, kind in _ETHERTYPES.items():
        found["eth_type"][found["ip_version"] == version] = kind
    found["port"] = np.minimum(flows["input"][rows], 0xFFFF).astype(np.uint16)
    return found
