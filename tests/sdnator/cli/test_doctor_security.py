"""`sdnator doctor --security` finds what others can read or reach, on a real installation."""

from functools import partial

import pytest

from due.drivers.embedded_redis import EmbeddedServer
from due.drivers.redis_rights import Rights
from sdnator.cli.doctor_security import (
    check_listeners,
    check_page_users,
    check_server_rights,
    check_switches,
    check_urls,
    security_checks,
)
from sdnator.config import config_file
from sdnator.rights.identities import ADMIN, Identities, made
from sdnator.rights.users import Users
from sdnator.up import running


@pytest.fixture
def state(tmp_path, monkeypatch):
    for name in ("STATE", "DATA", "CONFIG"):
        monkeypatch.setenv(f"XDG_{name}_HOME", str(tmp_path / name.lower()))
    monkeypatch.chdir(tmp_path)
    return running.state_folder()


def _exposed() -> set[str]:
    return {check.name for check in security_checks() if check.state == "exposed"}


def test_a_new_installation_exposes_nothing(state):
    assert _exposed() == set()
    made(state, {"mine": Rights(app="mine")})
    assert _exposed() == set()


def test_files_that_others_can_read_are_found(state):
    made(state, {})
    (state / "identities.json").chmod(0o644)
    assert _exposed() == {"secrets"}
    state.chmod(0o755)
    archive = running.data_folder() / "archive.db"
    archive.parent.mkdir(parents=True)
    archive.touch(0o644)
    assert _exposed() == {"secrets", "state folder", "archive"}


def test_an_enrolled_app_that_may_command_is_named(state):
    identities = Identities(state)
    with identities.changing():
        identities.put("mine", Rights(app="mine", publish=("network.block.mine.*", "a.b")), enrolled=True)
    (found,) = [check for check in security_checks() if check.name == "commanding apps"]
    assert found.found == "mine (network.block.mine.*)"


def test_who_reads_the_archive_from_outside_is_named(state):
    identities = Identities(state)
    with identities.changing():
        identities.put("mine", Rights(app="mine", publish=("a.b",), read=("network.**",)), enrolled=True)
        identities.put("other", Rights(app="other", observe=("**",)), enrolled=True)
    (found,) = [check for check in security_checks() if check.name == "reading apps"]
    assert found.found == "mine (network.**)"


@pytest.mark.parametrize(
    ("text", "exposed"),
    [
        ('[dashboard]\nhost = "0.0.0.0"', "dashboard.host=0.0.0.0"),
        ('[coordinator]\nhttp_host = "::"', "coordinator.http_host=::"),
        ('[metrics]\nhost = "10.0.0.1"', "metrics.host=10.0.0.1"),
        ('[dashboard]\nhost = "127.0.0.1"', ""),
    ],
)
def test_listeners_for_other_machines_are_found(tmp_path, text, exposed):
    path = tmp_path / "sdnator.toml"
    path.write_text(text)
    check = check_listeners(config_file.load(path, {}))
    assert (exposed in check.found) if exposed else check.state == "ok"


@pytest.mark.parametrize(
    ("text", "exposed"),
    [
        ('[[switches]]\nkind = "10.0.0.2:9559"\ninsecure = true', True),
        ('[[switches]]\nlisten = "127.0.0.1:9559"\ninsecure = true', True),
        ('[[switches]]\nkind = "bmv2"\ninsecure = true', True),
        ("[[switches]]\ninsecure = true", False),
        ('[[switches]]\nkind = "unix:/run/s.sock"', False),
    ],
)
def test_switches_without_certificates_are_found(tmp_path, text, exposed):
    path = tmp_path / "sdnator.toml"
    path.write_text(text)
    check = check_switches(config_file.load(path, {}), None)
    assert (check.state == "exposed") is exposed
    place = {
        "address": "127.0.0.1:1" if exposed else "unix:/s",
        "security": {"insecure": True},
        "name": "mine",
    }
    found = running.Running(pid=1, started=1, updates="", archive="", coordinator="", switches=[place])
    assert ("mine" in check_switches(config_file.load(path, {}), found).found) is exposed


def test_a_page_without_users_is_told(state, tmp_path):
    path = tmp_path / "sdnator.toml"
    path.write_text("")
    here = config_file.load(path, {})
    assert "there are no users" in check_page_users(state, here).found
    path.write_text('[dashboard]\nhost = "10.0.0.1"')
    elsewhere = config_file.load(path, {})
    assert check_page_users(state, elsewhere).state == "exposed"
    Users(state).add("ada", "viewer", "correct horse battery")
    assert check_page_users(state, elsewhere).state == "ok"
    assert "1 user; operators: none" in check_page_users(state, here).found
    (state / "users.json").write_text("{")
    assert check_page_users(state, here).state == "exposed"


@pytest.mark.parametrize(
    ("url", "state"),
    [
        ("redis://:secret@10.0.0.1:6379", "exposed"),
        ("rediss://10.0.0.1", "ok"),
        ("redis://127.0.0.1", "ok"),
        ("redis+sentinel://:secret@127.0.0.1:1,10.0.0.1:1/due", "exposed"),
        ("redis+sentinel://127.0.0.1:1,[::1]:2/due", "ok"),
        ("rediss+sentinel://10.0.0.1:1/due", "ok"),
    ],
)
def test_passwords_without_tls_are_found_and_not_shown(tmp_path, url, state):
    path = tmp_path / "sdnator.toml"
    path.write_text(f'[up]\nupdates = "{url}"')
    check = check_urls(config_file.load(path, {}), None)
    assert check.state == state
    assert "secret" not in check.found


def test_a_server_that_lets_anybody_publish_is_found(tmp_path):
    with EmbeddedServer(tmp_path / "u") as server:
        found = running.Running(pid=1, started=1, updates=server.url, archive="", coordinator="")
        assert check_server_rights(found).state == "exposed"
    identities = made(tmp_path, {})
    users, admin = partial(identities.users_file, "secret"), (identities.prefix + ADMIN, "secret")
    guarded = EmbeddedServer(tmp_path / "g", users=users, admin=admin)
    with guarded as server:
        found = running.Running(pid=1, started=1, updates=server.url, archive="", coordinator="")
        assert check_server_rights(found).state == "ok"
