"""C text -> loaded library: compiled once, kept by hash under a private cache directory."""

import hashlib
import os
import shutil
import stat
import tempfile
from pathlib import Path
from typing import Any

import cffi

from dataplane.compiler.sandboxed_cc import compile_confined
from dataplane.errors import CompilerError

FLAGS = ("-std=gnu11", "-O2", "-fPIC", "-shared", "-fno-strict-aliasing", "-w")
_COMPILERS = ("cc", "gcc", "clang")


def compiler() -> str | None:
    """Path of the C compiler: $CC, or the first of cc, gcc, clang."""
    chosen = os.environ.get("CC")
    candidates = (chosen, *_COMPILERS) if chosen else _COMPILERS
    return next((path for name in candidates if (path := shutil.which(name))), None)


def cache_directory() -> Path:
    """$XDG_CACHE_HOME/sdnator/dataplane (or under ~/.cache), for its owner only.

    Raises OSError where it cannot be made, or others could exchange what is in it.
    """
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    directory = Path(base) / "sdnator" / "dataplane"
    directory.mkdir(parents=True, exist_ok=True, mode=0o700)
    for place in (directory.parent, directory):
        status = place.lstat()
        if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid():
            raise PermissionError(f"{place} belongs to another user, or is not a folder")
        if status.st_mode & (0o077 if place == directory else 0o022):
            place.chmod(0o700)
    return directory


def compiled_library(text: str, declarations: str) -> tuple[Any, Any]:
    """(ffi, library) of a unit of C; compiles it unless the cache has it.

    Raises CompilerError where there is no compiler or it refuses the text.
    """
    cc = compiler()
    if cc is None:
        raise CompilerError("no C compiler found (tried $CC, cc, gcc, clang): install gcc")
    digest = hashlib.sha256("\0".join([text, cc, *FLAGS]).encode()).hexdigest()[:32]
    ffi = cffi.FFI()
    ffi.cdef(declarations)
    try:
        directory = cache_directory()
    except (OSError, RuntimeError):
        # no home: the library stays mapped after its directory is gone
        with tempfile.TemporaryDirectory(prefix="sdnator-") as temporary:
            return ffi, _opened(ffi, _compile(cc, text, Path(temporary), digest))
    path = directory / f"{digest}.so"
    if not _ours(path):
        path = _compile(cc, text, directory, digest)
    return ffi, _opened(ffi, path)


def _ours(path: Path) -> bool:
    """Whether it is there, and nobody else can have written it."""
    try:
        status = path.lstat()
    except OSError:
        return False
    plain = stat.S_ISREG(status.st_mode) and status.st_nlink == 1
    return plain and status.st_uid == os.geteuid() and not status.st_mode & 0o022


def _opened(ffi: cffi.FFI, path: Path) -> Any:
    if not _ours(path):
        raise CompilerError(f"{path} is not a file that only we can write: remove it")
    try:
        return ffi.dlopen(str(path))
    except OSError as error:
        raise CompilerError(f"the compiled program cannot be loaded: {error}; remove {path}") from error


def _compile(cc: str, text: str, directory: Path, digest: str) -> Path:
    path = directory / f"{digest}.so"
    made = compile_confined(cc, FLAGS, text)
    try:
        # written with mode 0600 under another name: nobody sees half a library
        with tempfile.NamedTemporaryFile(dir=directory, delete=False) as written:
            written.write(made)
        Path(written.name).replace(path)
    except OSError as error:
        raise CompilerError(f"{path} cannot be written: {error.strerror}") from error
    return path
