"""CPU, memory and traffic of a process and all below it, from /proc."""

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

_HZ = os.sysconf("SC_CLK_TCK")


@dataclass
class Usage:
    """What processes of one name have used since they began, and hold now."""

    processes: int = 0
    cpu_s: float = 0.0
    kib: int = 0
    """Memory: the proportional share of what is shared included (PSS)."""
    read: int = 0
    """Bytes, from files and sockets."""
    written: int = 0


def usages(root: int, names: Mapping[int, str], *, memory: bool = False) -> dict[str, Usage]:
    """By name, of a process and all below it; memory only where it is asked for, since it costs time.

    Args:
        root: process id.
        names: of known processes, by id; others belong to the nearest known one above, but switches, which are spares.
        memory: whether to look at it.
    """
    found: dict[str, Usage] = {}
    for pid, name in process_tree(root, {root: "supervisor", **names}, _called):
        with suppress(OSError, ValueError):
            _add(found.setdefault(name, Usage()), Path(f"/proc/{pid}"), memory=memory)
    return {name: each for name, each in found.items() if each.processes}


def process_tree(
    pid: int, names: Mapping[int, str], called: Callable[[int, str], str], above: str = ""
) -> Iterator[tuple[int, str]]:
    """A process and all below it, with their names.

    Args:
        pid: process id.
        names: of known processes, by id.
        called: name of another one, from its id and the name of the process above.
        above: that name for `pid` itself.
    """
    name = names.get(pid) or called(pid, above)
    yield pid, name
    with suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            with suppress(OSError):  # a thread that ends meanwhile
                for child in (task / "children").read_text().split():
                    yield from process_tree(int(child), names, called, name)


def _called(pid: int, above: str) -> str:
    with suppress(OSError):
        if b"\0-m\0dataplane\0" in Path(f"/proc/{pid}/cmdline").read_bytes():
            return "spare"
    return above


def _add(total: Usage, process: Path, *, memory: bool) -> None:
    fields = (process / "stat").read_text().rpartition(")")[2].split()
    total.cpu_s += (int(fields[11]) + int(fields[12])) / _HZ
    counts = dict(line.split(": ") for line in (process / "io").read_text().splitlines())
    total.read += int(counts["rchar"])
    total.written += int(counts["wchar"])
    if memory:
        lines = (process / "smaps_rollup").read_text().splitlines()
        total.kib += next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
    total.processes += 1
