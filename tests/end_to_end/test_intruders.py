"""Another Unix user, without a credential and with that of an enrolled app, tries the doors of a running pipeline."""

import json
import os
import secrets
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import httpx
import pytest

from due.drivers.embedded_redis import EmbeddedServer
from due.drivers.redis_wire import client
from sdnator.northbound import without_user
from sdnator.up import running
from tests.end_to_end.command import SECONDS, sdnator
from tests.end_to_end.intruder import COMMANDS, OWN_KEY, THROUGH
from tests.end_to_end.test_up import Operator, until
from tests.requirements import require_root

_NOBODY = 65534
_SCRAPED = secrets.token_urlsafe(24)
_MARKER = "open-to-all"


class Pipeline:
    """One that runs, on a given Data Updates server with a password, and what its owner knows of it."""

    def __init__(self, operator: Operator, said: dict[str, object], folder: Path, password: str) -> None:
        self.operator, self.said, self.folder = operator, said, folder
        self.state = Path(operator.environment["XDG_STATE_HOME"]) / "sdnator"
        found = running.find(self.state)
        assert found is not None
        self.found = found
        identities = json.loads((self.state / "identities.json").read_bytes())
        owned = [str(said["token_file"]), str(self.state / "coordinator.token")]
        self.secrets = [
            password,
            _SCRAPED,
            *_passwords(identities),
            *(Path(each).read_text().strip() for each in owned),
        ]

    def attacked(self, uid: int, *, credential: Path | None = None, token: str = "") -> dict[str, Any]:
        """What came of all attempts."""
        url = str(self.found.updates)
        told = {
            "uid": uid,
            "updates": f"redis://{url.rpartition('@')[2]}",
            "credential": str(credential or ""),
            "token": token,
            "coordinator": without_user(self.found.coordinator).partition("://")[2],
            "metrics": self.found.metrics,
            "page": self.found.dashboard.partition("://")[2].rstrip("/"),
            "switch": self.found.switch["address"],
            "folder": str(self.folder),
        }
        done = subprocess.run(
            [sys.executable, "-m", "tests.end_to_end.intruder"],
            input=json.dumps(told),
            capture_output=True,
            text=True,
            timeout=SECONDS,
            check=False,
        )
        assert done.returncode == 0, done.stderr[-3000:]
        found: dict[str, Any] = json.loads(done.stdout)
        return found


def _passwords(value: object) -> list[str]:
    """Whatever stands under that name, at any depth."""
    if not isinstance(value, dict):
        return []
    own = [str(value["password"])] if "password" in value else []
    return own + [found for each in value.values() for found in _passwords(each)]


@pytest.fixture(scope="module")
def pipeline():
    require_root()
    # not below pytest's folder: nobody may enter that, whatever the product does
    with tempfile.TemporaryDirectory(prefix="intruders-") as name, EmbeddedServer(tcp=True) as server:
        folder = Path(name)
        folder.chmod(0o755)
        (folder / _MARKER).touch()
        password = secrets.token_urlsafe(24)
        given = client(server.url)
        given.config_set("requirepass", password)
        given.close()
        operator = Operator(folder)
        url = server.tcp_url.replace("redis://", f"redis://:{password}@")
        # in a file, as operators give it: arguments of `up` itself are for everybody to see
        config = Path(operator.environment["XDG_CONFIG_HOME"]) / "sdnator" / "sdnator.toml"
        config.parent.mkdir(mode=0o700, parents=True)
        scraped = folder / "metrics.token"
        scraped.touch(mode=0o600)
        scraped.write_text(_SCRAPED)
        config.write_text(f'[up]\nupdates = "{url}"\n\n[metrics]\ntoken_file = "{scraped}"\n')
        with operator.up(page=()) as (_, said):
            until(operator.well)
            yield Pipeline(operator, said, folder, password)


def _wires(pipeline: Pipeline) -> list[str]:
    entries = pipeline.operator.figures("tables", "s1", "--table", "forward_port")["entries"]
    assert entries, "there is something to delete"
    return sorted(json.dumps(each, sort_keys=True) for each in entries)


def _refused(found: dict[str, str]) -> None:
    assert THROUGH not in found.values(), found


def refused_at_the_page(found: dict[str, str]) -> None:
    """To the form from the page itself, 401 or 403 at every other door."""
    assert found.pop("page") == "HTTPException: 303"
    assert set(found.values()) <= {"HTTPException: 401", "HTTPException: 403"}
    assert len(found) == 6


def test_the_owner_signs_in_by_a_link_and_what_was_refused_can_be_read(pipeline):
    done = pipeline.operator.run("user", "link")
    assert done.returncode == 0, done.stderr
    with httpx.Client(timeout=SECONDS) as browser:
        link = done.stdout.strip()
        assert link.startswith(pipeline.found.dashboard)
        assert browser.get(link).status_code == 200
        page = browser.get(pipeline.found.dashboard)
        assert page.status_code == 200
        assert "sign-in" not in str(page.url)
        pipeline.attacked(_NOBODY)

        def told():
            deeds = pipeline.operator.figures("audit")["deeds"]
            found = {(one["who"], one["deed"]) for one in deeds}
            return {("owner", "signed in by a link"), ("owner", "refused to sign in")} <= found

        until(told)


def test_whoever_scrapes_has_a_token_for_that_alone(pipeline):
    found = pipeline.attacked(_NOBODY, token=_SCRAPED)
    assert set(found["metrics"].values()) == {THROUGH}
    _refused(found["http"])


def test_the_owner_goes_through_the_same_doors(pipeline):
    token = (pipeline.state / "coordinator.token").read_text().strip()
    found = pipeline.attacked(os.geteuid(), token=token)
    assert {name for name, text in found["http"].items() if text != THROUGH} <= {"regex"}
    assert {"/apps", "/health", "/flow", "/apps/firewall/history", "archive"} <= found["http"].keys()
    assert found["http"]["regex"] in (THROUGH, "HTTPException: 400"), (
        "it is answered, or refused as a pattern"
    )
    assert found["p4runtime"]["registers"].startswith("RESOURCE_EXHAUSTED"), (
        "also the owner names what he reads"
    )
    assert "UNAVAILABLE" not in found["p4runtime"]["wires"]
    assert found["p4runtime"]["wires"] != THROUGH, "nobody configured this role"
    assert "sdnator/run.json" in " ".join(found["looked"]["readable"])
    until(pipeline.operator.well)


def test_another_user_without_a_credential_gets_nothing(pipeline):
    before = _wires(pipeline)
    found = pipeline.attacked(_NOBODY)
    assert set(found["http"].values()) <= {"HTTPException: 401", "HTTPException: 403"}
    assert all("UNAVAILABLE" in text and "ermission denied" in text for text in found["p4runtime"].values())
    _refused(found["updates"])
    refused_at_the_page(found["page"])
    assert set(found["metrics"].values()) == {"HTTPException: 401"}
    assert {"coordinator", "supervisor", "kitsune", "firewall"} <= found["metrics"].keys()
    assert found["looked"]["readable"] == [_MARKER]
    assert _wires(pipeline) == before
    until(pipeline.operator.well)


def test_no_password_shows_in_arguments_or_in_what_up_says(pipeline):
    looked = pipeline.attacked(_NOBODY)["looked"]
    arguments = " ".join(looked["arguments"])
    assert "apps.firewall" in arguments, "the parts can be seen"
    assert looked["environments"] == 0
    told = arguments + json.dumps(pipeline.said) + pipeline.operator.run("status").stdout
    assert [each for each in pipeline.secrets if each in told] == []
    assert len(pipeline.secrets) > len(COMMANDS), "each app has a password of its own"


def test_an_enrolled_app_says_its_own_and_commands_nothing(pipeline):
    credential = pipeline.folder / "mine.json"
    own_keys = "network.anomaly.mine.**"
    keys = ("--publish", own_keys, "--read", own_keys, "--out", str(credential))
    done = sdnator("app", "enrol", "mine", *keys, environment=pipeline.operator.environment)
    assert done.returncode == 0, done.stderr
    os.chown(credential, _NOBODY, _NOBODY)
    before = _wires(pipeline)
    own = {f"publish {OWN_KEY}", f"add {OWN_KEY}"}

    def known():
        found = pipeline.attacked(_NOBODY, credential=credential)
        return found if found["updates"][f"publish {OWN_KEY}"] == THROUGH else None

    found = until(known)
    assert {name for name, text in found["updates"].items() if text == THROUGH} == own
    assert all("NoPermissionError" in text for name, text in found["updates"].items() if name not in own)
    assert {f"publish {key}" for key in COMMANDS} <= found["updates"].keys()
    # its password opens what it may read, so that the query is answered, or too slow: with nothing of others
    assert {name for name, text in found["http"].items() if text == THROUGH} <= {"regex"}
    assert found["http"]["archive"] == found["http"]["/apps"] == "HTTPException: 403"
    refused_at_the_page(found["page"])
    _refused(found["metrics"])
    _refused(found["p4runtime"])
    assert _wires(pipeline) == before
    until(pipeline.operator.well)
