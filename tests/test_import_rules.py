"""Who may import whom: the rules of docs/architecture.md, held by reading every import."""

import ast
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
OURS = {"due", "coordinator", "apps", "dataplane", "sdnator", "p4rt", "sdnator_due", "tests", "benchmarks"}
CONTRACT = {
    "apps", "apps.archive_question", "apps.enforcement", "apps.evidence", "apps.incidents", "apps.intake", "apps.messages", "apps.packets",
    "apps.standing_decisions", "apps.talkers",
}  # fmt: skip
APPS = ("p4runtime_ctrl", "kitsune", "sonata_adapter", "firewall", "enforcers")
IO_MODULES = {"socket", "threading", "asyncio", "subprocess", "time", "redis", "pymongo", "grpc"}


@cache
def imports(path: Path) -> frozenset[str]:
    """Names of all modules that a file imports, anywhere in it; `from package import module` names the module."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level:
            pytest.fail(f"{path}: relative import; write the whole name")
        elif isinstance(node, ast.ImportFrom) and node.module:
            folder = ROOT / node.module.replace(".", "/")
            inner = {alias.name for alias in node.names if (folder / f"{alias.name}.py").exists()}
            found |= {f"{node.module}.{name}" for name in inner} if inner else {node.module}
    return frozenset(found)


def ours(path: Path) -> set[str]:
    return {name for name in imports(path) if name.split(".")[0] in OURS}


def sources(folder: str) -> list[Path]:
    return sorted((ROOT / folder).rglob("*.py"))


def within(name: str, rooms: Iterable[str]) -> bool:
    return any(name == room or name.startswith(f"{room}.") for room in rooms)


def breaches(folder: str, allowed: Iterable[str]) -> Iterator[str]:
    """Imports of ours in `folder` that lie in none of the allowed rooms."""
    for path in sources(folder):
        for name in sorted(ours(path)):
            if not within(name, allowed):
                yield f"{path.relative_to(ROOT)} imports {name}"


HOUSES = {
    "due": {"due"},
    "coordinator": {"due", "coordinator"},
    "p4rt": {"p4rt"},
    "dataplane": {"dataplane", "p4rt"},
    **{
        f"apps/{app}": {"due", f"apps.{app}"} | ({"p4rt"} if app == "p4runtime_ctrl" else set()) | CONTRACT
        for app in APPS
    },
}
"""Folder to what it may import of ours; `sdnator` may import anything."""


@pytest.mark.parametrize("folder", HOUSES)
def test_a_house_imports_only_what_it_may(folder):
    """DUE knows no networks, apps never import each other, and BMv2 can take the embedded switch's place."""
    allowed = HOUSES[folder]
    # `apps` itself is the contract, not the room that holds all apps
    found = [
        text
        for text in breaches(folder, allowed - {"apps"})
        if not (text.endswith(" imports apps") and "apps" in allowed)
    ]
    assert not found


ROOMS = {
    "dataplane/v1model": {
        "dataplane.v1model",
        "dataplane.compiler",
        "dataplane.errors",
        "dataplane.frame_block",
    },
    "dataplane/compiler": {
        "dataplane.compiler",
        "dataplane.v1model.tree",
        "dataplane.v1model.externs",
        "dataplane.errors",
    },
    "dataplane/ports": {"dataplane.ports", "dataplane.errors", "dataplane.frame_block"},
    "apps/sonata_adapter/query": {"apps.sonata_adapter.query", "apps.sonata_adapter.errors"},
    "apps/sonata_adapter/host": {
        "due",
        *CONTRACT,
        *(f"apps.sonata_adapter.{room}" for room in ("host", "query", "errors", "results")),
    },
    "apps/sonata_adapter/planner": {
        "due.keys",
        "due",
        *(f"apps.sonata_adapter.{room}" for room in ("planner", "query", "errors", "results", "keys")),
    },
    "sdnator/capture": {
        "sdnator.capture",
        "sdnator.errors",
        "sdnator.plurals",
        "due",
        "apps.packets",
        "apps.messages",
        "dataplane.frame_block",
    },
}
"""Room to what it may import of its own house and others."""


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_imports_only_what_it_may(room):
    assert sources(room), "the room is there"
    assert not list(breaches(room, ROOMS[room]))


FORBIDDEN = {
    "benchmarks": "tests",
    "sdnator/testing": "tests",
    "sdnator/dashboard": "sdnator.cli",
    "sdnator/supervisor": "sdnator.cli",
    "sdnator/replay": "sdnator.cli",
    "sdnator/report": "sdnator.cli",
}


@pytest.mark.parametrize("room", FORBIDDEN)
def test_a_room_does_without_another(room):
    """What is below does not know what is above: no command line in page, report or launcher."""
    found = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in sources(room)
        for name in ours(path)
        if within(name, [FORBIDDEN[room]])
    ]
    assert not found


@pytest.mark.parametrize("app", APPS)
def test_app_cores_are_pure(app):
    """No socket, clock or thread outside the service and the files that say I/O in their first line."""
    for path in sources(f"apps/{app}"):
        touches = IO_MODULES & {name.split(".")[0] for name in imports(path)}
        said = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        assert not touches or path.name == "service.py" or "I/O" in said, f"{path} imports {touches}"


def test_p4_folder_is_no_package():
    """A package of ours named p4 would hide p4.v1 of the p4runtime wheel."""
    assert not list((ROOT / "p4").rglob("*.py"))


def test_no_two_modules_of_a_house_import_each_other():
    """A circle of modules is one module in disguise."""
    graph = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts): _run_time_imports(path)
        for house in ("due", "coordinator", "apps", "dataplane", "sdnator")
        for path in sources(house)
    }
    circles = sorted(
        f"{name} <-> {other}"
        for name, others in graph.items()
        for other in others
        if name < other and name in graph.get(other, ())
    )
    assert not circles


def _run_time_imports(path: Path) -> set[str]:
    """Imports at the top of a module, those for type checkers left out."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    found: set[str] = set()
    for node in tree.body:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            folder = ROOT / node.module.replace(".", "/")
            found |= {
                f"{node.module}.{alias.name}" if (folder / f"{alias.name}.py").exists() else node.module
                for alias in node.names
            }
    return found


def test_no_class_name_stands_twice():
    """A name leads to one class; `Settings` is each app's own, as the entry-point group `sdnator.apps` wants it."""
    found: dict[str, list[str]] = {}
    for folder in (*HOUSES, "apps", "sdnator", "benchmarks", "examples"):
        for path in sources(folder):
            for node in ast.parse(path.read_text(encoding="utf-8")).body:
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    found.setdefault(node.name, []).append(str(path.relative_to(ROOT)))
    twice = {name: sorted(set(files)) for name, files in found.items() if len(set(files)) > 1}
    twice.pop("Settings")
    assert not twice
