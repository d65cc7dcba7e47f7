"""Datagrams of exporters, byte by byte, and flow records from frames, for the tests of `examples/flow_records`."""

import struct
from collections.abc import Iterable, Sequence
from ipaddress import ip_address
from pathlib import Path

import numpy as np
from flow_records.columns import FLOW_COLUMNS

from apps.packets import read_frames
from due import RecordBatch
from sdnator.testing.query_traffic import TimedFrame

EXPORT_S = 1_700_000_000
UPTIME_MS = 3_600_000
SYN, ACK = 2, 16


def v5_record(
    src: str = "192.0.2.1",
    dst: str = "198.51.100.1",
    *,
    sport: int = 40_000,
    dport: int = 443,
    packets: int = 3,
    size: int = 180,
    first: int = UPTIME_MS - 5_000,
    last: int = UPTIME_MS - 1_000,
    flags: int = SYN | ACK,
    protocol: int = 6,
) -> bytes:
    """The 48 bytes of one record of NetFlow v5; interfaces 3 and 4, type of service 0x20."""
    addresses = ip_address(src).packed + ip_address(dst).packed + ip_address("192.0.2.254").packed
    counts = struct.pack("!HHIIII", 3, 4, packets, size, first, last)
    rest = struct.pack("!HHBBBBHHBBH", sport, dport, 0, flags, protocol, 0x20, 64_500, 64_501, 24, 24, 0)
    return addresses + counts + rest


def netflow5(
    *records: bytes,
    sequence: int = 0,
    uptime: int = UPTIME_MS,
    seconds: int = EXPORT_S,
    sampling: int = 0,
    engine: int = 0,
) -> bytes:
    """A datagram of NetFlow v5."""
    header = struct.pack("!HHIIIIBBH", 5, len(records), uptime, seconds, 0, sequence, 0, engine, sampling)
    return header + b"".join(records)


def flow_set(number: int, body: bytes, *, pad: bool = True) -> bytes:
    """A set of NetFlow v9 or IPFIX, padded to four bytes."""
    body += bytes(-len(body) % 4) if pad else b""
    return struct.pack("!HH", number, 4 + len(body)) + body


def template(number: int, *fields: tuple[int, ...]) -> bytes:
    """A template record: fields are (element, width) or (element, width, enterprise)."""
    return struct.pack("!HH", number, len(fields)) + b"".join(_specifier(field) for field in fields)


def v9_options(number: int, scopes: Sequence[tuple[int, int]], fields: Sequence[tuple[int, int]]) -> bytes:
    """An options template record of NetFlow v9."""
    head = struct.pack("!HHH", number, 4 * len(scopes), 4 * len(fields))
    return head + b"".join(_specifier(field) for field in (*scopes, *fields))


def ipfix_options(number: int, scopes: int, *fields: tuple[int, ...]) -> bytes:
    """An options template record of IPFIX; the first `scopes` fields are scopes."""
    head = struct.pack("!HHH", number, len(fields), scopes)
    return head + b"".join(_specifier(field) for field in fields)


def _specifier(field: tuple[int, ...]) -> bytes:
    if len(field) == 2:
        return struct.pack("!HH", *field)
    element, width, enterprise = field
    return struct.pack("!HHI", element | 0x8000, width, enterprise)


def netflow9(
    *sets: bytes, sequence: int = 0, uptime: int = UPTIME_MS, seconds: int = EXPORT_S, source: int = 0
) -> bytes:
    """A datagram of NetFlow v9."""
    return struct.pack("!HHIIII", 9, len(sets), uptime, seconds, sequence, source) + b"".join(sets)


def ipfix(*sets: bytes, sequence: int = 0, seconds: int = EXPORT_S, domain: int = 0) -> bytes:
    """A message of IPFIX."""
    body = b"".join(sets)
    return struct.pack("!HHIII", 10, 16 + len(body), seconds, sequence, domain) + body


def structure(kind: int, body: bytes) -> bytes:
    """A sample or a record of sFlow v5: format, length, contents."""
    return struct.pack("!II", kind, len(body)) + body


def raw_header(frame: bytes, length: int = 0, protocol: int = 1) -> bytes:
    """sFlow: the first bytes of a sampled frame."""
    padded = frame + bytes(-len(frame) % 4)
    return structure(1, struct.pack("!IIII", protocol, length or len(frame), 4, len(frame)) + padded)


def flow_sample(*records: bytes, rate: int = 512, number: int = 1) -> bytes:
    """sFlow: a flow sample; interfaces 3 and 4."""
    head = struct.pack("!IIIIIII", number, 3, rate, 10_000, 0, 3, 4)
    return structure(1, head + struct.pack("!I", len(records)) + b"".join(records))


def expanded_sample(*records: bytes, rate: int = 512, number: int = 1) -> bytes:
    """sFlow: the same with full interface numbers."""
    head = struct.pack("!IIIIIIIIII", number, 0, 3, rate, 10_000, 0, 0, 70_000, 0, 4)
    return structure(3, head + struct.pack("!I", len(records)) + b"".join(records))


def sflow5(*samples: bytes, sequence: int = 1, agent: str = "192.0.2.254", sub_agent: int = 0) -> bytes:
    """A datagram of sFlow v5."""
    address = ip_address(agent)
    head = struct.pack("!II", 5, 1 if address.version == 4 else 2) + address.packed
    return head + struct.pack("!IIII", sub_agent, sequence, UPTIME_MS, len(samples)) + b"".join(samples)


def address(text: str) -> tuple[int, int]:
    """Upper and lower half of an address, as in columns."""
    number = int(ip_address(text))
    return number >> 64, number & (1 << 64) - 1


def row(flows: RecordBatch, place: int = 0) -> dict[str, int]:
    """One record as plain numbers."""
    return {name: int(flows[name][place]) for name in flows}


def flows_of(frames: Iterable[TimedFrame], *, export_us: int | None = None) -> RecordBatch:
    """Flow records of IP frames, as an exporter without time-outs makes them: one for each five-tuple.

    Args:
        frames: in the order of time.
        export_us: when they are exported; None: with the last packet of each flow.
    """
    kept = list(frames)
    packets = read_frames(
        [frame.data for frame in kept],
        lengths=[frame.length for frame in kept],
        times_us=[frame.time_us for frame in kept],
        ports=np.ones(len(kept), dtype=int),
        sequence=np.arange(len(kept)),
        arrival=np.arange(len(kept)),
    )
    found: dict[tuple[int, ...], dict[str, int]] = {}
    for place in np.flatnonzero(packets["ip_version"]).tolist():
        here = row(packets, place)
        own = not here["quoted"]
        flow = {
            **{name: here[name] for name in FLOW_COLUMNS if name in here},
            "src_port": max(here["tcp_sport"], here["udp_sport"]) if own else -1,
            "dst_port": max(here["tcp_dport"], here["udp_dport"]) if own else -1,
            "icmp_type": max(here["icmp_type"], here["icmp6_type"]),
            "icmp_code": max(here["icmp_code"], here["icmp6_code"]),
            "tos": 0,
            "sampling": 1,
            "packets": 0,
            "bytes": 0,
            "input": 1,
            "output": 2,
            "tcp_flags": 0,
            "first_us": here["time_us"],
        }
        names = (
            "ip_src_hi",
            "ip_src_lo",
            "ip_dst_hi",
            "ip_dst_lo",
            "ip_proto",
            "src_port",
            "dst_port",
            "icmp_type",
        )
        flow = found.setdefault(tuple(flow[name] for name in names), flow)
        flow["packets"] += 1
        flow["bytes"] += here["length"]
        flow["tcp_flags"] |= here["tcp_flags"]
        flow["last_us"] = here["time_us"]
        flow["time_us"] = here["time_us"] if export_us is None else export_us
    rows = list(found.values())
    return RecordBatch(
        {name: np.array([flow[name] for flow in rows], dtype=kind) for name, kind in FLOW_COLUMNS.items()}
    )


def write_pcap(path: Path, frames: Iterable[TimedFrame]) -> None:
    """A capture of these frames."""
    with path.open("wb") as file:
        file.write(struct.pack("!IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65_535, 1))
        for frame in frames:
            seconds, micros = divmod(frame.time_us, 1_000_000)
            file.write(struct.pack("!IIII", seconds, micros, len(frame.data), frame.length) + frame.data)
