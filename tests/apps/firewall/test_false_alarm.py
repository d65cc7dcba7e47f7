"""An operator calls a block a false alarm: it is undone, it teaches, and only operators can do so."""

from apps.messages import Answer, Instruction
from due import Item
from tests.apps.firewall.alerts import CAMERA
from tests.apps.firewall.desk import NOW, Desk, FakeEngine
from tests.apps.firewall.policy.test_sequential_test import evidence
from tests.apps.firewall.test_evidence import AT, desk, hear

INSTRUCTIONS = "network.instruction.*.firewall"


def say(on: Desk, verb: str, subject: str, *, app: str = "operator", name: str = "i1") -> Answer:
    value = Instruction(id=name, verb=verb, subject=subject).to_value()  # type: ignore[arg-type]
    on.hand(f"network.instruction.{app}.firewall", value, pattern=INSTRUCTIONS)
    return Answer.from_value(on.written(f"network.answer.firewall.{app}")[-1])


def backup(at=AT):
    """A new backup job knocks at many hosts: two statistics see it."""
    return [
        evidence(nats, at + n, source, service=service)
        for n in range(8)
        for source, service, nats in (("targets", "tcp/445", 5.0), ("contacts", "", 4.0))
    ]


def scan(at=AT):
    return [evidence(5.0, at + n, "targets", service="tcp/23") for n in range(8)]


def undone():
    on = desk()
    hear(on, *backup())
    (block,) = on.decisions
    return on, block, say(on, "false_alarm", block.id)


def test_the_block_is_undone_and_the_same_behaviour_is_not_blocked_again():
    on, block, answer = undone()
    assert answer.done
    assert "counts a tenth" in answer.text
    assert [each.action for each in on.decisions] == ["block", "unblock"]
    assert {ground.source for ground in block.grounds} == {"kitsune.targets", "kitsune.contacts"}
    for hour in range(24):
        hear(on, *backup(AT + 10 + 3_600 * hour))
    assert len(on.decisions) == 2


def test_a_different_attack_by_the_same_sender_is_blocked():
    """Also while the tamed behaviour goes on beside it, and without an earlier offence."""
    on, _, _ = undone()
    hear(on, *backup(AT + 10), *scan(AT + 10))
    assert on.blocked == [CAMERA.mac] * 2
    assert "earlier block" not in on.decisions[-1].reason


def restarted(on: Desk, *, trained: bool = True) -> Desk:
    """Another firewall with the archive of the first."""
    engine = FakeEngine()
    state = {"packets": 9, "wanted": 9, "done": True, "seconds": 3_600.0, "senders": 20, "event_time": NOW}
    written = [(key, value) for key, value in on.engine.written if "false_alarm" in key]
    written += [("network.training.kitsune", state)] if trained else []
    engine.archived = [Item(key, value, NOW, NOW, key.split(".")[2], "i1", 1) for key, value in written]
    return Desk(rule="sequential", engine=engine)


def test_it_is_kept_over_a_restart_and_can_be_taken_back():
    on, block, _ = undone()
    after = restarted(on)
    hear(after, *backup(AT + 60))
    assert not after.blocked
    assert say(after, "revoke", block.id).done
    hear(after, *backup(AT + 120))
    assert after.blocked == [CAMERA.mac]
    assert not say(after, "revoke", block.id, name="i2").done


def test_a_firewall_that_starts_again_knows_that_training_is_done():
    """Else it would block nobody until Kitsune is restarted, too."""
    after = restarted(desk())
    hear(after, *scan())
    assert after.blocked == [CAMERA.mac]
    unknown = restarted(desk(), trained=False)
    hear(unknown, *scan())
    assert not unknown.blocked


def test_no_other_app_can_say_so():
    """An app that is allowed to give evidence, or to block and unblock, cannot make anybody deaf."""
    on = desk(evidence_apps=("honeypot",))
    hear(on, *backup())
    (block,) = on.decisions
    answer = say(on, "false_alarm", block.id, app="honeypot")
    assert (answer.done, "only operators" in answer.text) == (False, True)
    item = Item(
        "network.instruction.operator.firewall",
        Instruction(id="i2", verb="false_alarm", subject=block.id).to_value(),
        NOW,
        NOW,
        "honeypot",
        "i1",
        1,
    )
    on.engine.subjects[INSTRUCTIONS].on_next(item)  # written under the operator's key by another app
    assert on.service.health()["refused_by_cause"] == {"sender": 1}
    assert on.decisions == [block]
    assert on.service.health()["false_alarms"] == 0


def test_a_block_that_is_over_can_still_teach():
    """Its decision is then in the archive only."""
    on = desk()
    hear(on, *backup())
    (block,) = on.decisions
    after = desk()
    after.engine.archived = [
        Item("network.block.firewall.mac", block.to_value(), NOW, NOW, "firewall", "i1", 1)
    ]
    after.service._lifecycle.blocks.clear()
    assert say(after, "false_alarm", block.id).done
    hear(after, *backup(AT + 60))
    assert not after.blocked


def test_what_no_evidence_led_to_is_lifted_and_teaches_nothing():
    on = desk()
    on.hand(
        "network.instruction.operator.firewall",
        Instruction(id="i0", verb="block", subject="192.0.2.1").to_value(),
        pattern=INSTRUCTIONS,
    )
    answer = say(on, "false_alarm", on.decisions[0].id)
    assert (answer.done, "nothing is learnt" in answer.text) == (True, True)
    assert [each.action for each in on.decisions] == ["block", "unblock"]
    assert not say(on, "false_alarm", "nonsense", name="i2").done
