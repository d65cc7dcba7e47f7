"""`sdnator app`: a credential that works at once, for these keys alone, until it is removed."""

import json
import os
import subprocess
import sys
import time

import pytest
from typer.testing import CliRunner

from due.drivers.embedded_redis import EmbeddedServer
from sdnator.cli.app_commands import app
from sdnator.errors import BadInput
from sdnator.rights.identities import Identities, made
from sdnator.rights.rights_keeper import RightsKeeper
from sdnator.up import running

_PROGRAM = """
import time
from sdnator_due import due, CONSUMER, PRODUCER
due.init("guest", PRODUCER | CONSUMER)
due.observe("network.open.*").subscribe(lambda item: print(item.value, flush=True))
due.write("network.anomaly.guest.score", 7)
due.flush()
print("written", flush=True)
time.sleep(60)
"""


@pytest.fixture
def state(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.chdir(tmp_path)
    return running.state_folder()


def run(*arguments: str) -> str:
    done = CliRunner().invoke(app, arguments)
    if done.exception is not None:
        raise done.exception
    return done.stdout


def test_an_enrolled_app_works_with_its_file_alone_and_not_after_it_was_removed(state, tmp_path):
    made(state, {})
    with EmbeddedServer(tmp_path / "u") as server:
        running.updates_link(state).symlink_to(server.socket)
        keeper = RightsKeeper(server.url, Identities(state))
        keeper.apply()
        keeper.start()
        run("enrol", "guest", "--publish", "network.anomaly.guest.**", "--observe", "network.open.**")
        credential = tmp_path / "guest.credential.json"
        assert credential.stat().st_mode & 0o777 == 0o600
        deadline = time.monotonic() + 60
        while not any(b"guest" in user for user in _users(server)):
            assert time.monotonic() < deadline
            time.sleep(0.05)
        environment = {**os.environ, "DUE_CREDENTIAL": str(credential), "DUE_DIRECTORY": str(tmp_path / "d")}
        program = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM], env=environment, stdout=subprocess.PIPE, text=True
        )
        try:
            assert program.stdout is not None
            assert program.stdout.readline() == "written\n"
            run("remove", "guest")
            while any(b"guest" in user for user in _users(server)):
                assert time.monotonic() < deadline
                time.sleep(0.05)
        finally:
            program.kill()
            program.wait()
        keeper.stop()
    with pytest.raises(BadInput, match="no app guest is enrolled"):
        run("remove", "guest")


def _users(server: EmbeddedServer) -> list[bytes]:
    from due.drivers.redis_wire import client

    commands = client(server.url)
    found: list[bytes] = commands.execute_command("ACL", "USERS")
    commands.close()
    return found


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["mine", "--publish", "network.block.firewall.*"], "commands something"),
        (["mine", "--publish", "network.**"], "commands something"),
        (["mine", "--publish", "a..b"], "segment"),
        (["operator"], "choose another name"),
        (["kitsune"], "choose another name"),
        (["no name"], "an app id"),
        (["mine", "--out", "/nowhere/x.json"], "/nowhere/x.json"),
    ],
)
def test_what_cannot_be_enrolled_is_refused_with_the_reason(state, arguments, words):
    made(state, {"kitsune": made(state, {}).all["operator"].rights})
    with pytest.raises(BadInput, match=words):
        run("enrol", *arguments)


def test_who_has_a_credential_is_listed_with_the_keys(state):
    assert "no app has a credential" in run("list")
    run("enrol", "mine", "--publish", "a.b", "--observe", "c.**", "--read", "d.*")
    run("enrol", "other", "--publish", "network.block.other.*", "--command")
    assert "mine (enrolled)\n  publishes a.b\n  observes  c.**\n  reads     d.*" in run("list")
    shown = json.loads(run("list", "--json"))
    assert shown["other"] == {
        "enrolled": True,
        "publish": ["network.block.other.*"],
        "observe": [],
        "read": [],
    }
    secret = Identities(state).all["mine"].password
    assert secret not in run("list")


@pytest.mark.parametrize("mode", [0o644, 0o640])
def test_a_credential_that_others_can_read_is_refused(state, tmp_path, mode, monkeypatch):
    from due import Engine
    from due.errors import InvalidOption

    run("enrol", "mine", "--publish", "a.b")
    path = tmp_path / "mine.credential.json"
    path.chmod(mode)
    monkeypatch.setenv("DUE_CREDENTIAL", str(path))
    with pytest.raises(InvalidOption, match="chmod 600"):
        Engine()
