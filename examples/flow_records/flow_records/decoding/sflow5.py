"""sFlow v5 (sflow.org, July 2004): headers of single sampled packets, as flow records of one packet.

Counter samples and other formats are stepped over.
"""

from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np

from apps.packets import read_frames
from due import RecordBatch
from flow_records.columns import Numbers, flow_batch
from flow_records.decoding.errors import FlowDecodeError

_ADDRESSES: Final = {1: 4, 2: 16}
"""Type of an address to its bytes."""
_FLOW_SAMPLE, _EXPANDED_FLOW_SAMPLE = 1, 3
_RAW_HEADER, _IPV4, _IPV6 = 1, 3, 4
_ETHERNET: Final = 1
_BARE: Final = {11: b"\x08\x00", 12: b"\x86\xdd"}
"""Header protocols without a link layer, and the EtherType that stands for them."""
_MOST_HEADER: Final = 1024
"""Bytes of a sampled header that are read."""
MOST_SAMPLES: Final = 1024
"""Samples of one datagram, and records of one sample."""
_INTERFACE: Final = 0x3FFF_FFFF


class SampledPacket(NamedTuple):
    """One packet that an agent looked at."""

    frame: bytes
    """Its first bytes, from Ethernet on; empty where the agent told fields only."""
    length: int
    rate: int
    input: int
    output: int
    fields: dict[str, int]
    """Columns of FLOW_COLUMNS that the agent told without a header."""


class SFlow5:
    """One datagram.

    Args:
        datagram: its bytes, the version included.

    Raises:
        FlowDecodeError: its structure is broken.
    """

    def __init__(self, datagram: bytes) -> None:
        words = _Words(datagram, 4, len(datagram))
        kind = words.number()
        if kind not in _ADDRESSES:
            raise FlowDecodeError("version", f"sFlow v5: an agent's address of type {kind}")
        agent = words.take(_ADDRESSES[kind])
        self.source = agent + words.take(4)
        """Agent and sub-agent: datagrams are numbered for each."""
        self.sequence = words.number()
        words.number()  # uptime: samples have no times of their own
        self.not_flows = 0
        """Flow samples that tell neither a header nor IP fields."""
        self._packets = list(self._samples(words))

    def flows(self, received_us: int, sampling: int) -> RecordBatch:
        """A record for each sampled packet.

        Args:
            received_us: when the datagram arrived, since it does not say when the packets did.
            sampling: rate where a sample says 0.
        """
        packets, size = self._packets, len(self._packets)
        found = _headers([packet.frame for packet in packets], [packet.length for packet in packets])
        for place, packet in enumerate(packets):
            for name, value in packet.fields.items():
                found[name][place] = value
        for name in ("time_us", "first_us", "last_us"):
            found[name] = np.full(size, received_us)
        found["packets"] = np.ones(size, dtype=np.uint64)
        found["bytes"] = np.array([packet.length for packet in packets], dtype=np.uint64)
        found["sampling"] = np.array([packet.rate or sampling for packet in packets], dtype=np.uint64)
        found["input"] = np.array([packet.input for packet in packets], dtype=np.uint64)
        found["output"] = np.array([packet.output for packet in packets], dtype=np.uint64)
        return flow_batch(size, found)

    def _samples(self, words: "_Words") -> Iterator[SampledPacket]:
        for kind, inner in words.structures("samples"):
            if kind not in (_FLOW_SAMPLE, _EXPANDED_FLOW_SAMPLE):
                continue
            packet = _sample(inner, expanded=kind == _EXPANDED_FLOW_SAMPLE)
            if packet is None:
                self.not_flows += 1
            else:
                yield packet
        if words.left:
            raise FlowDecodeError("length", f"sFlow v5: {words.left} bytes after the last sample")


class _Words:
    """XDR: numbers of four bytes, and bytes padded to a multiple of four."""

    def __init__(self, datagram: bytes, at: int, end: int) -> None:
        self._datagram = datagram
        self._at = at
        self._end = end

    @property
    def left(self) -> int:
        return self._end - self._at

    def number(self) -> int:
        return int.from_bytes(self.take(4), "big")

    def take(self, size: int) -> bytes:
        if size > self.left:
            raise FlowDecodeError("short", f"sFlow v5: {size} bytes are wanted where {self.left} are left")
        self._at += size
        return self._datagram[self._at - size : self._at]

    def opaque(self) -> "_Words":
        """The inside of bytes with their length before them."""
        size = self.number()
        start = self._at
        self.take(size + -size % 4)
        return _Words(self._datagram, start, start + size)

    def rest(self) -> bytes:
        return self.take(self.left)

    def structures(self, what: str) -> Iterator[tuple[int, "_Words"]]:
        """A number of structures, each with its format before it; those of enterprises have high numbers."""
        count = self.number()
        if count > MOST_SAMPLES:
            raise FlowDecodeError("limit", f"sFlow v5: {count} {what}; {MOST_SAMPLES} at most")
        for _ in range(count):
            kind = self.number()
            yield kind, self.opaque()


def _sample(words: _Words, *, expanded: bool) -> SampledPacket | None:
    """A flow sample; None: it says nothing about IP."""
    words.take(12 if expanded else 8)  # its number, and the data source
    rate = words.number()
    words.take(8)  # pool of packets, and drops
    input_port, output_port = (_expanded_port(words) if expanded else _port(words) for _ in range(2))
    frame, length, fields = b"", 0, dict[str, int]()
    for kind, inner in words.structures("records of a sample"):
        if kind == _RAW_HEADER:
            frame, length = _raw_header(inner)
        elif kind in (_IPV4, _IPV6) and not fields:
            fields = _told_fields(inner, kind)
    if frame:
        return SampledPacket(frame, length, rate, input_port, output_port, {})
    if not fields:
        return None
    return SampledPacket(b"", fields.pop("bytes"), rate, input_port, output_port, fields)


def _port(words: _Words) -> int:
    """An interface; 0 where it is none, or several."""
    number = words.number()
    return number if number < _INTERFACE else 0


def _expanded_port(words: _Words) -> int:
    kind, number = words.number(), words.number()
    return number if kind == 0 and number != 0xFFFF_FFFF else 0


def _raw_header(words: _Words) -> tuple[bytes, int]:
    """The frame's first bytes and its length; no bytes for link layers other than Ethernet."""
    protocol, length = words.number(), words.number()
    words.number()  # bytes that were stripped from the end
    header = words.opaque().rest()[:_MOST_HEADER]
    if protocol == _ETHERNET:
        return header, length
    if protocol in _BARE:
        return bytes(12) + _BARE[protocol] + header, length
    return b"", 0


def _told_fields(words: _Words, kind: int) -> dict[str, int]:
    """Fields of a packet where the agent tells no header; `bytes` is its IP length."""
    length, protocol = words.number(), words.number()
    width = 4 if kind == _IPV4 else 16
    source, destination = (int.from_bytes(words.take(width), "big") for _ in range(2))
    source_port, destination_port, flags, tos = (words.number() for _ in range(4))
    low = (1 << 64) - 1
    return {
        "bytes": length,
        "ip_version": 4 if kind == _IPV4 else 6,
        "ip_proto": protocol & 0xFF,
        "ip_src_hi": source >> 64,
        "ip_src_lo": source & low,
        "ip_dst_hi": destination >> 64,
        "ip_dst_lo": destination & low,
        "src_port": source_port & 0xFFFF,
        "dst_port": destination_port & 0xFFFF,
        "tcp_flags": flags & 0xFF,
        "tos": tos & 0xFF,
    }


def _headers(frames: list[bytes], lengths: list[int]) -> dict[str, Numbers]:
    """Columns from sampled headers."""
    size = len(frames)
    nothing = np.zeros(size, dtype=np.int64)
    packets = read_frames(
        frames, lengths=lengths, times_us=nothing, ports=nothing, sequence=nothing, arrival=nothing
    )
    found: dict[str, Any] = {name: packets[name].copy() for name in _SAME}
    own = packets["quoted"] == 0
    for name, tcp, udp in (("src_port", "tcp_sport", "udp_sport"), ("dst_port", "tcp_dport", "udp_dport")):
        found[name] = np.where(own, np.maximum(packets[tcp], packets[udp]), -1)
    for name in ("icmp_type", "icmp_code"):
        found[name] = np.maximum(packets[name], packets[name.replace("icmp", "icmp6")])
    found["tos"] = np.zeros(size, dtype=np.int64)
    return found


_SAME: Final = (
    *("ip_version", "ip_src_hi", "ip_src_lo", "ip_dst_hi", "ip_dst_lo", "ip_proto", "tcp_flags"),
    *("vlan", "eth_src", "eth_dst"),
)
