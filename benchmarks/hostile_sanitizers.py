"""Builds of our C under the address and undefined-behaviour sanitizers, for a process with their libraries.

hand-written C (Kitsune)      the library
generated C (switch program)  `sanitized_switches()`: what the compiler back end loads from then on

All are built once, before the processes start that load them, and kept beside the switch's own builds.
"""

import hashlib
import importlib
import os
import shutil
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import cffi

from apps.kitsune.kernel import SOURCES
from benchmarks.hostile_switch import PROGRAM
from dataplane.compiler import c_machine, layout
from dataplane.compiler.c_build import cache_directory
from dataplane.compiler.c_code import generate
from dataplane.v1model.program import load
from sdnator.p4_program import find

_FLAGS = (
    *("-shared", "-fPIC", "-g", "-O1", "-fno-strict-aliasing", "-fno-omit-frame-pointer", "-w"),
    *("-fsanitize=address,undefined", "-fno-sanitize-recover=all"),
)
_KERNEL = ("-ffp-contract=off", "-fno-builtin-pow")
_SWITCH = ("-std=gnu11", "-x", "c", "-")
BUILDS = "HOSTILE_BUILDS"
_QUARANTINE_MB = 16
"""Freed memory that the sanitizer keeps from being used again; its own 256 MB look like a leak until they are full."""
_LIBRARIES = ("libasan.so", "libubsan.so")


def is_sanitized(module: str) -> bool:
    """Whether its targets run with the sanitizers' libraries."""
    return bool(getattr(importlib.import_module(module), "SANITIZED", False))


def environment(folder: Path) -> dict[str, str]:
    """What a process needs that loads the builds of a folder."""
    paths = [
        subprocess.check_output([compiler(), f"-print-file-name={name}"], text=True).strip()
        for name in _LIBRARIES
    ]
    return {
        "LD_PRELOAD": " ".join(paths),
        "ASAN_OPTIONS": f"detect_leaks=0:abort_on_error=1:handle_segv=1:quarantine_size_mb={_QUARANTINE_MB}",
        BUILDS: str(folder),
    }


def builds() -> tuple[Path, float]:
    """All that the targets will load; where it is, and the seconds that it took (0 where it was there)."""
    began = time.monotonic()
    folder = cache_directory() / "sanitized"
    folder.mkdir(mode=0o700, exist_ok=True)
    programs = [load(path.read_bytes()) for path in (find().bmv2_json, PROGRAM.with_suffix(".json"))]
    texts = [generate(program, layout.make(program)).encode() for program in programs]
    work = [*((_SWITCH, text) for text in texts), (_kernel_arguments(), _kernel_text())]
    with ThreadPoolExecutor(len(work)) as pool:
        list(pool.map(lambda one: _built(one[0], one[1], folder), work))
    return folder, time.monotonic() - began


def compiler() -> str:
    """gcc; raises LookupError where there is none."""
    found = shutil.which("gcc")
    if found is None:
        raise LookupError("gcc is not installed: the C code cannot be built with sanitizers")
    return found


def _built(arguments: tuple[str, ...], text: bytes, folder: Path) -> Path:
    """A library, built once for its text."""
    version = subprocess.check_output([compiler(), "-dumpfullversion"])
    name = hashlib.sha256(b"\0".join([text, repr((_FLAGS, arguments)).encode(), version])).hexdigest()[:32]
    path = folder / f"{name}.so"
    if not path.exists():
        part = path.with_suffix(f".{os.getpid()}")
        subprocess.run([compiler(), *_FLAGS, *arguments, "-o", str(part), "-lm"], check=True, input=text)
        part.replace(path)
    return path


def _loaded(arguments: tuple[str, ...], text: bytes) -> Path:
    """One that was built before: the compiler does not run beside the sanitizers' libraries."""
    os.environ.pop("LD_PRELOAD", None)
    return _built(arguments, text, Path(os.environ[BUILDS]))


def _kernel_arguments() -> tuple[str, ...]:
    return (*_KERNEL, *map(str, SOURCES))


def _kernel_text() -> bytes:
    return b"".join(path.read_bytes() for path in sorted(SOURCES[0].parent.glob("*.[ch]")))


@cache
def kernel_library() -> Path:
    """Kitsune's C."""
    return _loaded(_kernel_arguments(), _kernel_text())


def sanitized_switches() -> None:
    """From now on switch programs of this process are loaded from such builds."""
    c_machine.compiled_library = _switch_library  # type: ignore[attr-defined]


def _switch_library(text: str, declarations: str) -> tuple[Any, Any]:
    ffi = cffi.FFI()
    ffi.cdef(declarations)
    return ffi, ffi.dlopen(str(_loaded(_SWITCH, text.encode())))
