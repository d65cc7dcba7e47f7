"""Runs that share a detector decide, drop and score as if each had one of its own."""

from functools import partial

import numpy as np
import pytest

from apps.firewall.policy.rules import Rules
from benchmarks.decision_jobs import Jobs
from benchmarks.decisions_core import DecisionRun, feed_apart
from tests.apps.kitsune.behaviour.test_behaviour import SYN, handshake, packet
from tests.benchmarks.test_planted_evidence import ATTACKER, HOST, SERVER, traffic, training

# the copies use no thread of their parent
pytestmark = pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")

RULES = ("sequential", "paper", "seconds")


def attack():
    """A scan that is blocked at once, a flood that ends in a block or not, and somebody who goes on working."""
    rows = [packet(1_210 + n / 50, ATTACKER, SERVER, 50_000, 1_000 + n, SYN) for n in range(400)]
    rows += [packet(1_212 + n / 200, 0x0A000077, SERVER, 40_000 + n, 80, SYN) for n in range(800)]
    rows += [row for at in range(20) for row in handshake(1_210 + at, HOST, SERVER, 45_000 + at, 80)]
    return traffic(rows)


def told(runs):
    return {
        run.rules.rule: {
            "decided": [(each.time_ns, each.reason, each.target, each.service) for each in run.decided],
            "refused": run.refused,
            "stopped": run.stopped,
            "challenges": run.challenges,
            "scores": run.scores,
        }
        for run in runs
    }


def alone(rule):
    rows = training()
    run = DecisionRun(len(rows), Rules(rule=rule))
    run.feed(traffic(rows))
    run.feed(attack())
    return told([run])[rule]


@pytest.mark.parametrize("rules", [RULES, RULES[1:], RULES[:1]], ids="-".join)
def test_runs_that_share_a_detector_are_as_alone(rules):
    rows = training()
    trained = DecisionRun(len(rows), Rules())
    trained.feed(traffic(rows))
    runs = [DecisionRun(len(rows), Rules(rule=rule), trained.detector) for rule in rules]
    found = Jobs(2).all([partial(feed_apart, runs, attack(), Jobs(2), told)])[0]
    assert set(found) == set(rules)
    for rule in rules:
        expected = alone(rule)
        for name, value in expected.items():
            assert np.array_equal(found[rule][name], value), (rule, name)


def test_the_rules_part_in_this_attack():
    """Else the test above would compare runs of which nobody drops anything."""
    assert alone("sequential")["stopped"].sum() > 100
    assert not np.array_equal(alone("sequential")["stopped"], alone("paper")["stopped"])
