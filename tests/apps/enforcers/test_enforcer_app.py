"""An enforcer and an archive that is away: with an engine that is none, and a kernel and a web server that are none."""

import json
import threading
import time

import pytest

from apps.enforcers import enforcer_app
from apps.enforcers.enforcer_app import EnforcerApp
from apps.enforcers.nftables.nft_table import NftTable
from apps.enforcers.nftables.ruleset import TablePlan
from apps.enforcers.webhook_enforcer.webhook import Webhook
from apps.messages import Decision, Target
from due import Item
from sdnator.testing.waiting import wait_for
from tests.apps.firewall.desk import FakeEngine

KEY = "network.block.firewall.*"
HOUR = 3600 * 10**9


class Archive(FakeEngine):
    """An engine of an active instance, whose archive selects by action, too."""

    def health(self):
        return {"phase": "ready", "asking": False, "active": True}

    def get(self, query, *, limit=None):
        found = super().get(query, limit=limit)
        action = query.get("value.action")
        return [item for item in found if action in (None, item.value["action"])]


class Kernel:
    """Tables as `nft` keeps them: elements by set."""

    def __init__(self):
        self.sets = None

    def apply(self, commands):
        for command in commands:
            ((verb, objects),) = command.items()
            ((kind, one),) = objects.items()
            if kind == "table":
                self.sets = (
                    {} if verb == "add" and self.sets is None else self.sets if verb == "add" else None
                )
            elif kind == "set":
                self.sets.setdefault(one["name"], set())
            elif kind == "element":
                values = {each["elem"]["val"] if "elem" in each else each for each in one["elem"]}
                held = self.sets[one["name"]]
                self.sets[one["name"]] = held | values if verb == "add" else held - values

    def table(self, _):
        if self.sets is None:
            return None
        return {
            "nftables": [{"set": {"name": name, "elem": sorted(held)}} for name, held in self.sets.items()]
        }

    @property
    def blocked(self):
        return {address[-1] for address in (self.sets or {}).get("blocked4", ())}


class Server:
    """A webhook's server, as its client sees it."""

    def __init__(self):
        self.blocks = set()

    def ask(self, method, body=b""):
        if method == "GET":
            return 200, json.dumps({"blocks": [{"id": name} for name in self.blocks]}).encode()
        said = json.loads(body)
        if said["action"] == "block":
            self.blocks.add(said["id"])
        else:
            self.blocks.discard(said["id"])
        return 200, b'{"state": "removed"}'

    def close(self):
        """Nothing is open."""

    @property
    def blocked(self):
        return {name[-1] for name in self.blocks}


def spoken(number, action="block", *, ago=0):
    """A decision about 192.0.2.`number`, written `ago` ns before now."""
    at = time.time_ns() - ago
    made = Decision(
        id=f"d{number}",
        action=action,
        switch="*",
        target=Target(kind="ip", address=f"192.0.2.{number}"),
        reason="",
        event_time=at,
        expires=at + 24 * HOUR,
    )
    return Item("network.block.firewall.ipv4", made.to_value(), at, at, "firewall", "i", number)


class Stage:
    """An archive with the blocks 1, 2 and 3, and an enforcer that may be started again."""

    def __init__(self, kind):
        self.device = Kernel() if kind == "nftables" else Server()
        self._kind = kind
        self.engine = Archive()
        self.engine.archived = [spoken(number) for number in (1, 2, 3)]
        self.app = None

    def start(self):
        if self.app is not None:
            self.app.stop()
        nft = self._kind == "nftables"
        enforcer = NftTable(TablePlan(), self.device) if nft else Webhook(self.device)
        self.app = EnforcerApp(self.engine, self._kind, "here", enforcer, check_s=0.01, patience_s=10)
        self.app.start()

    def hear(self, item):
        self.engine.subjects[KEY].on_next(item)

    def wait_for(self, blocked, *, working=True):
        def reached():
            self.app.tick()
            return self.device.blocked == set(blocked) and self.app.health()["working"] == working

        wait_for(reached)

    def removals(self, number):
        said = [value for key, value in self.engine.written if "confirmation" in key]
        return [value["state"] for value in said if value["id"] == f"d{number}"].count("removed")


@pytest.fixture(params=["nftables", "webhook_enforcer"])
def stage(request, monkeypatch):
    """All blocks are in force; the archive is asked all the time."""
    for name in ("_LOOK_EVERY_S", "_LONGEST_PAUSE_S"):
        monkeypatch.setattr(enforcer_app, name, 0.01)
    made = Stage(request.param)
    made.start()
    made.wait_for("123")
    yield made
    made.app.stop()


def test_a_start_without_the_archive_leaves_what_stands(stage):
    """New blocks come, lifted ones go, and the archive is asked until it answers; then its word counts."""
    stage.engine.archive_away = True
    stage.start()
    stage.hear(spoken(4))
    stage.hear(spoken(1, "unblock"))
    stage.wait_for("234", working=False)
    asked = stage.app.health()["archive_unanswered"]
    stage.wait_for("234", working=False)
    wait_for(lambda: stage.app.tick() or stage.app.health()["archive_unanswered"] > asked)
    stage.engine.archived += [spoken(1, "unblock"), spoken(2, "unblock"), spoken(4)]
    stage.engine.archive_away = False
    stage.wait_for("34")


def test_an_archive_that_hangs_holds_up_nothing(stage, monkeypatch):
    """A start goes on, and decisions are carried out, while the question is open."""
    monkeypatch.setattr(enforcer_app, "_START_S", 0.01)
    stage.engine.archive_hangs = hangs = threading.Event()
    stage.start()
    stage.hear(spoken(4))
    stage.wait_for("1234", working=False)
    stage.engine.archived.append(spoken(4))
    hangs.set()
    stage.wait_for("1234")


def test_a_lift_is_found_after_an_outage_and_carried_out_once(stage):
    """Written while the archive did not answer us, or by a clock that is an hour behind ours."""
    stage.engine.archive_away = True
    asked = stage.app.health()["archive_unanswered"]
    wait_for(lambda: stage.app.tick() or stage.app.health()["archive_unanswered"] > asked)
    stage.engine.archived += [spoken(1, "unblock", ago=HOUR)]
    stage.engine.archive_away = False
    stage.wait_for("23")
    stage.engine.archived += [spoken(2, "unblock")]
    stage.wait_for("3")
    assert (stage.removals(1), stage.removals(2)) == (1, 1)
