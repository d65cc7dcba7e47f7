"""Evidence adds up, fades, and decides at a bound that follows from the budget of false blocks."""

import math

import pytest
from msgspec import structs

from apps.evidence import Evidence, TrainingState
from apps.firewall.policy.sequential_test import (
    FADED_NATS,
    FADED_SUPPORT_NATS,
    HALF_LIFE_S,
    PLACE_HELD_S,
    SequentialTest,
)
from tests.apps.firewall.alerts import CAMERA, SECOND


def evidence(nats=4.0, at_s=100, source="ports", **changes):
    fields = {
        "id": f"{source}-{at_s}",
        "kind": "scan",
        "source": source,
        "sender": CAMERA,
        "nats": nats,
        "since": at_s * SECOND,
        "event_time": at_s * SECOND,
        "packets": 5,
        "mac_addresses": 1,
        "text": f"{source} of a camera",
    }
    return Evidence(**(fields | changes))


def trained(seconds=3_600.0, senders=20, budget=0.1, done=True):
    test = SequentialTest(budget)
    test.training = TrainingState(
        packets=9, wanted=9, done=done, seconds=seconds, senders=senders, event_time=1
    )
    return test


def total(test, *heard):
    for each in heard:
        tally = test.hear(each, "kitsune")
    return tally.total(heard[-1].event_time, test.bound)


def test_the_bound_is_the_logarithm_of_what_training_leaves_open():
    """Twice the training or twice the budget lower it by ln 2; more senders raise it."""
    bound = trained().bound
    assert bound == pytest.approx(math.log(20 * 86_400 / (3_600 * 0.1)))
    assert bound - trained(seconds=7_200).bound == pytest.approx(math.log(2))
    assert bound - trained(budget=0.2).bound == pytest.approx(math.log(2))
    assert trained(senders=40).bound > bound


@pytest.mark.parametrize("test", [SequentialTest(0.1), trained(done=False), trained(seconds=5)])
def test_without_enough_training_nobody_may_be_blocked(test):
    assert test.too_short


def test_evidence_of_one_source_adds_up_and_fades():
    test = trained()
    assert total(test, evidence(2.0, 100), evidence(3.0, 100)) == pytest.approx(5.0)
    later = 100 + int(HALF_LIFE_S)
    assert total(test, evidence(0.0, later)) == pytest.approx(2.5)


def test_sums_that_have_faded_and_places_of_long_ago_are_forgotten():
    """A network that meets ever new addresses keeps those of the last hour, and no sum that could still count."""
    test = trained()
    for number in range(50):
        sender = structs.replace(CAMERA, ip=f"198.51.100.{number}")
        test.hear(evidence(1.0, 100 + number, sender=sender), "kitsune")
    strong = evidence(40.0, 200, sender=structs.replace(CAMERA, ip="198.51.100.99"))
    test.hear(strong, "kitsune")
    assert len(test) == 51
    assert total(test, evidence(1.0, 100 + PLACE_HELD_S)) == pytest.approx(1.0)
    assert len(test) == 2
    assert test.sum_of(structs.replace(strong, event_time=(100 + PLACE_HELD_S) * SECOND)) > 0.5
    named = evidence(1.0, 300, sender=None, address="198.51.100.99")
    assert test.placed(named).sender == strong.sender
    test.hear(evidence(1.0, 400 + PLACE_HELD_S), "kitsune")
    assert test.placed(named) == named


def test_sources_that_saw_the_same_packets_are_not_added_in_full():
    assert total(trained(), evidence(6.0), evidence(4.0, source="contacts")) == pytest.approx(7.0)


def test_what_only_supports_never_decides():
    """However unlike training it looks: a new and benign thing looks so, too."""
    test = trained()
    assert total(test, *[evidence(50.0, source="scores", supporting=True)] * 9) < test.bound / 2
    assert total(test, evidence(6.0)) == pytest.approx(6.0 + 0.3 * test.bound)


def test_forgeable_evidence_of_an_address_supports_what_there_is_against_its_sender():
    """Anybody behind a router may scan under the address of a host; what a handshake proves counts in full."""
    named = {"sender": None, "address": CAMERA.ip, "source": "port_scan"}
    test = trained()
    assert total(test, evidence(0.01), evidence(40.0, **named)) == pytest.approx(0.01 + 0.3 * test.bound)
    # what names the sender itself keeps its weight, whatever its source is called
    assert total(test, evidence(6.0, source="port_scan")) == pytest.approx(
        6.0 + 0.25 * 0.01 + 0.3 * test.bound
    )
    assert total(trained(), evidence(0.0), evidence(40.0, forgeable=False, **named)) == pytest.approx(40.0)


def test_after_a_clock_was_set_back_sums_and_places_are_forgotten_as_before():
    """What was noted while it was ahead by a day holds for no day."""
    test, ahead = trained(), 100 + 86_400
    place = structs.replace(CAMERA, ip="198.51.100.9")
    test.hear(evidence(1.0, ahead, sender=place), "kitsune")
    test.hear(evidence(1.0, 100), "kitsune")
    assert test.placed(evidence(sender=None, address=place.ip)).sender is None
    other = structs.replace(CAMERA, ip="198.51.100.10")
    test.hear(evidence(1.0, 100 + 12 * int(HALF_LIFE_S), sender=other), "kitsune")
    assert CAMERA not in test._tallies


def test_a_sum_that_was_noted_while_the_clock_was_ahead_fades_all_the_same():
    test = trained()
    test.hear(evidence(8.0, 100 + 86_400), "kitsune")
    test.hear(evidence(1.0, 100, source="other"), "kitsune")
    later = 100 + 2 * int(HALF_LIFE_S)
    (tally,) = test._tallies.values()
    assert tally.total(later * SECOND, test.bound) < 8.0 / 3


def test_victims_of_forged_senders_have_a_sum_of_their_own():
    test = trained()
    flood = structs.replace(evidence(8.0), sender=None, victims=("10.0.0.1",), service="tcp/80")
    assert total(test, evidence(5.0)) == pytest.approx(5.0)
    assert total(test, flood) == pytest.approx(8.0)


def test_apps_may_use_the_same_name_for_a_source():
    test = trained()
    test.hear(evidence(4.0), "kitsune")
    tally = test.hear(evidence(4.0), "other")
    assert tally.total(100 * SECOND, test.bound) == pytest.approx(5.0)


def test_subjects_are_bounded():
    test = trained()
    for number in range(20_000):
        sender = structs.replace(CAMERA, ip=f"10.{number >> 16}.{number >> 8 & 255}.{number & 255}")
        test.hear(evidence(sender=sender), "kitsune")
    assert len(test) == 16_384


@pytest.mark.parametrize(
    ("supporting", "least"), [(False, FADED_NATS), (True, FADED_SUPPORT_NATS)], ids=["alone", "supporting"]
)
def test_what_only_supports_is_forgotten_sooner(supporting, least):
    """It decides nothing by itself, and most strangers of a busy network have no other evidence against them."""
    test = trained()
    test.hear(evidence(2.0, 100, supporting=supporting), "kitsune")
    half_lives = math.log2(2.0 / least)
    for share, left in ((0.95, 1), (1.1, 0)):
        someone = structs.replace(CAMERA, ip=f"10.9.9.{left}")
        test.hear(evidence(1.0, 100 + int(share * half_lives * HALF_LIFE_S), sender=someone), "kitsune")
        assert (CAMERA in test._tallies) == bool(left)


def test_of_a_piece_its_words_are_kept_if_it_added_something():
    """Kitsune says of each sender every ten seconds that a packet scored too high, at no nats."""
    test = trained()
    told = test.hear(evidence(0.0, 100, source="threshold"), "kitsune").contributions
    assert told["kitsune.threshold"].latest.text == ""
    test.hear(evidence(2.0, 100), "kitsune")
    assert told["kitsune.ports"].latest.text == "ports of a camera"
    test.hear(evidence(0.0, 110, text="nothing new"), "kitsune")
    assert told["kitsune.ports"].latest.text == "ports of a camera"
    assert {each.latest.id for each in told.values()} == {""}
