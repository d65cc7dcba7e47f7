"""Which attacks are out of reach follows from budget and training, and each miss has a reason."""

import math
from dataclasses import replace

import pytest

from apps.evidence import TrainingState
from apps.firewall.policy.rules import Rules
from apps.firewall.policy.sequential_test import SequentialTest
from apps.kitsune.behaviour.behaviour import Behaviour
from benchmarks.decision_reach import LOGIN_NATS, missed, needed, shown_soon, unreachable
from benchmarks.decision_traffic.attacks import ATTACKS
from benchmarks.decision_traffic.house import house

NETWORK = house(1)


def attack(name):
    spec = next(spec for spec in ATTACKS if spec.name == name)
    return spec.traffic(NETWORK, 1, 3_600)


@pytest.mark.parametrize(("kind", "nats"), [("scan", 1.0), ("guessing", LOGIN_NATS)])
@pytest.mark.parametrize(("seconds", "budget"), [(3_600.0, 0.1), (3_600.0, 0.5), (1_200.0, 0.1)])
def test_with_one_less_the_bound_cannot_be_reached(seconds, budget, kind, nats):
    """Nobody among the senders of training did anything like it, and each weighs as much as it can."""
    test = SequentialTest(budget)
    test.training = TrainingState(
        packets=1, wanted=1, done=True, seconds=seconds, senders=1_000, event_time=0
    )
    truth = replace(attack("arp scan, slow, known host")[1], kind=kind)
    least = needed(truth, seconds, Rules(false_blocks_per_day=budget))
    rarity = math.log(1_000)
    assert rarity + (least - 1) * nats < test.bound <= rarity + least * nats


def test_a_login_weighs_what_its_baseline_says():
    assert Behaviour(1)._counters["logins"].baseline.least_scale == pytest.approx(1 / LOGIN_NATS)


def test_a_claim_of_anothers_address_needs_no_company():
    assert needed(attack("arp poisoning, known host")[1], 3_600.0, Rules()) == 1


def test_what_an_attack_shows_in_time():
    """Guessing of twice a second opens about ten connections, whose packets are many more."""
    count, what = shown_soon(*attack("ssh guessing, known host"))
    assert what == "logins"
    assert 8 <= count <= 14
    assert shown_soon(*attack("syn scan, one in 5 s, known host")) in [(1, "packets"), (2, "packets")]


def row(**changes):
    return {
        "network": "house",
        "attack": "syn scan",
        "seed": 1,
        "s_to_decision": math.inf,
        "shown_soon": 10,
        "shown": "packets",
        "shown_needed": 6,
        "nats_soon": 7.0,
        "bound": 9.0,
        "refused": [],
    } | changes


def test_every_attack_that_was_not_mitigated_has_a_reason():
    rows = [
        row(s_to_decision=1.0),
        row(shown_soon=2),
        row(shown_soon=1, shown="logins", shown_needed=5),
        row(shown_soon=2, s_to_decision=4.0),
        row(s_to_decision=7.25),
        row(refused=["nobody is blocked"]),
        row(nats_soon=9.5),
    ]
    assert [each["reason"] for each in unreachable(rows)] == [
        "2 packets within 5 s: with fewer than 6 evidence cannot reach the bound",
        "1 login within 5 s: with fewer than 5 evidence cannot reach the bound",
    ]
    assert [each["reason"] for each in missed(rows)] == [
        "decided after 7.2 s; 7.0 nats within 5 s, 9.0 needed",
        "never decided; refused: nobody is blocked",
        "never decided",
    ]
    assert set(missed(rows)[0]) == {"network", "attack", "seed", "reason"}
