"""Who dies in a replay is named; tests/end_to_end has the replay itself."""

import pytest
from msgspec import structs

from apps.messages import Confirmation, Decision, Message, Target
from due import Item
from sdnator.errors import PipelineError
from sdnator.replay.loop import (
    BLOCKING_WINDOW,
    FREE_WINDOW,
    WIRE_WINDOW,
    PassResult,
    ReplayOptions,
    _name_the_dead,
    _Observer,
)
from sdnator.replay.packet_accounting import PacketAccounting

SECOND = 1_000_000_000


class Dying:
    """A pipeline whose switch has closed its sockets and is about to have ended."""

    looks = 0

    def check(self):
        self.looks += 1
        if self.looks > 3:
            raise PipelineError("switch was killed by SIGKILL")


def test_a_part_that_is_still_dying_is_waited_for():
    with pytest.raises(PipelineError, match="switch was killed"):
        _name_the_dead(Dying())


@pytest.mark.parametrize(
    ("options", "mitigate", "sent", "most"),
    [
        ({}, False, 100_000, FREE_WINDOW["digest"]),
        ({}, True, 10, FREE_WINDOW["digest"]),
        ({}, True, 55_001, BLOCKING_WINDOW),
        ({"telemetry": "packet-in"}, True, 10, FREE_WINDOW["packet-in"]),
        ({"window": 300}, False, 10, 300),
        ({"window": 300}, True, 55_001, 300),
        ({"switch": "bmv2"}, False, 10, WIRE_WINDOW),
        ({"switch": "bmv2", "window": 4}, True, 10, 4),
    ],
)
def test_many_packets_are_in_flight_only_while_nothing_can_be_blocked(options, mitigate, sent, most):
    """Training blocks nobody; an interface takes few, whatever is asked for."""
    assert ReplayOptions(**options).in_flight_limit(sent, mitigate=mitigate) == most


def test_headers_come_by_digest_where_the_switch_sends_lists():
    """And as asked for, if it is asked for."""
    assert [ReplayOptions(switch=switch).headers for switch in ("embedded", "bmv2")] == [
        "digest",
        "packet-in",
    ]
    assert ReplayOptions(telemetry="packet-in").headers == "packet-in"


def test_replay_does_not_run_away_from_a_decision_on_its_way():
    """A second of capture time behind the decision packets wait for the switch's answer; a dry run holds nothing up."""
    observer = _Observer(PassResult(PacketAccounting(1), True))
    at = 1_000 * SECOND
    made = Decision(
        id="d1", action="block", switch="s1", target=Target(kind="ip", address="10.0.0.1"), reason="r",
        event_time=at, expires=0,
    )  # fmt: skip
    observer._on_decision(_item(structs.replace(made, id="d0", dry_run=True)))
    assert not observer.is_ahead(at + 60 * SECOND)
    observer._on_decision(_item(made))
    assert not observer.is_ahead(at + SECOND)
    assert observer.is_ahead(at + SECOND + 1)
    observer._on_confirmation(
        _item(Confirmation(id="d1", switch="s1", state="installed", action="block", event_time=at))
    )
    assert not observer.is_ahead(at + 60 * SECOND)


def _item(message: Message) -> Item:
    return Item("network.any.app.key", message.to_value(), 1, 1, "app", "i1", 1)
