"""What is read back from the archive is checked, and a plain address is one of a sender's two names."""

from contextlib import suppress

import pytest

from apps.evidence import Evidence
from apps.messages import MessageError, Sender
from apps.sonata_adapter.evidence.count_baseline import BLOCKS, MOST_HOSTS, CountBaseline, CountTraining
from tests.apps.hostile import NOW, mutations

SECOND = 10**6


def trained(counts):
    """After windows of a second with these counts, each of a host of its own or of the one named."""
    training = CountTraining()
    for place, (host, count) in enumerate(counts):
        training.learn(host, place * SECOND, SECOND, count)
    return training.close("query", 10, begin_us=0, end_us=len(counts) * SECOND)


def test_wrong_baselines_are_refused():
    """Whatever is in the archive: the one error, or a baseline that can be used."""
    genuine = trained([("10.0.0.1", 12.0), ("10.0.0.2", 30.0)]).to_value()
    for value in mutations(genuine):
        with suppress(MessageError):
            assert CountBaseline.from_value(value).nats("10.0.0.3", 1e6) >= 0
    assert CountBaseline.from_value(genuine).highest == {"10.0.0.1": 12.0, "10.0.0.2": 30.0}


def test_training_is_bounded():
    """In hosts, whose counts go to all of them, and in blocks, however long it lasts."""
    baseline = trained([(f"host{n}", float(n)) for n in range(MOST_HOSTS + 10)])
    assert len(baseline.highest) == MOST_HOSTS
    assert baseline.newcomer == MOST_HOSTS + 9
    assert baseline.seconds > 2 * BLOCKS


def test_hosts_that_are_new_are_counted_when_a_quarter_of_training_is_over():
    """A host counts once in a window, from however many switches; with a host that was not kept nothing is said."""
    found = trained([("10.0.0.1", 12.0)] * 60 + [("10.0.0.2", 12.0)] * 20)
    assert (found.host_windows, found.fresh) == (80, 1)
    training = CountTraining()
    for window in (0, 0, 1, 1):
        training.learn("10.0.0.1", window * SECOND, SECOND, 12.0)
    assert training.close("query", 10, begin_us=0, end_us=2 * SECOND).host_windows == 2
    many = trained([(f"host{n}", float(n)) for n in range(MOST_HOSTS + 10)])
    assert (many.host_windows, many.fresh) == (0, 0)
    assert many.rare_when_new(1.0) == many.rare(1.0)


def test_an_outlier_of_a_block_widens_the_scale():
    """Left out, it lies far above the others: such a count is nothing new here."""
    steady = trained([("10.0.0.1", 40.0)] * 100)
    outlier = trained([("10.0.0.1", 80.0 if place == 50 else 40.0) for place in range(100)])
    assert steady.scale(40) == pytest.approx(10)
    assert outlier.scale(40) == pytest.approx(40 * 40 / 41)


def test_evidence_names_a_sender_once():
    """Switch, port and MAC, or a plain address, or only victims; and it is an address."""
    kept = {
        "id": "e",
        "kind": "scan",
        "source": "port_scan",
        "nats": 1.0,
        "since": NOW,
        "event_time": NOW,
        "packets": 1,
        "text": "",
    }
    sender = Sender(switch="s1", port=1, mac="02:00:00:00:00:01").to_value()
    assert Evidence.from_value({**kept, "address": "10.0.0.1"}).address == "10.0.0.1"
    for wrong in ({"address": "10.0.0.1", "sender": sender}, {"address": "x"}, {}):
        with pytest.raises(MessageError):
            Evidence.from_value({**kept, **wrong})
