"""From the typed tree to something that runs: generated C where a compiler is, generated Python elsewhere.

tree ── layout (what is kept of a packet) ── simplify (masks that do nothing) ── control (nested blocks)
                                                                 ├── python_code ── python_machine
                                                                 └── c_code ─────── c_machine
"""

import logging
from typing import Literal

from dataplane.compiler.c_build import compiler
from dataplane.compiler.c_machine import CMachine
from dataplane.compiler.machine import Machine
from dataplane.compiler.python_machine import PythonMachine
from dataplane.errors import CompilerError
from dataplane.v1model.tree import Program

_log = logging.getLogger(__name__)

Backend = Literal["auto", "c", "python"]


def build(program: Program, cpu_port: int, backend: Backend = "auto") -> Machine:
    """A machine for `program`.

    Raises CompilerError where backend="c" and the C cannot be built; "auto" then takes Python.
    """
    if backend == "python" or (backend == "auto" and compiler() is None):
        return PythonMachine(program, cpu_port)
    try:
        return CMachine(program, cpu_port)
    except CompilerError:
        if backend == "c":
            raise
        _log.warning("no generated C, running generated Python", exc_info=True)
        return PythonMachine(program, cpu_port)
