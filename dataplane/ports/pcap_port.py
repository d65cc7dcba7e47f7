"""A port on capture files: frames come out of one and go into another; no root needed.

Classic pcap with µs or ns stamps in either byte order, link type Ethernet.  Frames that were cut are
padded with zeros to their length on the wire.
"""

import struct
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from dataplane.ports.port import Arrived, PortCounters, PortError, Unanswering

_MICRO, _NANO = 0xA1B2C3D4, 0xA1B23C4D
_ETHERNET = 1
_SNAPLEN = 1 << 18
_FILE_HEADER = "IHHiIII"
_RECORD = "IIII"
_SECONDS = 0xFFFFFFFF
"""What a stamp has room for."""


class PcapReader:
    """Frames of a capture file, one after the other.

    Raises PortError where the file is missing or no such capture.
    """

    def __init__(self, path: Path) -> None:
        try:
            self._file = path.open("rb")
        except OSError as error:
            raise PortError(f"pcap port: cannot read {path}: {error.strerror}") from error
        header = self._file.read(24)
        for order in "<", ">":
            magic = struct.unpack(f"{order}I", header[:4])[0] if len(header) == 24 else 0
            if magic in (_MICRO, _NANO):
                break
        else:
            self._file.close()
            raise PortError(
                f"pcap port: {path} is not a pcap file; pcapng and gzip are not read here: convert it"
            )
        link = struct.unpack(order + _FILE_HEADER, header)[6] & 0xFFFF
        if link != _ETHERNET:
            self._file.close()
            raise PortError(f"pcap port: {path} has link type {link}, not Ethernet (1)")
        self._record = struct.Struct(order + _RECORD)
        self._divisor = 1000 if magic == _NANO else 1
        self._base_s: int | None = None

    def read(self) -> tuple[int, bytes] | None:
        """(µs since the first packet's whole second, frame), or None at the end of what is whole.

        The switch's clock has nothing before 0: a frame that is older than the first one's second gets that.
        """
        header = self._file.read(16)
        if len(header) < 16:
            return None
        seconds, fraction, captured, wire = self._record.unpack(header)
        if max(captured, wire) > _SNAPLEN:
            return None
        data = self._file.read(captured)
        if len(data) < captured:
            return None
        if self._base_s is None:
            self._base_s = seconds
        time_us = (seconds - self._base_s) * 1_000_000 + fraction // self._divisor
        return max(0, time_us), data.ljust(wire, b"\0")

    def close(self) -> None:
        self._file.close()


class PcapWriter:
    """A capture file with µs stamps; where writing fails it ends, and that is said once.

    Raises PortError where it cannot be created.
    """

    def __init__(self, path: Path) -> None:
        try:
            self._file: BinaryIO = path.open("wb")
        except OSError as error:
            raise PortError(f"pcap port: cannot write {path}: {error.strerror}") from error
        self._path = path
        self._ended = False
        self._file.write(struct.pack("<" + _FILE_HEADER, _MICRO, 2, 4, 0, 0, _SNAPLEN, _ETHERNET))

    def write(self, time_us: int, frame: bytes) -> bool:
        """One frame; False where the file has ended."""
        seconds, micro = divmod(time_us, 1_000_000)
        record = struct.pack("<" + _RECORD, seconds & _SECONDS, micro, len(frame), len(frame)) + frame
        if not self._ended:
            try:
                self._file.write(record)
            except OSError as error:
                self._end(error)
        return not self._ended

    def close(self) -> None:
        try:
            self._file.close()
        except OSError as error:
            self._end(error)

    def _end(self, error: OSError) -> None:
        if not self._ended:
            self._ended = True
            told = (
                f"dataplane: pcap port: cannot write {self._path}: {error.strerror}; the capture ends there"
            )
            with suppress(OSError):  # a log on the same disk is full, too
                print(told, file=sys.stderr, flush=True)


class PcapPort(Unanswering):
    """Frames arrive from `incoming`, what is sent goes to `outgoing`; either may be None.

    clock: the packets' clock in µs, for the stamps of what is sent
    """

    lossless = True

    def __init__(self, incoming: Path | None, outgoing: Path | None, clock: Callable[[], int]) -> None:
        self.counters = PortCounters()
        self._clock = clock
        self._reader = None if incoming is None else PcapReader(incoming)
        self._next = None if self._reader is None else self._reader.read()
        self._writer = None if outgoing is None else PcapWriter(outgoing)

    def fileno(self) -> int:
        return -1

    def waiting(self) -> bool:
        return self._next is not None

    def receive(self, limit: int) -> Arrived:
        frames: list[bytes] = []
        times: list[int] = []
        while self._reader is not None and self._next is not None and len(frames) < limit:
            time_us, frame = self._next
            times.append(time_us)
            frames.append(frame)
            self._next = self._reader.read()
        self.counters.received += len(frames)
        return Arrived(frames, times)

    def send(self, frame: bytes) -> None:
        if self._writer is None or self._writer.write(self._clock(), frame):
            self.counters.sent += 1
        else:
            self.counters.failed += 1

    def close(self) -> None:
        if self._reader is not None:
            self._reader.close()
        if self._writer is not None:
            self._writer.close()
