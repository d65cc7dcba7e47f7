"""Memory, threads and open files of all processes below one, from /proc."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from sdnator.plan.processes import process_tree

_WANTED = {"Rss": "rss_kb", "Pss": "pss_kb", "Pss_Anon": "anonymous_kb"}


@dataclass
class Footprint:
    """What processes of one name take together."""

    processes: int = 0
    rss_kb: int = 0
    pss_kb: int = 0
    anonymous_kb: int = 0
    """The share of `pss_kb` that belongs to no file: what a leak is made of, and nobody else's doing."""
    threads: int = 0
    files: int = 0


def footprints(root: int, names: Mapping[int, str]) -> dict[str, dict[str, int]]:
    """By name, of the process `root` and all below it.

    Args:
        root: a process id, whose name is `up`.
        names: of known processes, by id; others are named after the nearest one above and their program.
    """
    found: dict[str, Footprint] = {}
    for pid, name in process_tree(root, {root: "up", **names}, _called):
        with suppress(OSError):
            _add(found.setdefault(name, Footprint()), Path(f"/proc/{pid}"))
    return {name: asdict(each) for name, each in sorted(found.items()) if each.processes}


def _called(pid: int, above: str) -> str:
    program = "gone"
    with suppress(OSError):
        words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
        module = words[words.index(b"-m") + 1] if b"-m" in words[:-1] else words[0]
        program = Path(module.decode(errors="replace")).name or program
    return f"{above}/{program}"


def _listed(folder: str) -> list[str]:
    with suppress(OSError):
        return [each.name for each in Path(folder).iterdir()]
    return []


def _add(total: Footprint, process: Path) -> None:
    lines = (process / "smaps_rollup").read_text().splitlines()
    kinds = {name: int(rest.split()[0]) for name, _, rest in (line.partition(":") for line in lines[1:])}
    total.threads += len(_listed(str(process / "task")))
    total.files += len(_listed(str(process / "fd")))
    total.processes += 1
    for name, target in _WANTED.items():
        setattr(total, target, getattr(total, target) + kinds[name])


def folder_bytes(folder: Path, pattern: str = "**/*") -> int:
    """Size of the regular files of a folder."""
    total = 0
    for each in folder.glob(pattern):
        with suppress(OSError):
            total += each.stat().st_size if each.is_file() else 0
    return total
