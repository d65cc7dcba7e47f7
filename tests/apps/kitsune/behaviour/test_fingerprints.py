"""SYNs with their destination's address as sequence number are a scanner's; what no stack does weighs at once."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apps.kitsune.behaviour.fingerprints import MOST_AT_A_TIME, NUMBERS, SynFingerprints
from apps.kitsune.detector import Detector, DetectorSettings
from apps.kitsune.kernel import ColumnError
from apps.kitsune.model_file import load_model
from tests.apps.kitsune.behaviour.test_behaviour import (
    ACK,
    HOST,
    SERVER,
    SYN,
    SYN_ACK,
    batch,
    handshake,
    packet,
)  # fmt: skip
from tests.apps.kitsune.random_traffic import FLAGS, traffic
from tests.naive.kitsune.fingerprints import PythonSynFingerprints

SENDERS = 40
SYNS = 5_000
FAR = 0x5DB8D822


def marked(at=1.0, target=FAR, **changes):
    return packet(at, HOST, target, 1_024, 23, SYN) | {"tcp_seq": target} | changes


def trained(syns=SYNS, infected=0):
    fingerprints = SynFingerprints()
    rows = [packet(0.0, HOST, SERVER, 30_000 + n, 80, SYN) | {"tcp_seq": n + 1} for n in range(syns)]
    rows += [marked(0.0) for _ in range(infected)]
    assert not fingerprints.add(batch(rows), "s1", len(rows), SENDERS)
    return fingerprints


def of_training(*more):
    """A detector that has seen a host talk to a server for ten minutes, and more."""
    rows = [row for at in range(0, 600, 10) for row in handshake(at, HOST, SERVER, 30_000 + at, 80)]
    rows += more
    detector = Detector(DetectorSettings(fm_grace=50, ad_grace=len(rows) - 51))
    detector.process(batch(rows), "s1")
    return detector


def said(detector):
    """The one piece of evidence about the sequence number."""
    (evidence,) = [each for each in detector.take_evidence() if each.source == "fingerprint"]
    return evidence


def found(fingerprints, *rows):
    return fingerprints.add(batch(rows), "s1", 0, SENDERS)


def test_one_weighs_what_chance_makes_of_all_syns_of_a_training():
    (finding,) = found(trained(), marked())
    assert finding.nats == pytest.approx(math.log(SENDERS / (SYNS / NUMBERS)))
    assert finding.sender == ("s1", HOST & 0xFF, HOST, HOST)
    assert (finding.victim, finding.count, finding.usual) == (FAR, 1, 0)


def test_the_next_one_weighs_as_much_until_there_is_enough():
    fingerprints = trained()
    rows = [marked(n / 100, FAR + n) for n in range(20)]
    nats = [each.nats for each in found(fingerprints, *rows)]
    assert nats[0] == pytest.approx(nats[1], rel=1e-3)
    assert sum(nats) == pytest.approx(50.0, rel=1e-3)


def test_a_training_with_an_infected_host_makes_it_weigh_less():
    assert found(trained(infected=2), marked())[0].nats == pytest.approx(math.log(SENDERS / 2), rel=1e-3)
    assert not found(trained(infected=2 * SENDERS), marked())


@pytest.mark.parametrize(
    "row",
    [
        marked(tcp_seq=FAR + 1),
        marked(tcp_flags=SYN_ACK),
        marked(tcp_flags=ACK),
        marked(quoted=1),
        marked(ip_version=6),
        packet(1.0, HOST, FAR, udp_sport=5, udp_dport=53) | {"tcp_seq": FAR},
        packet(1.0, HOST, SERVER, arp_op=1),
    ],
)
def test_what_is_no_such_syn_is_nothing(row):
    assert not found(trained(), row)


def test_packets_without_sequence_numbers_give_nothing():
    columns = {name: column for name, column in batch([marked()]).items() if name != "tcp_seq"}
    assert not trained().add(columns, "s1", 0, SENDERS)


def test_random_numbers_are_hardly_ever_addresses():
    random = np.random.default_rng(1)
    rows = batch([marked() for _ in range(1_000)])
    columns = dict(rows.items()) | {"tcp_seq": random.integers(0, NUMBERS, 1_000).astype(np.uint32)}
    assert not trained().add(columns, "s1", 0, SENDERS)


def test_a_flood_of_them_costs_a_bounded_time():
    rows = [packet(1.0, n, FAR, 1_024, 23, SYN) | {"tcp_seq": FAR} for n in range(1, MOST_AT_A_TIME + 50)]
    assert len(found(trained(), *rows)) == MOST_AT_A_TIME


def test_it_is_kept_with_the_model(tmp_path):
    """Also by one that was saved before SYNs were counted: as many as packets then."""
    detector = of_training()
    detector.save(tmp_path / "model.npz")
    model = load_model(tmp_path / "model.npz")
    again = Detector(model=model)
    for each in (detector, again):
        each.process(batch([marked(700.0)]), "s1")
    first, second = said(detector), said(again)
    assert first.nats == pytest.approx(second.nats)
    assert "sent 1 SYN with the destination's address as sequence number" in first.text
    del model.notes["fingerprints"]
    former = Detector(model=model)
    former.process(batch([marked(700.0)]), "s1")
    assert first.nats > said(former).nats > 10


def test_it_is_told_in_order_of_time():
    """The port's other findings of a batch do not come first."""
    detector = of_training()
    scan = [packet(700 + n / 100, HOST, FAR + n, 1_024, 80, SYN) for n in range(50)]
    detector.process(batch([marked(699.0), *scan, packet(705, HOST, SERVER, arp_op=1)]), "s1")
    heard = detector.take_evidence()
    assert {"fingerprint", "contacts"} <= {each.source for each in heard}
    times = [each.event_time for each in heard]
    assert times == sorted(times)


def test_who_is_behind_a_router_is_not_told_of():
    """The Internet is full of them, and anybody there can send in their name."""
    router = {"eth_src": SERVER, "port": 9}
    outside = [packet(599, 0x08000000 + n, HOST, 80, 40_000, ACK) | router for n in range(9)]
    detector = of_training(*outside)
    probe = packet(700.0, 0x08090909, HOST, 1_024, 23, SYN) | router | {"tcp_seq": HOST}
    detector.process(batch([probe]), "s1")
    assert "fingerprint" not in {each.source for each in detector.take_evidence()}


@pytest.mark.parametrize("state", [[1], [1, 2], ["a", 0], [-1, 0], None])
def test_a_damaged_state_is_refused(state):
    with pytest.raises((TypeError, ValueError)):
        SynFingerprints().restore(state)


def test_who_was_reported_with_all_there_is_is_reported_again_when_that_has_faded():
    """In between SYNs are only counted: no finding could come of them."""
    fingerprints = trained()
    times = np.arange(0.0, 400.0, 0.5).tolist()
    findings = [each for time in times for each in found(fingerprints, marked(time))]
    said = [(each.time, each.count) for each in findings if each.total == pytest.approx(50.0)]
    (first, _), (again, counted), *_ = said
    assert again - first == pytest.approx(600 * math.log2(1.15), abs=0.51)
    assert counted == 2 * (again - findings[0].time) + 1


def test_who_falls_silent_is_forgotten():
    fingerprints = trained()
    for sender in range(20):
        found(fingerprints, marked(1.0 + sender, ip_src_lo=sender))
    for later in range(24):
        found(fingerprints, marked(1_000.0 + 700 * later, ip_src_lo=100 + later))
    assert len(fingerprints) == 1


def probes(random, count, start_s):
    """Traffic in which many SYNs are those of a few scanners, some late."""
    rows = dict(traffic(random, count, start_s).items())
    chosen = random.random(count) < random.choice([0.1, 0.9])
    scanner = random.integers(1, random.choice([2, 4, 400]), count)
    for name in ("eth_src", "ip_src_lo"):
        rows[name] = np.where(chosen, scanner, rows[name]).astype(rows[name].dtype)
    rows["port"] = np.where(chosen, 1, rows["port"]).astype("u2")
    rows["tcp_sport"] = np.where(chosen, 1_024, rows["tcp_sport"]).astype("i4")
    rows["tcp_flags"] = np.where(random.random(count) < 0.9, SYN, random.choice(FLAGS, count)).astype("u1")
    is_address = random.random(count) < 0.9
    rows["tcp_seq"] = np.where(is_address, rows["ip_dst_lo"], random.integers(0, NUMBERS, count)).astype("u4")
    return rows


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_findings_and_times_are_those_of_one_syn_after_the_other(seed):
    """Whole batches of senders of whom nothing can be worth a message are taken at once, and leave the same behind."""
    random = np.random.default_rng(seed)
    sides, at, training = [PythonSynFingerprints(), SynFingerprints()], 100.0, 400
    for _ in range(14):
        count = int(random.integers(1, 700))
        rows, trained = probes(random, count, at), min(count, training)
        found = [side.add(rows, "s1", trained, SENDERS) for side in sides]
        assert repr(found[0]) == repr(found[1])
        kept = [(side.syns, side.marked, list(side._times.items()), side._settled) for side in sides]
        assert kept[0] == kept[1]
        training -= trained
        at += float(random.choice([0.1, 5.0, 300.0, 700.0]))


def test_sequence_numbers_of_other_packets_are_refused():
    columns = dict(batch([marked(), marked()]).items())
    with pytest.raises(ColumnError, match="tcp_seq"):
        trained().add(columns | {"tcp_seq": columns["tcp_seq"][:1]}, "s1", 0, SENDERS)
