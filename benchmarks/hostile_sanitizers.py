"""Builds of our C under the address and undefined-behaviour sanitizers, for a process with their libraries.

hand-written C (Kitsune)      the library, built once a process
generated C (switch program)  `sanitized_switches()`: what the compiler back end loads from then on
"""

import atexit
import hashlib
import importlib
import os
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import cffi

import apps.kitsune
from dataplane.compiler import c_machine

SOURCES = tuple(Path(apps.kitsune.__file__).with_name(name) for name in ("afterimage.c", "kitnet.c"))
_FLAGS = (
    *("-shared", "-fPIC", "-g", "-O1", "-fno-strict-aliasing", "-fno-omit-frame-pointer", "-w"),
    *("-fsanitize=address,undefined", "-fno-sanitize-recover=all"),
)
_KERNEL = ("-ffp-contract=off", "-fno-builtin-pow")
_BUILDS = "HOSTILE_BUILDS"
_LIBRARIES = ("libasan.so", "libubsan.so")


def environment_for(module: str) -> dict[str, str]:
    """What a process needs that runs the targets of a module; nothing where they are not sanitized."""
    if not getattr(importlib.import_module(module), "SANITIZED", False):
        return {}
    paths = [
        subprocess.check_output([compiler(), f"-print-file-name={name}"], text=True).strip()
        for name in _LIBRARIES
    ]
    return {
        "LD_PRELOAD": " ".join(paths),
        "ASAN_OPTIONS": "detect_leaks=0:abort_on_error=1:handle_segv=1",
        _BUILDS: str(_folder()),
    }


def compiler() -> str:
    """gcc; raises LookupError where there is none."""
    found = shutil.which("gcc")
    if found is None:
        raise LookupError("gcc is not installed: the C code cannot be built with sanitizers")
    return found


def _built(arguments: tuple[str, ...], text: bytes) -> Path:
    """A library, built once for its text."""
    name = hashlib.sha256(text + repr(arguments).encode()).hexdigest()[:32]
    path = _folder() / f"{name}.so"
    if not path.exists():
        clean = {name: value for name, value in os.environ.items() if name != "LD_PRELOAD"}
        part = path.with_suffix(f".{os.getpid()}")
        subprocess.run(
            [compiler(), *_FLAGS, *arguments, "-o", str(part), "-lm"], check=True, env=clean, input=text
        )
        part.replace(path)
    return path


@cache
def _folder() -> Path:
    """Private to this run: other users must not put libraries there."""
    given = os.environ.get(_BUILDS)
    if given:
        return Path(given)
    made = Path(tempfile.mkdtemp(prefix="hostile-builds-"))
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    return made


@cache
def kernel_library() -> Path:
    """Kitsune's C."""
    text = b"".join(path.read_bytes() for path in sorted(SOURCES[0].parent.glob("*.[ch]")))
    return _built((*_KERNEL, *map(str, SOURCES)), text)


def sanitized_switches() -> None:
    """From now on switch programs of this process are loaded from such builds."""
    c_machine.compiled_library = _switch_library  # type: ignore[attr-defined]


def _switch_library(text: str, declarations: str) -> tuple[Any, Any]:
    ffi = cffi.FFI()
    ffi.cdef(declarations)
    return ffi, ffi.dlopen(str(_built(("-std=gnu11", "-x", "c", "-"), text.encode())))
