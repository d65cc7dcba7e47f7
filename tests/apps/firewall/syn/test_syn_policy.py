"""Which defence follows from the number and repetition of sources, case by case."""

import pytest

from apps.firewall.policy.rules import AllowList
from apps.firewall.syn.services import TcpService
from apps.firewall.syn.syn_policy import Sample, SynRules, judge_syns

WEB = TcpService("10.0.0.1", 80)
NOBODY = AllowList()


def sample(sources: int, each: int, *, strangers: int = 0) -> Sample:
    """So many sources with so many SYNs each, and strangers with one."""
    syns = {f"10.2.{number // 256}.{number % 256}": each for number in range(sources)}
    syns |= {f"77.1.{number // 256}.{number % 256}": 1 for number in range(strangers)}
    return Sample(WEB, syns)


@pytest.mark.parametrize(
    ("given", "kind", "blocked"),
    [
        (sample(1, 600), "block", 1),
        (sample(100, 6), "block", 100),
        (sample(100, 6, strangers=60), "block", 100),
        (sample(100, 6, strangers=80), "protect", 0),
        (sample(0, 0, strangers=600), "protect", 0),
        (sample(300, 2), "protect", 0),
        (sample(201, 4), "protect", 0),
        (sample(1, 49), "nothing", 0),
        (sample(17, 1), "nothing", 0),
    ],
)
def test_defence_follows_from_sources_and_repetition(given, kind, blocked):
    """Few that repeat are blocked; many, or one SYN each, lead to the guard."""
    verdict = judge_syns(given, SynRules(), NOBODY, ())
    assert (verdict.kind, len(verdict.block)) == (kind, blocked)
    assert verdict.protects == (kind == "protect")


def test_the_decision_says_why_in_words():
    """Number of SYNs, of sources and the repeaters' share stand in the reason."""
    verdict = judge_syns(sample(100, 6), SynRules(), NOBODY, ())
    assert "600 unfinished SYNs from 100 sources towards 10.0.0.1:80" in verdict.reason
    assert "100 of the sources repeat and sent 100%" in verdict.reason


@pytest.mark.parametrize(
    ("allow", "known"),
    [(AllowList.parse(("10.2.0.0/24",)), ()), (NOBODY, ("10.2.0.0",))],
)
def test_allowed_and_known_addresses_are_never_blocked(allow, known):
    """Anybody can write the gateway's address into a SYN: then the service is guarded."""
    verdict = judge_syns(sample(1, 600), SynRules(), allow, known)
    assert (verdict.kind, verdict.block) == ("protect", ())
    assert "may be forged" in verdict.reason


def test_known_among_many_is_spared():
    """The others are blocked, and the service is guarded against the spared one."""
    verdict = judge_syns(sample(3, 200), SynRules(), NOBODY, ("10.2.0.1",))
    assert verdict.kind == "block and protect"
    assert verdict.block == ("10.2.0.0", "10.2.0.2")
