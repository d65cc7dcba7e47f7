"""Fields in the bytes of a frame: DNS over UDP, and patterns in the payload.

`frame` is a column of fixed-width bytes (`V256`): the copied part of each frame, padded with zeros;
`captured` says how many of them are the frame's.  All reading is by column, no loop over packets.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from apps.sonata_adapter.host.byte_entropy import byte_entropy

_ETHERNET: Final = 14
_VLANS: Final = (0x8100, 0x88A8, 0x9100)
_TCP: Final = 6
_UDP: Final = 17
_TCP_HEADER: Final = 20
_DOT: Final = ord(".")
_LOWER_BYTES: Final = np.frombuffer(bytes(range(256)).lower(), dtype=np.uint8)
_UDP_HEADER: Final = 8
_PLAIN_HEADERS: Final = 34
_DNS_HEADER: Final = 12
_LABELS: Final = 128
_LOWER: Final = np.frombuffer(bytes(range(256)).lower(), dtype=np.uint8).astype(np.uint64)
_rng: Final = np.random.default_rng()
_WEIGHTS: Final = _rng.integers(0, 2**64, 512, dtype=np.uint64) | np.uint64(1)

Bytes = NDArray[np.uint8]
Numbers = NDArray[np.int64]


class FrameBytes:
    """The bytes of some frames and where their transport headers begin."""

    def __init__(self, frame: NDArray[Any], captured: NDArray[Any]) -> None:
        self._width = frame.dtype.itemsize
        self._bytes = np.ascontiguousarray(frame).view(np.uint8).reshape(len(frame), self._width)
        self._flat = self._bytes.reshape(-1)
        self._begin = np.arange(0, self._bytes.size, self._width)
        self._captured = np.minimum(captured.astype(np.int64), self._width)

    def byte(self, at: Numbers) -> Numbers:
        """The byte at an offset of each frame, 0 where it was not captured."""
        inside = (at >= 0) & (at < self._captured)
        if inside.all():
            whole: Numbers = self._flat[self._begin + at].astype(np.int64)
            return whole
        found = self._flat[self._begin + np.where(inside, at, 0)].astype(np.int64)
        found[~inside] = 0
        return found

    def short(self, at: Numbers) -> Numbers:
        """The big-endian 16-bit number at an offset."""
        return self.byte(at) << 8 | self.byte(at + 1)

    def _network(self) -> tuple[Numbers, Numbers]:
        """Offset of the header behind VLAN tags, and its EtherType."""
        at = np.full(len(self._begin), _ETHERNET, dtype=np.int64)
        kind = self.short(at - 2)
        for _ in range(2):
            tagged = np.isin(kind, _VLANS)
            at += 4 * tagged
            kind = np.where(tagged, self.short(at - 2), kind)
        return at, kind

    def _protocol(self) -> Numbers:
        at, kind = self._network()
        return np.where(kind == 0x0800, self.byte(at + 9), self.byte(at + 6))

    def _is_plain(self) -> bool:
        """Whether all are IPv4 without VLAN tags, options and fragments, as nearly all frames are."""
        first = self._bytes[:, 12:15]
        whole = (first == (0x08, 0x00, 0x45)).all() and not (self._bytes[:, 20] & 0x3F).any()
        return bool(whole) and not self._bytes[:, 21].any() and bool((self._captured >= _PLAIN_HEADERS).all())

    def transport(self) -> tuple[Numbers, Numbers]:
        """Offset of the transport header, -1 where there is none, and where the packet's bytes end."""
        if self._is_plain():
            total = self._bytes[:, 16].astype(np.int64) << 8 | self._bytes[:, 17]
            end = np.where(total == 0, self._captured, np.minimum(self._captured, _ETHERNET + total))
            return np.full(len(self._begin), _ETHERNET + 20, dtype=np.int64), end
        at, kind = self._network()
        four, six = kind == 0x0800, kind == 0x86DD
        header = np.where(four, (self.byte(at) & 0xF) * 4, 40)
        lengths = np.where(four, self.short(at + 2), self.short(at + 4) + 40)
        lengths = np.where(lengths == np.where(four, 0, 40), self._width, lengths)
        end = np.minimum(self._captured, at + lengths)
        # IPv6 extension headers are not followed: such packets have no payload fields
        plain = (four & (self.short(at + 6) & 0x1FFF == 0)) | (six & np.isin(self.byte(at + 6), (6, 17)))
        return np.where(plain, at + header, -1), end

    def dns(self) -> tuple[Numbers, Numbers, NDArray[np.uint64]]:
        """(response, question type, hash of the name) of frames that are known to be UDP port 53."""
        start, end = self._messages()
        whole = (start >= 0) & (start + _DNS_HEADER <= end)
        response = np.where(whole, self.byte(start + 2) >> 7, -1)
        asked = whole & (self.short(start + 4) > 0)
        name_at = np.where(asked, start + _DNS_HEADER, 0)
        name_end, _, _ = self._labels(name_at, end, asked)
        typed = asked & (name_end + 2 <= end)
        qtype = np.where(typed, self.short(name_end), -1)
        return response, qtype, self._name_hash(name_at, np.minimum(name_end, end), asked)

    def names(self) -> tuple[Numbers, Numbers]:
        """(length in bytes, entropy in thousandths of a bit a byte) of the first question's name, -1 for none.

        The name is as people write it: lower case, labels parted by dots, none at its end; as far as it was captured.
        """
        start, end = self._messages()
        asked = (start >= 0) & (start + _DNS_HEADER <= end) & (self.short(start + 4) > 0)
        name_at = np.where(asked, start + _DNS_HEADER, 0)
        name_end, closed, sizes_at = self._labels(name_at, end, asked)
        taken = np.minimum(name_end, end) - name_at
        size = np.where(asked, np.maximum(taken - 1 - closed, 0), -1)
        entropy = np.full(len(self._begin), -1, dtype=np.int64)
        rows = np.flatnonzero(asked)
        if len(rows):
            dotted = self._flat.copy()
            for place in sizes_at:
                dotted[place] = _DOT
            text = self._text(_LOWER_BYTES[dotted], rows, name_at[rows] + 1, int(size[rows].max()))
            entropy[rows] = byte_entropy(text, size[rows])
        return size, entropy

    def payloads(self, wire: NDArray[Any]) -> tuple[Numbers, Numbers]:
        """(length in bytes, entropy in thousandths of a bit a byte) of TCP and UDP payloads, -1 for none.

        The length is what the headers say, the entropy that of the bytes that were captured. `wire`: bytes of each
        frame on the wire, for packets whose header leaves their length open.
        """
        at, kind = self._network()
        transport, end = self.transport()
        protocol = self._protocol()
        four = kind == 0x0800
        lengths = np.where(four, self.short(at + 2), self.short(at + 4) + 40)
        lengths = np.where(lengths == np.where(four, 0, 40), wire.astype(np.int64) - at, lengths)
        tcp = protocol == _TCP
        header = np.where(tcp, (self.byte(transport + 12) >> 4) * 4, _UDP_HEADER)
        least = np.where(tcp, _TCP_HEADER, _UDP_HEADER)
        whole = (transport >= 0) & (tcp | (protocol == _UDP)) & (header >= least)
        whole &= transport + least <= self._captured
        size = np.where(whole, np.maximum(at + lengths - transport - header, 0), -1)
        entropy = np.full(len(self._begin), -1, dtype=np.int64)
        rows = np.flatnonzero(whole)
        if len(rows):
            start = (transport + header)[rows]
            held = np.clip(end[rows] - start, 0, size[rows])
            entropy[rows] = byte_entropy(self._text(self._flat, rows, start, int(held.max())), held)
        return size, entropy

    def _messages(self) -> tuple[Numbers, Numbers]:
        """Where the payloads of UDP datagrams begin, -1 where there is none, and where they end."""
        transport, end = self.transport()
        return np.where(transport >= 0, transport + _UDP_HEADER, -1), end

    def _text(self, flat: Bytes, rows: NDArray[np.intp], start: Numbers, size: int) -> Bytes:
        """`size` bytes of these frames from `start` on, one row for each frame; behind a frame its last byte."""
        places = np.minimum(start[:, None] + np.arange(size), self._width - 1)
        return np.asarray(flat[self._begin[rows][:, None] + places])

    def _labels(
        self, at: Numbers, end: Numbers, asked: NDArray[np.bool_]
    ) -> tuple[Numbers, NDArray[np.bool_], list[Numbers]]:
        """Offset behind the root label (beyond the captured bytes where the name is cut), whether the root label
        was captured, and the places of all labels' sizes among the bytes of all frames."""
        ends = at.copy()
        closed = np.zeros(len(at), dtype=np.bool_)
        sizes_at: list[Numbers] = []
        rows = np.flatnonzero(asked)
        place, limit, begin = at[rows], end[rows], self._begin[rows]
        for _ in range(_LABELS):
            inside = place < limit
            sizes = self._flat[begin + np.minimum(place, self._width - 1)].astype(np.int64)
            sizes[~inside] = 0
            sizes_at.append((begin + place)[inside])
            closed[rows[inside & (sizes == 0)]] = True
            place = place + sizes + 1
            walking = (sizes > 0) & (place < limit)
            if not walking.all():
                ends[rows] = place
                rows, place, limit, begin = (each[walking] for each in (rows, place, limit, begin))
            if not len(rows):
                break
        ends[rows] = place
        return ends, closed, sizes_at

    def _name_hash(self, start: Numbers, end: Numbers, asked: NDArray[np.bool_]) -> NDArray[np.uint64]:
        """64 bits of the name's captured bytes in lower case; 0 where there is none."""
        found = np.zeros(len(self._begin), dtype=np.uint64)
        rows = np.flatnonzero(asked)
        if not len(rows):
            return found
        sizes = (end - start)[rows]
        places = np.arange(int(sizes.max()))
        letters = _LOWER[self._letters(start[rows], rows, places)]
        letters[places >= sizes[:, None]] = 0
        mixed = letters @ _WEIGHTS[: len(places)] + sizes.astype(np.uint64) * _WEIGHTS[-1]
        found[rows] = mixed ^ (mixed >> np.uint64(31))
        return found

    def _letters(self, start: Numbers, rows: NDArray[np.intp], places: Numbers) -> Bytes:
        """Bytes of these frames from `start` on, one row for each frame."""
        first, end = int(start[0]), int(start[0]) + len(places)
        if end <= self._width and (start == first).all():
            return self._bytes[rows, first:end]
        return np.asarray(self._bytes[rows[:, None], np.minimum(start[:, None] + places, self._width - 1)])

    def payload_contains(self, pattern: bytes) -> NDArray[np.bool_]:
        """Whether the TCP or UDP payload, as far as captured, contains the pattern."""
        transport, end = self.transport()
        size = self._width - len(pattern) + 1
        if not pattern or size <= 0:
            return np.zeros(len(self._begin), dtype=np.bool_)
        found = np.ones((len(self._begin), size), dtype=np.bool_)
        for place, byte in enumerate(pattern):
            found &= self._bytes[:, place : place + size] == byte
        tcp_header = (self.byte(transport + 12) >> 4) * 4
        start = transport + np.where(self._protocol() == _TCP, tcp_header, _UDP_HEADER)
        places = np.arange(size)
        inside = (places >= start[:, None]) & (places + len(pattern) <= end[:, None])
        return (transport >= 0) & (found & inside).any(axis=1)
