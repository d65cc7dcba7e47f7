"""`sdnator user` and `sdnator audit`: people come and go, and what they did can be read."""

import json
import os
import re
import subprocess
import sys
import time

import pytest
from typer.testing import CliRunner

from due import DB_ONLY, PRODUCER, Capability, Engine, Options
from due.drivers.embedded_redis import EmbeddedServer
from sdnator.cli.main import app as program
from sdnator.errors import BadInput, PipelineError
from sdnator.rights.audit_trail import note, unix_user
from sdnator.rights.sign_in_link import FILE, used_up
from sdnator.rights.users import Users
from sdnator.up import running

PASSWORD = "correct horse battery"  # noqa: S105


@pytest.fixture(autouse=True)
def state(tmp_path, monkeypatch):
    for name in ("STATE", "CONFIG", "DATA"):
        monkeypatch.setenv(f"XDG_{name}_HOME", str(tmp_path / name))
    monkeypatch.chdir(tmp_path)
    return running.state_folder()


def run(*arguments, given=""):
    done = CliRunner().invoke(program, arguments, input=given)
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    assert done.exit_code == 0, done.output
    return done.stdout


def test_somebody_comes_changes_the_password_and_goes(state):
    run("user", "add", "ada", "--role", "operator", "--password-stdin", given=PASSWORD + "\n")
    run("user", "add", "bob", given=f"{PASSWORD}\n{PASSWORD}\n")
    assert [(one["name"], one["role"]) for one in json.loads(run("user", "list", "--json"))["users"]] == [
        *(("ada", "operator"), ("bob", "viewer")),
    ]  # fmt: skip
    assert "ada" in run("user", "list")
    assert Users(state).verified("ada", PASSWORD)
    run("user", "passwd", "ada", "--password-stdin", given="another password\n")
    assert Users(state).verified("ada", PASSWORD) is None
    run("user", "remove", "ada")
    assert set(Users(state).all) == {"bob"}


def test_what_is_done_is_done_though_the_trail_cannot_be_kept(state, capsys):
    """The running pipeline, which says where the archive is, is another version's."""
    with running.claimed(state):
        (state / "run.json").write_text("[]")
        note("added user ada")
    assert "missing from the audit trail" in capsys.readouterr().err


def test_what_is_done_on_the_command_line_is_kept_with_the_name_of_the_unix_user(monkeypatch):
    monkeypatch.delenv("SUDO_UID", raising=False)
    run("user", "add", "ada", "--password-stdin", given=PASSWORD + "\n")
    run("user", "passwd", "ada", "--password-stdin", given="another password\n")
    run("user", "remove", "ada")
    run("app", "enrol", "mine", "--publish", "network.anomaly.mine.**")
    run("app", "remove", "mine")
    text = run("audit", "--json")
    deeds = json.loads(text)["deeds"]
    assert {(one["who"], one["source"]) for one in deeds} == {(unix_user(), "command line")}
    assert [one["deed"] for one in deeds] == [
        "added user ada, viewer",
        "changed the password of user ada",
        "removed user ada",
        "enrolled app mine: publish network.anomaly.mine.**; observe nothing; read nothing",
        "revoked the credential of app mine",
    ]
    assert PASSWORD not in text
    assert "another" not in text
    monkeypatch.setenv("DUE_ARCHIVE", "sqlite:///proc/no/such/place.db")
    run("user", "add", "bob", "--password-stdin", given=PASSWORD + "\n")
    assert run("user", "list").startswith("name")


def test_whoever_became_root_is_told_too(monkeypatch):
    monkeypatch.setattr("sdnator.rights.audit_trail.os.geteuid", lambda: 0)
    monkeypatch.setenv("SUDO_UID", "4294967290")
    assert unix_user() == "root (4294967290)"


def test_a_role_that_is_none_is_misuse():
    with pytest.raises(BadInput, match="viewer or operator"):
        run("user", "add", "ada", "--role", "king", "--password-stdin", given=PASSWORD)


def test_a_link_needs_a_pipeline():
    with pytest.raises(PipelineError, match="sdnator up"):
        run("user", "link")


def test_who_did_what_is_read_from_the_archive(tmp_path):
    archive = f"sqlite://{tmp_path}/a.db"
    deeds = {
        "dashboard": [
            (
                "network.audit.dashboard.page",
                {"who": "ada", "deed": "signed in", "source": "192.0.2.1", "unnoted": 0},
            ),
            ("network.instruction.dashboard.firewall", {"id": "1", "verb": "unblock", "subject": "x"}),
            ("network.audit.dashboard.page", {"who": "ada", "deed": "unblock x", "source": "", "unnoted": 0}),
        ],
        "operator": [
            ("network.instruction.operator.firewall", {"id": "2", "verb": "panic", "reason": "now"}),
            ("network.instruction.operator.firewall", {"verb": "no such"}),
        ],
    }
    with EmbeddedServer(tmp_path / "u") as server:
        for app, items in deeds.items():
            places = {"updates": server.url, "archive": archive, "directory": str(tmp_path / app)}
            engine = Engine(Options(**places, coordinated=False))
            keys = {key for key, _ in items}
            engine.init(
                app, PRODUCER, capabilities=[Capability(key, archive="always") for key in sorted(keys)]
            )
            for key, value in items:
                engine.write(key, value, [DB_ONLY], event_time=time.time_ns())
            engine.close()
    found = json.loads(run("audit", "--archive", archive, "--json"))["deeds"]
    assert [(one["who"], one["source"], one["deed"]) for one in found] == [
        ("ada", "192.0.2.1", "signed in"),
        ("ada", "", "unblock x"),
        ("operator", "", "panic (now)"),
    ]
    assert "unblock x" in run("audit", "--archive", archive, "--who", "ada")
    assert run("audit", "--archive", archive, "--who", "bob") == "nothing was recorded in that time\n"


_WAY_IN = """
from sdnator.cli.up_command import _way_in
from sdnator.up import running
running.state_folder().mkdir(parents=True)
found = running.Running(pid=1, started=1, updates="", archive="", coordinator="", dashboard="http://127.0.0.1:1/")
print(_way_in(found), end="")
"""


@pytest.mark.parametrize("terminal", [True, False])
def test_up_shows_the_link_at_a_terminal_and_in_no_file(state, tmp_path, terminal):
    """What goes into a log is read by others."""
    ours, theirs = os.openpty()
    with (tmp_path / "log").open("w") as log:
        subprocess.run([sys.executable, "-c", _WAY_IN], stdout=theirs if terminal else log, check=True)
    os.close(theirs)
    said = os.read(ours, 4096).decode() if terminal else (tmp_path / "log").read_text()
    os.close(ours)
    found = re.search(r"http://127\.0\.0\.1:1/link/(\S+)", said)
    assert (found is not None) is terminal
    assert (state / FILE).exists() is terminal
    if found:
        assert used_up(state / FILE, found[1])
