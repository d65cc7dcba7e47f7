"""What earlier runs left in the archive is taken up, at the start or as soon as the archive answers."""

import threading
import time

import pytest
from msgspec import structs

from apps.firewall.policy.block_lifecycle import SECOND, BlockLifecycle
from apps.firewall.policy.rules import Rules
from apps.messages import Answer, Decision, Instruction, Sender, Target
from due import Item
from tests.apps.firewall.alerts import alert
from tests.apps.firewall.desk import ALERT, NOW, Desk, FakeEngine

INSTRUCTION = "network.instruction.operator.firewall"
INSTRUCTIONS = "network.instruction.*.firewall"
ALLOWED, OLD, OTHER = "10.0.0.77", "192.0.2.66", "192.0.2.99"


class Archived:
    """Items of earlier runs, each a nanosecond later than the one before."""

    def __init__(self) -> None:
        self.items: list[Item] = []

    def add(self, key: str, value: object, app: str = "firewall", at: int = 0) -> None:
        number = len(self.items) + 1
        self.items.append(Item(key, value, at or number, NOW, app, "i", number))

    def say(self, verb: str, subject: str = "", *, at: int = 0, done: bool | None = True) -> None:
        """An instruction with a deadline, and the answer; None: there was none."""
        name = f"i{len(self.items)}"
        said = {"id": name, "verb": verb, "subject": subject, "expires": at + 10 * SECOND}
        self.add(INSTRUCTION, Instruction.from_value(said).to_value(), "operator", at)
        if done is not None:
            self.add(
                "network.answer.firewall.operator", Answer(id=name, done=done, text="").to_value(), at=at
            )


def block_of(address: str) -> Decision:
    return BlockLifecycle(Rules()).open("*", Target(kind="ip", address=address), "hot", (), NOW)


def instruct(desk: Desk, verb: str, subject: str = "") -> None:
    said = Instruction.from_value({"id": f"{verb} {subject}", "verb": verb, "subject": subject})
    desk.hand(INSTRUCTION, said.to_value(), pattern=INSTRUCTIONS)


def attack(desk: Desk, address: str) -> None:
    sender = Sender(switch="s1", port=1, mac=f"02:00:00:00:00:{address[-2:]}", ip=address)
    hot = structs.replace(alert(anomalous_seconds=5), sender=sender, event_time=NOW)
    desk.hand(ALERT, hot.to_value())


def in_force(desk: Desk) -> set[str]:
    blocks = (each.decision for each in desk.service._lifecycle.blocks.values())
    return {each.target.address for each in blocks}


@pytest.fixture
def away(monkeypatch) -> Desk:
    """A firewall whose archive, which holds an allowed address and a block, is away from the start."""
    monkeypatch.setattr("apps.firewall.evidence.archive.ASK_AGAIN_S", 0.0)
    past = Archived()
    past.say("allow", ALLOWED)
    past.add("network.block.firewall.ipv4", block_of(OLD).to_value(), at=time.time_ns())
    engine = FakeEngine()
    engine.archived, engine.archive_away = past.items, True
    return Desk(engine=engine, enforcers=("p4runtime_ctrl", "nftables"))


def comes_back(desk: Desk) -> None:
    desk.engine.archive_away = False
    desk.tick_until(lambda: not desk.service.health()["blocking_stopped"])


def test_an_archive_that_is_away_is_not_an_empty_one(away):
    """Who is allowed is not known, so nobody is blocked; when it is known all is as if the archive had been there."""
    attack(away, ALLOWED)
    attack(away, OTHER)
    assert in_force(away) == set()
    health = away.service.health()
    assert health["blocking_stopped"] == 1
    assert "allowed is not known" in health["stopped_by"]
    assert any("BLOCKING STOPPED" in text for text in away.events)
    comes_back(away)
    attack(away, ALLOWED)
    attack(away, OTHER)
    assert away.service._desk.entries == (ALLOWED,)
    assert in_force(away) == {OLD, "02:00:00:00:00:99"}
    assert away.service.health()["stopped_by"] == ""


def test_what_operators_say_is_carried_out_while_the_archive_is_away(away):
    """And holds afterwards; a block of somebody who turns out to be allowed does not."""
    instruct(away, "block", "192.0.2.1")
    instruct(away, "block", ALLOWED)
    instruct(away, "allow", "10.0.0.78")
    assert in_force(away) == {"192.0.2.1", ALLOWED}
    comes_back(away)
    assert in_force(away) == {OLD, "192.0.2.1"}
    assert set(away.service._desk.entries) == {ALLOWED, "10.0.0.78"}


def test_a_panic_while_the_archive_is_away_ends_what_is_in_it(away):
    instruct(away, "panic")
    instruct(away, "block", "192.0.2.1")
    comes_back(away)
    assert in_force(away) == {"192.0.2.1"}
    assert [each.target.address for each in away.decisions if each.action == "unblock"] == [OLD]


def test_the_switch_keeps_what_is_allowed_while_the_archive_is_away(away):
    """Nothing is deleted there, and other enforcers are told of the whole list or of none."""

    def kept() -> list[str]:
        commands = away.written("network.p4_command.firewall_kept.")
        return [update["kind"] for command in commands for update in command["updates"]]

    instruct(away, "allow", "10.0.0.78")
    assert kept() == ["insert"]
    assert away.written("network.allowed.firewall") == []
    comes_back(away)
    away.service.tick()
    assert kept() == ["insert", "insert"]
    (told,) = away.written("network.allowed.firewall")
    assert set(told["entries"]) == {ALLOWED, "10.0.0.78"}


def test_what_an_earlier_run_did_not_answer_is_carried_out_when_the_archive_is_back(away):
    said = Instruction(id="late", verb="block", subject="192.0.2.1")
    now = time.time_ns()
    away.engine.archived.append(Item(INSTRUCTION, said.to_value(), now, now, "operator", "o1", 9))
    away.service.tick()
    assert in_force(away) == set()
    comes_back(away)
    away.service.tick()
    assert in_force(away) == {OLD, "192.0.2.1"}


def test_a_tick_does_not_wait_for_the_archive(away):
    """The supervisor would kill a firewall whose main thread hangs."""
    away.engine.archive_hangs, away.engine.archive_away = threading.Event(), False
    away.service.tick()
    away.service.tick()
    assert away.service.health()["blocking_stopped"] == 1
    away.engine.archive_hangs.set()
    comes_back(away)
    assert in_force(away) == {OLD}


def test_the_allow_list_is_complete_however_many_instructions_came_after_it():
    """Only those that were carried out count, and their answers are as old as they are."""
    past = Archived()
    past.say("allow", ALLOWED)
    past.say("allow", "10.0.0.78")
    past.say("disallow", "10.0.0.78")
    past.say("allow", "10.0.0.79", done=False)
    past.say("disallow", ALLOWED, done=None)
    for number in range(1_100):
        past.add("network.answer.firewall.operator", Answer(id=f"b{number}", done=True, text="").to_value())
    engine = FakeEngine()
    engine.archived = past.items
    assert Desk(engine=engine).service._desk.entries == (ALLOWED,)
