"""Programs and frames that several tests of the data plane use."""

from functools import cache
from pathlib import Path

from dataplane.compiler.c_machine import CMachine
from dataplane.compiler.machine import MachineMaker
from dataplane.v1model.program import load
from dataplane.v1model.tree import Program
from tests.naive.p4.python_machine import PythonMachine
from tests.requirements import shared_data

_HERE = Path(__file__).resolve().parent
MAKERS: tuple[MachineMaker, ...] = (PythonMachine, CMachine)
"""The compiler, and the oracle of the tests."""


@cache
def features() -> Program:
    """programs/features.p4: one byte of the frame chooses what happens."""
    return load((_HERE / "programs" / "features.json").read_text())


@cache
def sdnator() -> Program:
    return load((_HERE.parent.parent / "p4" / "sdnator.json").read_text())


@cache
def shared(name: str) -> Program:
    """One of the shared programs: small, sketch."""
    return load(shared_data(f"p4/{name}.json").read_text())


def fields(data: bytes) -> dict[str, int]:
    """The header of `frame`, read back."""
    places = {"what": (14, 1), "a": (15, 1), "b": (16, 1), "c": (17, 2), "d": (19, 4), "e": (23, 8)}
    places["result"] = (31, 2)
    return {name: int.from_bytes(data[at : at + n], "big") for name, (at, n) in places.items()}
