"""A wheel built from the sources runs a replay in an environment that knows no checkout.

The environment is empty but for the wheel; the dependencies are lent to it by one path to the
site-packages of the running Python, so that no package is downloaded.  (A `.pth` file of a lent folder
is not read, so the editable installation there stays out of sight.)
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

from sdnator.datasets.mirai_like import MiraiLikeOptions, make
from tests.end_to_end.test_up import Operator, until

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("due", "coordinator", "apps", "dataplane", "sdnator", "p4rt")
REST = ("setup.py", "pyproject.toml", "MANIFEST.in", "README.md", "CHANGELOG.md", "LICENSE", "sdnator_due.py")
MAN_PAGE = "docs/reference/sdnator.1"
BUILT = ("__pycache__", "*.so", "program")
SECONDS = 170


def run(*command: str | Path, folder: Path) -> subprocess.CompletedProcess[str]:
    """A command at its end, in an environment without hints at the checkout."""
    hidden = {"PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV"}
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    done = subprocess.run(
        [str(part) for part in command],
        capture_output=True, text=True, cwd=folder, timeout=SECONDS, check=False, env=environment,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    return done


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel, built from a copy: a build in the checkout would leave files there."""
    base = tmp_path_factory.mktemp("wheel")
    source = base / "source"
    source.mkdir()
    for name in (*PACKAGES, "p4"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns(*BUILT))
    for name in (*REST, MAN_PAGE):
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, source / name)
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--no-input")
    run(*pip, "wheel", "--no-build-isolation", "--no-deps", "--no-index", "--wheel-dir", base, source,
        folder=base)  # fmt: skip
    (built,) = base.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def environment(wheel, tmp_path_factory):
    """The scripts' folder of a virtual environment that holds the wheel and nothing else of ours."""
    base = tmp_path_factory.mktemp("environment")
    venv.create(base, with_pip=False, symlinks=True)
    run(sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", base / "bin" / "python",
        "install", "--no-deps", "--no-index", wheel, folder=base)  # fmt: skip
    (site_packages,) = base.glob("lib/python3*/site-packages")
    lent = dict.fromkeys((sysconfig.get_path("purelib"), sysconfig.get_path("platlib")))
    (site_packages / "lent.pth").write_text("\n".join(lent) + "\n", encoding="utf-8")
    return base / "bin"


def test_wheel_holds_every_file_of_the_packages_and_the_switch_program(wheel):
    """Nothing that lies in a package is forgotten, and no top-level folder comes along uninvited."""
    held = set(zipfile.ZipFile(wheel).namelist())
    wanted = {
        str(path.relative_to(ROOT))
        for name in PACKAGES
        for path in (ROOT / name).rglob("*")
        if path.is_file() and not any(path.match(f"**/{part}") or part in path.parts for part in BUILT)
    }
    program = {
        f"sdnator/program/{path.relative_to(ROOT / 'p4')}"
        for path in (ROOT / "p4").rglob("*")
        if path.suffix in {".p4", ".json", ".txtpb"}
    }
    assert program
    assert not (wanted | program) - held
    assert any(name.endswith(".data/data/share/man/man1/sdnator.1") for name in held)
    tops = {name.split("/")[0] for name in held if ".dist-info/" not in name and ".data/" not in name}
    assert tops == {*PACKAGES, "sdnator_due.py"}


def test_installed_parts_come_from_the_wheel(environment, tmp_path):
    """The package, its switch program and the record that ties program to source are the installed ones."""
    code = (
        "import json, sdnator_due; from sdnator import p4_program as p;"
        "p.check(p.folder()); print(json.dumps([p.__file__, str(p.find().bmv2_json), sdnator_due.__file__]))"
    )
    found = json.loads(run(environment / "python", "-c", code, folder=tmp_path).stdout)
    assert all(Path(path).is_relative_to(environment.parent) for path in found)


def test_replay_runs_from_the_wheel(environment, tmp_path):
    """`sdnator replay` trains and scores every packet outside any checkout."""
    capture = tmp_path / "capture.pcap"
    make(MiraiLikeOptions(seed=2, benign_seconds=60, attack_seconds=10), capture)
    done = run(environment / "sdnator", "replay", capture, "--train", "1000", "--json", folder=tmp_path)
    figures = json.loads(done.stdout)
    assert figures["packets_in"] > 1000
    assert figures["packets_scored"] + figures["packets_dropped"] == figures["packets_in"]


@pytest.fixture(scope="module")
def with_foreign_app(environment, tmp_path_factory):
    """The same environment with somebody else's package beside the product."""
    source = tmp_path_factory.mktemp("foreign") / "packet_counter"
    shutil.copytree(ROOT / "examples" / "packet_counter", source, ignore=shutil.ignore_patterns(*BUILT))
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", environment / "python")
    run(*pip, "install", "--no-build-isolation", "--no-deps", "--no-index", source, folder=source.parent)
    return environment


class Installed(Operator):
    """An operator whose `sdnator` is the installed one."""

    def __init__(self, folder, sdnator):
        super().__init__(folder)
        self.sdnator = sdnator

    def command(self, *words):
        return [str(self.sdnator), *words]


def test_an_installed_package_brings_its_app_along(with_foreign_app, tmp_path, monkeypatch):
    """Somebody else's app is configured, started, shown, logged, and started again when it dies, like ours."""
    monkeypatch.delenv("PYTHONPATH", raising=False)
    monkeypatch.chdir(tmp_path)
    operator = Installed(tmp_path, with_foreign_app / "sdnator")
    settings = tmp_path / "sdnator.toml"
    settings.write_text("[packet_counter]\nevery = 10\n", encoding="utf-8")
    assert operator.run("config", "check", str(settings)).returncode == 0
    assert "every = 1000" in operator.run("config", "example").stdout
    assert "packet_counter" in operator.run("flow", "--declared").stdout
    with operator.up("--config", str(settings)) as (_, said):
        os.kill(said["parts"]["packet_counter"], signal.SIGKILL)
        again = until(lambda: (now := operator.well()) and now["parts"]["packet_counter"]["restarts"] and now)
        assert again["parts"]["packet_counter"]["alive"]
        until(lambda: "active" in operator.figures("status")["apps"]["packet_counter"].split(", "))
        assert "packet_counter" in operator.run("flow").stdout
        assert operator.run("logs", "packet_counter").returncode == 0


def test_a_wrong_option_of_an_installed_app_is_named(with_foreign_app, tmp_path):
    """A fault in a foreign app's section is told like one in ours."""
    settings = tmp_path / "sdnator.toml"
    settings.write_text("[packet_counter]\nevry = 10\n", encoding="utf-8")
    done = Installed(tmp_path, with_foreign_app / "sdnator").run("config", "check", str(settings))
    assert done.returncode == 2
    assert "evry: there is no such option; did you mean every?" in done.stdout
