"""Captures in and out: pcap (µs and ns, both byte orders), pcapng, and either of them gzipped.

    path ──(gunzip)──► records of pcap or pcapng ──► CapturedFrame(time_ns, length, data) …

A capture that ends in the middle of a record is no error: the complete records are used, and `Capture.cut`
tells where it ends.  The tests compare with scapy's raw readers.  They are not used here, because they hide
where a file is cut, skip packets silently and carry interfaces from one pcapng section to the next.

    CaptureError (BadInput, ValueError)
    ├── MissingCapture      no such file, a folder, or not readable
    ├── NotACapture         neither pcap nor pcapng, or damaged before the first packet
    ├── UnsupportedLink     frames are not Ethernet
    └── EmptyCapture        a valid capture without packets
"""

import errno
import gzip
import io
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self, cast

from sdnator.capture.pcap_records import (
    GZIP_MAGIC,
    LINK_ETHERNET,
    MAX_FRAME,
    PCAP_MAGICS,
    PCAPNG_MAGIC,
    CapturedFrame,
    Damage,
    GunzipStream,
    WrongLink,
    read_pcap,
    read_pcapng,
)
from sdnator.errors import BadInput

__all__ = [
    "Capture",
    "CaptureError",
    "CaptureWriter",
    "CapturedFrame",
    "CutCapture",
    "EmptyCapture",
    "MissingCapture",
    "NotACapture",
    "UnsupportedLink",
]

_BUFFER = 1 << 20
MAX_PACKETS = 100_000_000
"""Most packets of one capture: times, lengths, senders and states are held in memory (60 bytes each)."""


class CaptureError(BadInput, ValueError):
    """A capture that cannot be used; the text says what, where and what to do."""


class MissingCapture(CaptureError):
    """No such file, a folder, or not readable."""


class NotACapture(CaptureError):
    """Neither pcap nor pcapng, or damaged before its first packet."""


class UnsupportedLink(CaptureError):
    """Frames are not Ethernet."""


class EmptyCapture(CaptureError):
    """A valid capture without packets."""


@dataclass(frozen=True)
class CutCapture:
    """Where a damaged or truncated capture ends."""

    path: Path
    offset: int
    """Byte of the (unpacked) capture at which the first incomplete record begins."""
    packets: int
    """Complete packets before it."""
    reason: str
    unpacked: bool

    def __str__(self) -> str:
        where = f"byte {self.offset:,}" + (" of the unpacked capture" if self.unpacked else "")
        return f"{self.path}: cut off at {where}: {self.reason}; the {self.packets:,} complete packets before it are used"


class Capture:
    """A capture opened for one reading, first packet to last.

    >>> with Capture("mirai.pcap") as capture:      # doctest: +SKIP
    ...     for time_ns, length, data in capture:
    ...         ...
    ...     if capture.cut:
    ...         print(capture.cut)

    Args:
        path: pcap or pcapng, or either gzipped; told by content, not by name.

    Raises:
        MissingCapture, NotACapture, UnsupportedLink, EmptyCapture: at once, before the first packet.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.packets = 0
        """Packets read so far."""
        self.cut: CutCapture | None = None
        """Known once the last packet has been read."""
        self._file = _open(self.path)
        try:
            self.size = os.fstat(self._file.fileno()).st_size
            self._gunzip: GunzipStream | None = None
            self.plain = False
            """The file is pcap, and not gzipped."""
            self._records = self._start()
            self._first = self._first_frame()
        except OSError as error:
            self._file.close()
            raise MissingCapture(f"{self.path}: cannot be read ({error.strerror}); copy it again") from None
        except BaseException:
            self._file.close()
            raise

    @property
    def first_time_ns(self) -> int:
        """Time of the first packet, ns since the epoch (UTC)."""
        return self._first.time_ns

    @property
    def position(self) -> int:
        """How many of the file's `size` bytes have been read: for progress bars."""
        return self._file.tell()

    def __iter__(self) -> Iterator[CapturedFrame]:
        if self.packets == 0:
            self.packets = 1
            yield self._first
        try:
            for frame in self._records:
                self.packets += 1
                if self.packets > MAX_PACKETS:
                    raise self._too_long()
                yield frame
        except OSError as error:
            raise MissingCapture(
                f"{self.path}: cannot be read after {self.packets:,} packets ({error.strerror}); copy it again"
            ) from None
        except Damage as damage:
            self._note(damage.offset, damage.reason)
        except WrongLink as error:
            raise self._wrong_link(error) from None
        if self.cut is None and self._gunzip is not None and self._gunzip.fault:
            self._note(self._gunzip.delivered, self._gunzip.fault)

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _start(self) -> Iterator[CapturedFrame]:
        stream = self._file
        if stream.peek(2)[:2] == GZIP_MAGIC:
            self._gunzip = GunzipStream(stream)
            stream = io.BufferedReader(self._gunzip, _BUFFER)
        magic = stream.read(4)
        if magic in PCAP_MAGICS:
            self.plain = self._gunzip is None
            return read_pcap(stream, magic)
        if magic == PCAPNG_MAGIC:
            return read_pcapng(stream)
        if not self.size:
            raise EmptyCapture(f"{self.path}: the file is empty; give a pcap or pcapng capture with packets")
        raise NotACapture(
            f"{self.path}: not a capture (it begins with {magic.hex(' ') or 'nothing'}); "
            "give a pcap or pcapng file, plain or gzipped"
        )

    def _first_frame(self) -> CapturedFrame:
        try:
            first = next(self._records, None)
        except Damage as damage:
            raise NotACapture(
                f"{self.path}: no complete packet in it: {damage.reason} (byte {damage.offset:,}); "
                "write or copy the capture again"
            ) from None
        except WrongLink as error:
            raise self._wrong_link(error) from None
        if first is None:
            raise EmptyCapture(f"{self.path}: a capture with no packets; record it again or give another")
        return first

    def _note(self, offset: int, reason: str) -> None:
        fault = self._gunzip.fault if self._gunzip is not None else ""
        text = f"{reason} ({fault})" if fault and fault != reason else reason
        self.cut = CutCapture(self.path, offset, self.packets, text, self._gunzip is not None)

    def _too_long(self) -> CaptureError:
        return CaptureError(
            f"{self.path}: more than {MAX_PACKETS:,} packets; split it, for instance with `editcap -c {MAX_PACKETS}`"
        )

    def _wrong_link(self, error: WrongLink) -> UnsupportedLink:
        return UnsupportedLink(
            f"{self.path}: frames of link type {error.link} after {self.packets:,} packets, not Ethernet (1); "
            "record on an Ethernet interface (not on `any`)"
        )


def _open(path: Path) -> io.BufferedReader:
    try:
        return io.BufferedReader(io.FileIO(path), _BUFFER)
    except FileNotFoundError:
        raise MissingCapture(f"{path}: no such file; check the path of the capture") from None
    except IsADirectoryError:
        raise MissingCapture(f"{path}: is a folder; give a capture file in it") from None
    except OSError as error:
        raise MissingCapture(f"{path}: cannot be read ({error.strerror}); check its permissions") from None


class CaptureWriter:
    """Write a pcap file, gzipped when the name ends in `.gz`; it gets its name only when it is complete.

    Args:
        path: replaced when it exists.
        nanoseconds: times in ns instead of µs (the rest is cut off).

    Raises:
        OSError: the folder is missing or not writable, or the path is a folder.
    """

    def __init__(self, path: str | os.PathLike[str], *, nanoseconds: bool = False) -> None:
        self.path = Path(path)
        self.packets = 0
        if self.path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        self._part = self.path.with_name(f".{self.path.name}.{os.getpid()}.part")
        self._tick = 1 if nanoseconds else 1_000
        raw = self._part.open("wb", buffering=_BUFFER)
        packed = self.path.suffix == ".gz"
        self._file = cast(BinaryIO, gzip.GzipFile("", "wb", 6, raw, mtime=0)) if packed else raw
        self._raw = raw
        magic = 0xA1B23C4D if nanoseconds else 0xA1B2C3D4
        self._file.write(struct.pack("<IHHiIII", magic, 2, 4, 0, 0, MAX_FRAME, LINK_ETHERNET))

    def write(self, time_ns: int, data: bytes, length: int | None = None) -> None:
        """Add a frame of `length` bytes on the wire (default: all of them are in `data`)."""
        seconds, fraction = divmod(time_ns, 1_000_000_000)
        wire = len(data) if length is None else length
        self._file.write(struct.pack("<4I", seconds, fraction // self._tick, len(data), wire))
        self._file.write(data)
        self.packets += 1

    def close(self) -> None:
        """Finish the file and give it its name."""
        self._file.close()
        self._raw.close()
        self._part.replace(self.path)

    def abort(self) -> None:
        """Delete the incomplete file."""
        self._file.close()
        self._raw.close()
        self._part.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()
