"""Files of a data set by their content: what they are, whole or not, and members out of archives.

Everything streams: memory is bounded whatever an archive holds or claims.  Members are found by the names
that the catalogue expects and written under names of ours, so no path in an archive is ever followed.

    UnpackError (BadInput)      the text says what, where and what to do
"""

import bz2
import errno
import lzma
import re
import shutil
import zipfile
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import IO, Final, Literal

from sdnator.capture.pcap_records import GZIP_MAGIC, PCAP_MAGICS, PCAPNG_MAGIC
from sdnator.errors import BadInput

Content = Literal["gzip", "zip", "bzip2", "capture", "page", "text", "empty", "unknown"]
Progress = Callable[[int, int | None], None]

_CHUNK: Final = 1 << 20
_HEAD: Final = 512
_MOST_MEMBERS: Final = 100_000


class UnpackError(BadInput):
    """A file that is damaged or is not what it should be."""


def content_of(path: Path) -> Content:
    """What a file is, by its first bytes; raises UnpackError where it cannot be read."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
    except OSError as error:
        raise UnpackError(f"{path}: cannot be read ({error.strerror}); check the path") from None
    if not head:
        return "empty"
    for magic, kind in _MAGICS:
        if head.startswith(magic):
            return kind
    if re.match(rb"\s*<(!doctype|html|\?xml)", head, re.IGNORECASE):
        return "page"
    return "unknown" if b"\0" in head else "text"


_MAGICS: Final[tuple[tuple[bytes, Content], ...]] = (
    (GZIP_MAGIC, "gzip"),
    (b"PK\3\4", "zip"),
    (b"BZh", "bzip2"),
    (PCAPNG_MAGIC, "capture"),
    *((magic, "capture") for magic in PCAP_MAGICS),
)


def check_gzip(path: Path) -> int:
    """Read a gzip file to its end; returns the unpacked size in bytes, raises UnpackError where it is damaged."""
    size, unpacker = 0, zlib.decompressobj(wbits=31)
    with path.open("rb") as file:
        try:
            while packed := file.read(_CHUNK):
                while packed:
                    size += len(unpacker.decompress(packed, _CHUNK))
                    packed = unpacker.unconsumed_tail
                    if unpacker.eof and (packed := unpacker.unused_data.lstrip(b"\0")):
                        unpacker = zlib.decompressobj(wbits=31)
        except zlib.error as error:
            raise UnpackError(
                f"{path}: the gzip stream is damaged ({error}); fetch or copy it again"
            ) from None
    if not unpacker.eof:
        raise UnpackError(
            f"{path}: truncated: the gzip stream ends after {size:,} bytes; fetch or copy it again"
        )
    return size


def unpack_bzip2(path: Path, target: Path, progress: Progress = lambda _done, _total: None) -> None:
    """Unpack a bzip2 file to `target`, which appears when it is whole; raises UnpackError."""
    try:
        with bz2.open(path) as file:
            _copy(file, target, None, progress)
    except (OSError, EOFError) as error:
        if getattr(error, "errno", None):
            raise  # the disk's, not the file's
        raise UnpackError(
            f"{path}: the bzip2 stream is damaged or truncated ({error}); fetch it again"
        ) from None


def extract(
    archive: Path, wanted: Iterable[str], folder: Path, progress: Progress = lambda _done, _total: None
) -> list[Path]:
    """Take members out of a zip file, as many of `wanted` as are in it.

    Args:
        archive: a zip file of any size; it is read in place.
        wanted: base names; case, spaces and `_` do not matter, and the member may have `.gz` behind.
        folder: where the members go, under the wanted names.
        progress: called with bytes so far and in all, for each member anew.

    Returns:
        The files, in the order of `wanted`.

    Raises:
        UnpackError: no zip file, damaged, encrypted, or packed in a way that Python cannot unpack.
        OSError: `folder` cannot be written.
    """
    found = []
    try:
        with zipfile.ZipFile(archive) as file:
            members = _members(archive, file)
            for name in wanted:
                member = members.get(_plain(name))
                if member is not None:
                    suffix = ".gz" if member.filename.lower().endswith(".gz") else ""
                    found.append(_extract(archive, file, member, folder / f"{name}{suffix}", progress))
    except (zipfile.BadZipFile, NotImplementedError, UnicodeDecodeError, IndexError) as error:
        raise UnpackError(f"{archive}: an incomplete zip file ({error}); fetch or copy it again") from None
    return found


def _members(archive: Path, file: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    everything = file.infolist()
    if len(everything) > _MOST_MEMBERS:
        raise UnpackError(
            f"{archive}: {len(everything):,} members; no data set of the catalogue has that many"
        )
    return {
        _plain(Path(each.filename).name.removesuffix(".gz")): each for each in everything if not each.is_dir()
    }


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", name.lower())


def _extract(
    archive: Path, file: zipfile.ZipFile, member: zipfile.ZipInfo, target: Path, progress: Progress
) -> Path:
    free = shutil.disk_usage(target.parent).free
    if member.file_size > free:
        raise UnpackError(
            f"{target}: no room for {member.file_size:,} bytes out of {archive}, {free:,} are free; choose another "
            "folder with --into"
        )
    try:
        with file.open(member) as packed:
            _copy(packed, target, member.file_size, progress)
    except (NotImplementedError, RuntimeError) as error:
        raise UnpackError(
            f"{archive}: {member.filename} cannot be unpacked here ({error}); unpack it with unzip or 7z, and give "
            "the file with --from"
        ) from None
    except (zlib.error, lzma.LZMAError, EOFError, OSError) as error:
        # Python's bzip2 says the same of damaged data as the disk of itself, but without a number
        if isinstance(error, OSError) and error.errno not in (None, errno.EINVAL):
            raise
        raise UnpackError(
            f"{archive}: {member.filename} is damaged ({error}); fetch the archive again"
        ) from None
    return target


def _copy(source: IO[bytes] | bz2.BZ2File, target: Path, size: int | None, progress: Progress) -> None:
    part, done = target.with_name(f".{target.name}.part"), 0
    try:
        with part.open("wb") as file:
            while chunk := source.read(_CHUNK):
                file.write(chunk)
                done += len(chunk)
                progress(done, size)
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)
