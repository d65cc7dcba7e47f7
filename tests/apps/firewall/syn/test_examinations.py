"""Floods are examined at a capture time: as soon as the packets have reached it, however fast they come."""

from apps.firewall.syn.examinations import Examinations
from apps.firewall.syn.flood_evidence import Suspicion
from tests.apps.firewall.syn.test_syn_defence import FLOOD

SECOND = 1_000_000_000
NOW = 1_700_000_000 * SECOND
MS = 1_000_000


def suspicion(host: str = "10.0.0.1", at: int = NOW) -> Suspicion:
    return Suspicion(host, FLOOD, at, at - SECOND)


def waiting(*, live: bool) -> Examinations:
    made = Examinations(grace_ms=100, patience_ms=1000)
    made.live = live
    made.suspect(suspicion(), 50.0)
    return made


def test_capture_time_decides_at_any_speed():
    """Ten seconds of a capture within a millisecond, or a quarter of one in an hour."""
    made = waiting(live=False)
    made.hear(NOW + 99 * MS, 3650.0)
    assert made.due(3650.0) == []
    made.hear(NOW + 10 * SECOND, 3650.001)
    (examined,) = made.due(3650.001)
    assert (examined.at, examined.sure) == (NOW + 100 * MS, False)
    made.doubt(examined, 3650.001)
    (again,) = made.due(3650.001)
    assert (again.at, again.sure) == (NOW + 1100 * MS, True)


def test_silence_decides_on_a_live_switch():
    made = waiting(live=True)
    made.hear(NOW + 20 * MS, 50.05)
    assert made.due(50.14) == []
    (examined,) = made.due(50.15)
    made.doubt(examined, 50.15)
    assert made.due(51.0) == []
    assert [each.sure for each in made.due(51.15)] == [True]


def test_a_look_that_came_too_early_is_repeated_with_the_next_syns():
    """Not a grace period later: the sample that it waits for may be full by then."""
    made = waiting(live=True)
    made.hear(NOW + 130 * MS, 50.0)
    (early,) = made.due(50.0)
    assert made.again(early, 50.0, soon=True) == 0.01
    assert made.due(50.0)[0].at == NOW + 130 * MS
    made.again(early, 50.0, soon=False)
    assert made.due(50.0) == []
    made.hear(NOW + 200 * MS, 50.0)
    assert made.due(50.0)[0].at == NOW + 200 * MS


def test_silence_of_a_stalled_replay_decides_nothing():
    """Nor does a tick that has overtaken SYNs; a tick and silence together are the end of the capture."""
    made = waiting(live=False)
    assert made.due(500.0) == []
    made.tick(NOW + 2 * SECOND)
    made.hear(NOW + 50 * MS, 500.0)
    assert made.due(500.05) == []
    assert len(made.due(500.1)) == 1


def test_clock_that_was_set_back_decides_nothing_at_once():
    made = waiting(live=True)
    made.hear(NOW + SECOND, 50.0)
    made.due(50.0)
    early = NOW - 2 * 3600 * SECOND
    made.hear(early, 60.0)
    made.suspect(suspicion(at=early), 60.0)
    assert made.due(60.05) == []


def test_suspicions_are_bounded():
    made = Examinations(grace_ms=100, patience_ms=1000, most=3)
    for number in range(5):
        made.suspect(suspicion(f"10.0.0.{number}"), 0.0)
        made.suspect(suspicion(f"10.0.0.{number}"), 0.0)
    assert len(made) == 3
