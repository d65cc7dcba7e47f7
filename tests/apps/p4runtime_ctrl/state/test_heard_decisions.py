"""Of decisions heard live the last word is kept, and of those that were lifted only for a while."""

import logging

from apps.messages import Decision, Intake, Target
from apps.p4runtime_ctrl.state.heard_decisions import LIFTS_HELD_S, MOST, HeardDecisions
from apps.p4runtime_ctrl.state.history import decisions_for
from due import Item

_SECOND = 1_000_000_000


def _decision(name, second, *, action="block", switch="*", expires=0):
    return Decision(
        id=name,
        action=action,
        switch=switch,
        target=Target(kind="ip", address=f"198.18.0.{int(name) % 250}"),
        reason="a reason",
        event_time=second * _SECOND,
        expires=expires,
    )


def _words(heard):
    return [(each.id, each.action, each.expires) for _, each in heard]


def test_the_last_word_about_each_decision_is_kept_in_the_order_of_hearing():
    heard = HeardDecisions()
    heard.hear(_decision("1", 1, expires=5))
    heard.hear(_decision("2", 2))
    heard.hear(_decision("1", 3, expires=9))
    heard.hear(_decision("3", 4))
    heard.hear(_decision("2", 5, action="unblock"))
    assert _words(heard) == [("1", "block", 9), ("3", "block", 0), ("2", "unblock", 0)]
    assert all(not each.reason for _, each in heard), "what led to it is not needed"


def test_a_guard_that_is_told_to_one_switch_is_kept_for_the_others_too():
    heard = HeardDecisions()
    for switch in ("*", "s2"):
        heard.hear(_decision("1", 1, action="protect", switch=switch))
    assert {each.switch for _, each in heard} == {"*", "s2"}


def test_hours_of_blocks_that_end_again_take_no_more_than_one_hour_of_them():
    """An operator's program that blocks for two minutes, again and again."""
    heard = HeardDecisions()
    sizes = []
    for number in range(4 * 360):
        second = 10 * number
        heard.hear(_decision(str(number), second))
        if number >= 12:
            heard.hear(_decision(str(number - 12), second, action="unblock"))
        sizes.append(len(heard))
    assert max(sizes) <= LIFTS_HELD_S / 10 + 14
    assert sizes[-1] == sizes[2 * 360]


def test_what_stands_is_kept_however_old_it_is_up_to_a_number():
    heard = HeardDecisions()
    heard.hear(_decision("0", 0))
    heard.hear(_decision("1", 100 * LIFTS_HELD_S))
    assert _words(heard) == [("0", "block", 0), ("1", "block", 0)]
    for number in range(2, MOST + 2):
        heard.hear(_decision(str(number), 100 * LIFTS_HELD_S))
    assert len(heard) == MOST
    assert next(iter(heard))[1].id == "2"


def test_a_lift_holds_against_a_block_that_the_archive_has_alone():
    heard = HeardDecisions()
    block = _decision("7", 1)
    heard.hear(block)
    heard.hear(_decision("7", 2, action="unblock"))
    archived = Item("network.block.firewall.ipv4", block.to_value(), 50, 50, "firewall", "i", 1)
    found = decisions_for("s1", [archived], list(heard), 0, Intake(logging.getLogger("test")))
    assert _words(found) == [("7", "unblock", 0)]
