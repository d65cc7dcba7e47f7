"""Who dies in a replay is named, and nothing is sent ahead of what is still judged; tests/end_to_end has the replay itself."""

from pathlib import Path

import numpy as np
import pytest

from apps.evidence import Judged
from apps.messages import Alert, Confirmation, Decision, Message, Sender, Target
from due import Item
from sdnator.errors import PipelineError
from sdnator.replay.loop import (
    BLOCKING_WINDOW,
    FREE_WINDOW,
    REPRODUCIBLE_WINDOW,
    WIRE_WINDOW,
    PassResult,
    ReplayOptions,
    ReplayPass,
    _name_the_dead,
)
from sdnator.replay.loop_observer import LoopObserver
from sdnator.replay.packet_accounting import PacketAccounting
from sdnator.replay.quiet_stretches import QuietStretches, Sign
from sdnator.replay.survey import Survey

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
    ("options", "free", "most"),
    [
        ({}, True, FREE_WINDOW["digest"]),
        ({}, False, BLOCKING_WINDOW),
        ({"telemetry": "packet-in"}, True, FREE_WINDOW["packet-in"]),
        ({"window": 300}, True, 300),
        ({"window": 300}, False, 300),
        ({"switch": "bmv2"}, True, WIRE_WINDOW),
        ({"switch": "bmv2", "window": 4}, False, 4),
    ],
)
def test_many_packets_are_in_flight_only_while_nothing_can_be_blocked(options, free, most):
    """An interface takes few, whatever is asked for."""
    assert ReplayOptions(**options).in_flight_limit(free=free) == most


def test_only_training_and_what_a_dry_run_saw_quiet_is_sent_freely():
    """Without a dry run every packet behind training may meet a decision; in a dry run none does."""
    seen = PassResult(PacketAccounting(60), False, signs=[Sign(40 * SECOND)])
    assert _free_until(mitigate=False) == [60, 60, 60, 60]
    assert _free_until(mitigate=True) == [11, 11, 30, 50]
    assert _free_until(mitigate=True, dry_run=seen) == [11, 30, 30, 60]
    seen.decisions.append(_decision("d1", 40 * SECOND, dry_run=True))
    assert _free_until(mitigate=True, dry_run=seen) == [11, 30, 30, 50]


def test_evidence_reports_and_decisions_are_signs():
    """All that may lead to a decision, and no alert; the replay goes back to caution at one that the dry run had not."""
    quiet = QuietStretches(np.arange(60) * SECOND, [Sign(40 * SECOND)])
    result = PassResult(PacketAccounting(60), True)
    observer = LoopObserver(result, quiet)
    observer._on_evidence(_evidence(40 * SECOND, "scan"))
    assert quiet.end(0) == 30
    observer._on_alert(_item(Alert(
        id="a1", sender=Sender(switch="s1", port=1, mac="02:00:00:00:00:01"), event_time=50 * SECOND, first_packet=50,
        packets=9, over=9, peak_score=2.0, anomalous_seconds=1, rate=9.0, training_rate=1.0, mac_addresses=1,
        reason="r",
    )))  # fmt: skip
    assert quiet.end(0) == 30
    observer._on_evidence(_evidence(50 * SECOND, "scan"))
    assert quiet.end(0) == 0
    observer._on_decision(_item(_decision("d1", 51 * SECOND)))
    observer._on_decision(_item(_decision("d2", 52 * SECOND, dry_run=True)))
    assert [sign.time_ns for sign in result.signs] == [each * SECOND for each in (40, 50, 51, 52)]
    assert result.signs[2].senders == ("10.0.0.1",)


def test_headers_come_by_digest_where_the_switch_sends_lists():
    """And as asked for, if it is asked for."""
    assert [ReplayOptions(switch=switch).headers for switch in ("embedded", "bmv2")] == [
        "digest",
        "packet-in",
    ]
    assert ReplayOptions(telemetry="packet-in").headers == "packet-in"


def test_the_next_lap_waits_until_a_decision_is_in_force():
    """Or lifted; a dry run holds nothing up."""
    observer = LoopObserver(PassResult(PacketAccounting(1), True))
    at = 1_000 * SECOND
    observer._on_decision(_item(_decision("d0", at, dry_run=True)))
    assert not observer.is_deciding()
    observer._on_decision(_item(_decision("d1", at)))
    assert observer.is_deciding()
    observer._on_confirmation(
        _item(Confirmation(id="d1", switch="s1", state="installed", action="block", event_time=at))
    )
    assert not observer.is_deciding()
    observer._on_decision(_item(_decision("d1", at + SECOND, action="unblock")))
    assert observer.is_deciding()


def test_replay_knows_when_the_next_block_ends():
    """Until it is lifted or extended, or nobody does either."""
    observer = LoopObserver(PassResult(PacketAccounting(1), True))
    observer._on_decision(_item(_decision("d1", SECOND, expires=9 * SECOND)))
    observer._on_decision(_item(_decision("d2", SECOND, expires=5 * SECOND)))
    assert observer.next_end() == 5 * SECOND
    observer._on_decision(_item(_decision("d2", 5 * SECOND, action="unblock")))
    assert observer.next_end() == 9 * SECOND
    observer._on_decision(_item(_decision("d1", 9 * SECOND, expires=20 * SECOND)))
    assert observer.next_end() == 20 * SECOND
    observer.give_up_end(20 * SECOND)
    assert observer.next_end() is None


def test_a_decision_that_comes_while_packets_are_sent_freely_has_been_overtaken():
    observer = LoopObserver(result := PassResult(PacketAccounting(1), True))
    observer._on_decision(_item(_decision("d1", SECOND)))
    assert result.overtaken == 0
    observer.is_free = True
    observer._on_decision(_item(_decision("d2", SECOND, dry_run=True)))
    assert result.overtaken == 0
    observer._on_decision(_item(_decision("d3", SECOND)))
    assert result.overtaken == 1


@pytest.mark.parametrize(
    ("options", "most"),
    [
        ({}, BLOCKING_WINDOW),
        ({"window": 4_096}, BLOCKING_WINDOW),
        ({"window": 64}, 64),
        ({"switch": "bmv2"}, WIRE_WINDOW),
        ({"reproducible": True}, REPRODUCIBLE_WINDOW),
        ({"reproducible": True, "window": 16}, REPRODUCIBLE_WINDOW),
        ({"reproducible": True, "window": 4_096}, REPRODUCIBLE_WINDOW),
        ({"reproducible": True, "switch": "bmv2"}, REPRODUCIBLE_WINDOW),
    ],
)
def test_reproducible_laps_are_the_same_for_every_window_and_switch(options, most):
    assert ReplayOptions(**options).lap_packets == most


def test_replay_waits_until_evidence_is_judged_and_its_decisions_have_come():
    """Scores say how much evidence there is, the firewall how much of it is judged, and how many decisions it wrote."""
    observer = LoopObserver(PassResult(PacketAccounting(4), True))
    observer._on_score(_scores(0, evidence=0))
    assert not observer.is_judging()
    observer._on_score(_scores(1, evidence=2))
    assert observer.is_judging()
    observer._on_judged(_item(Judged(app="kitsune", evidence=1, decisions=0)))
    observer._on_judged(_item(Judged(app="other", evidence=9, decisions=0)))
    assert observer.is_judging()
    observer._on_judged(_item(Judged(app="kitsune", evidence=2, decisions=1)))
    assert observer.is_judging(), "its decision is still on its way"
    observer._on_decision(_item(_decision("d1", SECOND)))
    assert not observer.is_judging()


def _free_until(*, mitigate: bool, dry_run: PassResult | None = None) -> list[int]:
    """Of a packet a second, 11 for training, from packets 0, 11, 30 and 50 on."""
    nothing = np.zeros(60, np.uint32)
    survey = Survey(
        Path("some.pcap"), np.arange(60) * SECOND, nothing.astype(np.uint64), nothing, 0, None, nothing, nothing,
        plain=True,
    )  # fmt: skip
    options = ReplayOptions(fm_grace=1, ad_grace=9)
    made = ReplayPass(survey, options, mitigate=mitigate, watch=frozenset(), dry_run=dry_run)
    return [made._free_until(sent) for sent in (0, 11, 30, 50)]


def _decision(
    name: str, at: int, *, dry_run: bool = False, action: str = "block", expires: int = 0
) -> Decision:
    return Decision(
        id=name, action=action, switch="s1", target=Target(kind="ip", address="10.0.0.1"), reason="r",
        event_time=at, expires=expires, dry_run=dry_run,
    )  # fmt: skip


def _score(flight: PacketAccounting, index: int) -> None:
    flight.scored(np.array([index], np.uint64), np.ones(1), np.zeros(1, bool))


def _scores(index: int, *, evidence: int) -> Item:
    value = {
        "arrival": np.array([index], np.uint64),
        "score": np.ones(1),
        "state": np.ones(1, np.uint8),
        "evidence": evidence,
    }
    return Item("network.any.app.key", value, 1, 1, "app", "i1", 1)


def _evidence(at: int, kind: str) -> Item:
    return Item(f"network.evidence.kitsune.{kind}", {}, 1, at, "kitsune", "i1", 1)


def _item(message: Message) -> Item:
    return Item("network.any.app.key", message.to_value(), 1, 1, "app", "i1", 1)
