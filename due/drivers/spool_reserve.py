"""Disk space allocated in time, for frames that a full disk would not take.

    length, CRC-32, frame    length, CRC-32, frame    …    zeros

A file of fixed size, so that writing into it needs no room; it survives kill -9 of its process.  On file systems that
copy on write (btrfs, ZFS) allocating promises nothing.
"""

import logging
import os
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

import msgspec

from due.drivers.spool import DiskSpool
from due.errors import BackendError
from due.messages import PackedFrame

log = logging.getLogger("due.spool")

_HEAD = struct.Struct("<II")
_END = bytes(_HEAD.size)


class SpoolReserve:
    """A queue of frames in `path`, of `size` bytes; raises OSError where there is no room to allocate them."""

    def __init__(self, path: Path, size: int) -> None:
        self.path = path
        self.damaged = 0
        """Records that could not be read and are lost."""
        self._encode = msgspec.msgpack.Encoder().encode
        self._decode = msgspec.msgpack.Decoder(PackedFrame).decode
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            os.posix_fallocate(self._file, 0, size)
            self._size = os.fstat(self._file).st_size
            self._records = list(self._found())
        except BaseException:
            os.close(self._file)
            raise
        self._end = sum(self._records[-1]) if self._records else 0

    def _found(self) -> list[tuple[int, int]]:
        """Offset and length of each whole record that an earlier process left."""
        content, at, found = os.pread(self._file, self._size, 0), 0, []
        while at + _HEAD.size <= len(content):
            length, check = _HEAD.unpack_from(content, at)
            at += _HEAD.size
            if not length or zlib.crc32(content[at : at + length]) != check:
                break
            found.append((at, length))
            at += length
        return found

    def put(self, frames: Sequence[PackedFrame]) -> bool:
        """Append all of these frames, or none where there is no room for all."""
        made = [self._encode(frame) for frame in frames]
        data = b"".join(_HEAD.pack(len(each), zlib.crc32(each)) + each for each in made)
        if self._end + len(data) + len(_END) > self._size:
            return False
        try:
            written = os.pwrite(self._file, data + _END, self._end)
        except OSError as error:
            log.error("spool reserve %s: %s", self.path, error)  # noqa: TRY400 - no trace needed
            return False
        if written < len(data):
            return False
        for each in made:
            self._records.append((self._end + _HEAD.size, len(each)))
            self._end += _HEAD.size + len(each)
        return True

    def take(self, frames: int) -> list[PackedFrame]:
        """Up to `frames` of the oldest frames, which stay until `done`; damaged records are dropped."""
        found: list[PackedFrame] = []
        while len(found) < min(frames, len(self._records)):
            offset, length = self._records[len(found)]
            try:
                found.append(self._decode(os.pread(self._file, length, offset)))
            except (OSError, msgspec.MsgspecError, ValueError, TypeError, RecursionError) as error:
                log.error("spool reserve %s: a record is damaged: %s", self.path, error)  # noqa: TRY400
                self.damaged += 1
                del self._records[len(found)]
        return found

    def done(self, frames: int) -> None:
        """Remove that many of the oldest frames; after a kill they are delivered again until all are done."""
        del self._records[:frames]
        if not self._records:
            self._end = 0
            try:
                os.pwrite(self._file, _END, 0)
            except OSError as error:  # they are archived: the next start delivers them once more
                log.error("spool reserve %s: %s", self.path, error)  # noqa: TRY400 - no trace needed

    def __len__(self) -> int:
        return len(self._records)

    def close(self) -> None:
        """Close the file; what is in it stays for the next start."""
        os.close(self._file)


class ReservedSpool:
    """A `DiskSpool` that falls back to a reserve where the disk takes nothing.

    Args:
        folder: of both files, NAME.db and NAME.reserve.
        limit: bytes that the spool may take, besides the reserve.
        name: of both.
        reserve: bytes to allocate; 0: no reserve.

    Raises:
        BackendError: the spool cannot be opened.
    """

    def __init__(self, folder: Path, limit: int, name: str, reserve: int) -> None:
        self._reserve: SpoolReserve | None = None
        self._reserve_path = folder / f"{name}.reserve"
        self._reserve_bytes = reserve
        self._from_reserve = False
        self.allocate()
        try:
            self._disk = DiskSpool(folder, limit, name)
        except BaseException:
            self.close_reserve()
            raise
        self.path = self._disk.path

    def allocate(self) -> None:
        """Have the reserve, if there is room by now."""
        if self._reserve is not None or not self._reserve_bytes:
            return
        try:
            self._reserve = SpoolReserve(self._reserve_path, self._reserve_bytes)
        except OSError as error:
            log.warning("spool reserve %s cannot be allocated: %s; make room", self._reserve_path, error)

    def put(self, frames: Sequence[PackedFrame]) -> int:
        """See `Spool.put`."""
        try:
            return self._disk.put(frames)
        except BackendError:
            if self._reserve is not None and self._reserve.put(frames):
                return 0
            raise

    def take(self, frames: int) -> list[PackedFrame]:
        """See `Spool.take`."""
        self._from_reserve = not len(self._disk) and self._reserve is not None
        if self._from_reserve and self._reserve is not None:
            return self._reserve.take(frames)
        return self._disk.take(frames)

    def done(self, frames: int) -> None:
        """See `Spool.done`."""
        if self._from_reserve and self._reserve is not None:
            self._reserve.done(frames)
        else:
            self._disk.done(frames)

    def __len__(self) -> int:
        return len(self._disk) + (len(self._reserve) if self._reserve is not None else 0)

    @property
    def damaged(self) -> int:
        """See `Spool.damaged`."""
        return self._disk.damaged + (self._reserve.damaged if self._reserve is not None else 0)

    def close(self) -> None:
        """Close both files; what is in them stays for the next start."""
        self._disk.close()
        self.close_reserve()

    def close_reserve(self) -> None:
        """Close the reserve's file."""
        if self._reserve is not None:
            self._reserve.close()
            self._reserve = None
