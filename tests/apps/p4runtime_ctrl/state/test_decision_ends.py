"""Ends of decisions come in their order, each once, whatever is lifted or extended meanwhile."""

from apps.messages import Decision, Target
from apps.p4runtime_ctrl.state.decision_ends import DecisionEnds

SECOND = 1_000_000_000


def decision(number, seconds, action="block"):
    target = Target(kind="ip", address=f"192.0.2.{number}")
    return Decision(
        id=f"d{number}", action=action, switch="s1", target=target, reason="a test", event_time=SECOND,
        expires=seconds * SECOND,
    )  # fmt: skip


def test_ends_come_in_their_order_and_once():
    ends = DecisionEnds()
    for number, seconds in ((1, 30), (2, 10), (3, 20)):
        ends.add(decision(number, seconds))
    assert ends.next_us == 10_000_000
    assert not ends.pass_until(9_999_999)
    assert ends.pass_until(20_000_000)
    assert not ends.pass_until(20_000_000)
    assert ends.next_us == 30_000_000


def test_what_has_no_end_or_lifts_is_not_waited_for():
    ends = DecisionEnds()
    ends.add(decision(1, 0))
    ends.add(decision(2, 10, "unblock"))
    assert ends.next_us == 0
