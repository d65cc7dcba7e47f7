"""Who may import whom: the house rules of docs/architecture.md, held by reading every import."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
OURS = {"due", "coordinator", "apps", "dataplane", "sdnator", "p4rt", "sdnator_due", "tests", "benchmarks"}
CONTRACT = {"apps", "apps.messages", "apps.packets"}
APPS = ("p4runtime_ctrl", "kitsune", "sonata_adapter", "firewall")
IO_MODULES = {"socket", "threading", "asyncio", "subprocess", "time", "redis", "pymongo", "grpc"}


def imports(path: Path) -> set[str]:
    """Names of all modules that a file imports, anywhere in it."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module)
        elif isinstance(node, ast.ImportFrom) and node.level:
            pytest.fail(f"{path}: relative import; write the whole name")
    return found


def ours(path: Path) -> set[str]:
    return {name for name in imports(path) if name.split(".")[0] in OURS}


def sources(folder: str) -> list[Path]:
    return sorted((ROOT / folder).rglob("*.py"))


@pytest.mark.parametrize("path", sources("due"), ids=lambda p: str(p.relative_to(ROOT)))
def test_due_imports_nothing_of_ours(path):
    """The library serves any system: it knows neither networks nor apps."""
    assert all(name.split(".")[0] == "due" for name in ours(path))


@pytest.mark.parametrize("path", sources("coordinator"), ids=lambda p: str(p.relative_to(ROOT)))
def test_coordinator_imports_only_due(path):
    """The Coordinator is an app of the library and nothing else."""
    assert all(name.split(".")[0] in {"due", "coordinator"} for name in ours(path))


@pytest.mark.parametrize("path", sources("dataplane"), ids=lambda p: str(p.relative_to(ROOT)))
def test_dataplane_speaks_p4runtime_only(path):
    """BMv2 must be able to take the embedded target's place."""
    assert all(name.split(".")[0] in {"dataplane", "p4rt"} for name in ours(path))


@pytest.mark.parametrize("app", APPS)
def test_apps_import_due_the_contract_and_themselves(app):
    """Apps never import each other; only the controller knows P4Runtime."""
    allowed = {"due", f"apps.{app}"} | ({"p4rt"} if app == "p4runtime_ctrl" else set())
    for path in sources(f"apps/{app}"):
        for name in ours(path):
            ok = name in CONTRACT or any(name == root or name.startswith(root + ".") for root in allowed)
            assert ok, f"{path.relative_to(ROOT)} imports {name}"


@pytest.mark.parametrize("app", APPS)
def test_app_cores_are_pure(app):
    """No socket, clock or thread outside service.py and what it alone imports."""
    service = ROOT / "apps" / app / "service.py"
    io_files = {service} | {
        ROOT / (name.replace(".", "/") + ".py")
        for name in (ours(service) if service.exists() else ())
        if name.startswith(f"apps.{app}.")
        and IO_MODULES
        & {imported.split(".")[0] for imported in imports(ROOT / (name.replace(".", "/") + ".py"))}
    }
    for path in set(sources(f"apps/{app}")) - io_files:
        assert not IO_MODULES & {name.split(".")[0] for name in imports(path)}, path
        assert not {str(f.relative_to(ROOT))[:-3].replace("/", ".") for f in io_files} & imports(path), path


def test_p4_folder_is_no_package():
    """A package of ours named p4 would hide p4.v1 of the p4runtime wheel."""
    assert not list((ROOT / "p4").rglob("*.py"))


@pytest.mark.parametrize(
    "path",
    [p for f in sorted(OURS - {"sdnator_due"}) for p in sources(f)],
    ids=lambda p: str(p.relative_to(ROOT)),
)
def test_no_file_is_longer_than_600_lines(path):
    """A file should fit a reader's head."""
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 600
