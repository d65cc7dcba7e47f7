"""C text -> loaded library: compiled once, kept by hash under a private cache directory."""

import hashlib
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import cffi

from dataplane.errors import CompilerError

FLAGS = ("-std=gnu11", "-O2", "-fPIC", "-shared", "-fno-strict-aliasing", "-w")
_COMPILERS = ("cc", "gcc", "clang")
_TIMEOUT_S = 300


def compiler() -> str | None:
    """Path of the C compiler: $CC, or the first of cc, gcc, clang."""
    chosen = os.environ.get("CC")
    candidates = (chosen, *_COMPILERS) if chosen else _COMPILERS
    return next((path for name in candidates if (path := shutil.which(name))), None)


def cache_directory() -> Path:
    """$XDG_CACHE_HOME/sdnator/dataplane (or under ~/.cache), for its owner only.

    Raises OSError where it cannot be made or belongs to somebody else.
    """
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    directory = Path(base) / "sdnator" / "dataplane"
    directory.mkdir(parents=True, exist_ok=True, mode=0o700)
    status = directory.stat()
    if status.st_uid != os.getuid():
        raise PermissionError(f"{directory} belongs to another user")
    if status.st_mode & 0o077:
        directory.chmod(0o700)
    return directory


def compiled_library(text: str, declarations: str) -> tuple[Any, Any]:
    """(ffi, library) of a unit of C; compiles it unless the cache has it.

    Raises CompilerError where there is no compiler or it refuses the text.
    """
    cc = compiler()
    if cc is None:
        raise CompilerError(
            "no C compiler found (tried $CC, cc, gcc, clang): install one or use backend=python"
        )
    digest = hashlib.sha256("\0".join([text, cc, *FLAGS]).encode()).hexdigest()[:32]
    ffi = cffi.FFI()
    ffi.cdef(declarations)
    try:
        directory = cache_directory()
    except (OSError, RuntimeError):
        # no home: the library stays mapped after its directory is gone
        with tempfile.TemporaryDirectory(prefix="sdnator-") as temporary:
            return ffi, ffi.dlopen(str(_compile(cc, text, Path(temporary), digest)))
    path = directory / f"{digest}.so"
    if not path.exists():
        path = _compile(cc, text, directory, digest)
    return ffi, ffi.dlopen(str(path))


def _compile(cc: str, text: str, directory: Path, digest: str) -> Path:
    with tempfile.TemporaryDirectory(dir=directory) as work:
        source, built = Path(work) / "switch.c", Path(work) / "switch.so"
        source.write_text(text)
        command = [cc, *FLAGS, "-o", str(built), str(source)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise CompilerError(f"{cc} could not build the switch program: {error}") from error
        if done.returncode != 0:
            raise CompilerError(f"{cc} refused the generated C: {done.stderr[:2000]}")
        path = directory / f"{digest}.so"
        built.replace(path)
    return path
