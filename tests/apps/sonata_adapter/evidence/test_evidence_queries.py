"""Queries as evidence: what training saw says nothing, what goes beyond it is weighed once."""

import pytest

from apps.evidence import Evidence, TrainingState
from apps.sonata_adapter.evidence.evidence_queries import EVIDENCE_PREFIX, MOST_QUERIES, EvidenceQueries
from apps.sonata_adapter.host.engine import HostEngine
from apps.sonata_adapter.query.catalogue import CATALOGUE
from apps.sonata_adapter.query.text import parse_queries
from apps.sonata_adapter.results import QueryResult
from sdnator.testing.query_traffic import ACK, BASE_US, SYN, TimedFrame, batches, tcp

SECOND = 10**6
BEGIN = 1_700_000_000 * SECOND
OWN = {
    each.name: each
    for each in parse_queries("""
query my_scan(window=2s, most=20):
    filter tcp.flags == SYN
    map src = ip.src, dst = ip.dst, port = tcp.dport
    distinct
    reduce by src, dst: ports = count()
    filter ports > most

query nobody:
    map port = tcp.dport
    reduce by port: n = count()
    filter n >= 3

query no_count:
    map dst = ip.dst
    distinct

query hidden_count:
    map dst = ip.dst
    reduce by dst: n = count()
    filter n >= 3
    map dst
""")
}


class Network:
    """Queries of one name, and the time."""

    def __init__(self, name, stored=None):
        self.key = f"{EVIDENCE_PREFIX}.{name}"
        self.queries = EvidenceQueries(lambda _name, _text: stored)
        assert not self.queries.want([self.key], {**CATALOGUE, **OWN})
        self.now = BEGIN
        self.queries.hear(self.now)

    def goes_on(self, seconds):
        self.now += int(seconds * SECOND)
        return [evidence for _, evidence in self.queries.hear(self.now)]

    def trained(self, *, done=True, seconds=None):
        state = TrainingState(
            packets=1, wanted=1, done=done, senders=1, event_time=self.now * 1000,
            seconds=(self.now - BEGIN) / SECOND if seconds is None else seconds,
        )  # fmt: skip
        return [evidence for _, evidence in self.queries.train("kitsune", state)]

    def counts(self, count, more=None, *, request=-1, exact=True, error=""):
        """A result of the window that has just begun; `request`: by which of the thresholds it came."""
        asked = self.queries.requests[request]
        length = asked.query.window_us
        measure = {"slowloris": "connections", "my_scan": "ports"}.get(asked.name, "count")
        result = QueryResult(
            query=asked.identity, window_us=self.now - self.now % length, length_us=length, at_us=self.now,
            fields={**({"src": "10.0.0.1"} if more is None else more), measure: count}, exact=exact, error=error,
        )  # fmt: skip
        found = self.queries.take([(asked.identity, "s1", result)])
        assert all(key == self.key and Evidence.from_value(one.to_value()) == one for key, one in found)
        return [one for _, one in found]


def after_training(name="port_scan", counts=(12, 20, 14), more=None, **options):
    """A network in which one host came to these counts while it was learnt."""
    network = Network(name, **options)
    for count in counts:
        assert not network.counts(count, more)
        assert not network.goes_on(30)
    network.goes_on(300)
    network.trained()
    network.goes_on(60)
    assert network.queries.health()[name] != "learning"
    return network


def test_what_training_saw_says_nothing_and_more_is_weighed_once():
    """Only what is new is written; after a time a part of it is forgotten."""
    network = after_training()
    assert not network.counts(20)
    (first,) = network.counts(60)
    assert (first.kind, first.source, first.address, first.victims) == ("scan", "port_scan", "10.0.0.1", ())
    assert "came to 60 ports within 3s; training saw 20 of it at most" in first.text
    assert not network.counts(60)
    (more,) = network.counts(200)
    assert first.nats + more.nats == pytest.approx((200 - 20) / (60 - 20) * first.nats, abs=0.01)
    network.goes_on(600)
    (again,) = network.counts(200)
    assert again.nats == pytest.approx((first.nats + more.nats) / 2, abs=0.01)


def test_a_stranger_is_compared_with_all_hosts():
    """What one host may do is not suspicious of another that training did not see."""
    network = after_training(counts=(150, 200))
    assert not network.counts(200, {"src": "10.0.0.2"})
    (found,) = network.counts(2_000, {"src": "10.0.0.2"})
    assert "training saw 200 of any host at most" in found.text


def test_varying_training_weighs_less():
    """The tail's scale is learnt: where blocks of training differ much, more is needed."""
    steady, varying = (after_training(counts=counts) for counts in ((40, 40, 40), (20, 20, 40)))
    assert steady.counts(100)[0].nats > 1.5 * varying.counts(100)[0].nats


def test_thresholds_fit_the_network():
    """A quarter of the catalogue's while it learns, with whole counts; then several above what training saw."""
    network = Network("port_scan")
    (learning,) = network.queries.requests
    assert learning.query.text().endswith("filter count >= 10")
    assert "map count, src" in learning.query.text()
    network = after_training(counts=(100,))
    thresholds = [int(each.query.text().rpartition(" ")[2]) for each in network.queries.requests]
    assert thresholds[0] > 100
    assert thresholds == sorted(set(thresholds))
    assert not network.queries.learnt()[1:]


def test_results_at_the_windows_end_come_with_their_counts():
    """One threshold is enough for those, and their windows are a second long."""
    network = after_training("syn_flood", counts=(3, 6), more={"dst": "10.0.0.9"})
    (request,) = network.queries.requests
    assert request.query.window_ms == 1_000
    (found,) = network.counts(5_000, {"dst": "10.0.0.9"})
    assert (found.kind, found.address, found.victims, found.victim_count) == ("flood", "", ("10.0.0.9",), 1)
    assert found.nats == 1_000


def test_a_frames_sender_is_named_with_its_port():
    """ARP has no address that could be trusted: switch, port and MAC say who it was."""
    network = after_training("arp_scan", counts=())
    (found,) = network.counts(60, {"mac": "02:00:00:00:00:12", "port": 3})
    assert (found.sender.switch, found.sender.port, found.sender.mac) == ("s1", 3, "02:00:00:00:00:12")
    assert (found.service, found.address) == ("arp", "")


def test_answers_are_told_from_what_somebody_begins():
    """Forged SYNs make a server answer to thousands of ports and hosts: that alone accuses nobody."""
    (learning,) = Network("port_scan").queries.requests
    engine = HostEngine()
    engine.add(learning.query)
    start = BASE_US + 1_000
    forged = [f"172.16.{n >> 8}.{n & 255}" for n in range(200)]
    frames = [
        TimedFrame(start + n, 60, tcp("10.0.0.1", host, 80, 1024 + n, SYN | ACK))
        for n, host in enumerate(forged)
    ]
    frames += [TimedFrame(start + 500 + n, 60, tcp("10.0.0.2", "10.0.0.1", 4444, n, SYN)) for n in range(200)]
    found = [each for batch in batches(frames) for each in engine.process(batch)] + engine.finish()
    assert [each.fields for each in found] == [{"src": "10.0.0.2", "count": 200}]
    (scan,) = after_training().counts(200)
    (spread,) = after_training("superspreader").counts(200)
    assert (scan.supporting, spread.supporting) == (False, True)


def test_own_queries_are_evidence():
    """Any count at the end of a query with src or dst; the words of the query's own."""
    network = after_training("my_scan", counts=(21,), more={"src": "10.0.0.1", "dst": "10.0.0.2"})
    (found,) = network.counts(200, {"src": "10.0.0.1", "dst": "10.0.0.2"})
    assert (found.kind, found.address, found.victims) == ("other", "10.0.0.1", ("10.0.0.2",))
    assert "200 ports within 2s" in found.text


@pytest.mark.parametrize(
    ("key", "why"),
    [
        ("nobody", "names nobody"),
        ("no_count", "no count to compare"),
        ("hidden_count", "leaves n out of its results"),
        ("unheard_of", "no such evidence; write network.evidence.sonata_adapter.<query> for one of new_tcp"),
        ("port_scan:window=1s", "no such evidence"),
    ],
)
def test_what_cannot_be_evidence_is_refused(key, why):
    """With the reason, and nothing runs for it."""
    queries = EvidenceQueries()
    (reason,) = queries.want([f"{EVIDENCE_PREFIX}.{key}"], {**CATALOGUE, **OWN}).values()
    assert why in reason
    assert not queries.requests


def test_wildcards_ask_for_nothing_and_queries_are_bounded():
    """A wildcard receives what others ask for."""
    queries = EvidenceQueries()
    assert not queries.want([f"{EVIDENCE_PREFIX}.*"], CATALOGUE)
    assert not queries.requests
    many = {f"my_scan{n}": OWN["my_scan"] for n in range(MOST_QUERIES + 1)}
    assert len(queries.want([f"{EVIDENCE_PREFIX}.{name}" for name in many], many)) == 1


def test_what_comes_after_the_end_of_training_is_not_learnt():
    """Results may be here before the word that training is over."""
    network = Network("port_scan")
    network.goes_on(100)
    end = network.now
    network.trained(done=False)
    network.goes_on(10)
    assert not network.counts(300)
    network.now = end
    network.trained()
    (found,) = network.goes_on(60)
    assert "came to 300" in found.text
    assert "training saw 9 of any host" in found.text


def test_a_kept_baseline_is_used_if_it_is_for_this_query():
    """And the query does not learn again when the network does not; another query's text is of no use."""
    network = after_training()
    ((name, baseline),) = network.queries.learnt()
    assert name == "port_scan"
    for stored, learns in (
        (baseline, False),
        (type(baseline).from_value({**baseline.to_value(), "text": "other"}), True),
    ):
        later = Network("port_scan", stored)
        later.trained(seconds=300)
        assert (later.queries.health()["port_scan"] == "learning") == learns
        assert bool(later.counts(300, request=0)) != learns
        assert not later.queries.learnt()


def test_training_may_be_over_before_a_query_has_come_as_far():
    """Packets may wait on their way to the query; what they bring is training all the same."""
    network = Network("port_scan")
    network.goes_on(1)
    now, network.now = network.now, network.now + 300 * SECOND
    network.trained(seconds=300)
    network.now = now
    network.goes_on(200)
    assert not network.counts(50)
    network.goes_on(200)
    assert network.queries.health()["port_scan"] != "learning"
    assert not network.counts(50)


def test_a_query_that_missed_training_learns_as_long_by_itself():
    """Somebody got interested when training was over."""
    network = Network("port_scan")
    network.trained(seconds=300)
    network.goes_on(1)
    assert not network.counts(12)
    network.goes_on(250)
    assert network.queries.health()["port_scan"] == "learning"
    network.goes_on(60)
    assert not network.counts(12)
    assert network.counts(1_000)


def test_without_any_word_of_training_it_learns_for_an_hour():
    """No app trains in this network."""
    network = Network("port_scan")
    network.goes_on(3_590)
    assert network.queries.health()["port_scan"] == "learning"
    network.goes_on(60)
    assert network.queries.health()["port_scan"] != "learning"


def test_while_the_network_trains_again_the_old_baseline_holds():
    """And is replaced when training is done."""
    network = after_training()
    network.queries.learnt()
    network.trained(done=False)
    assert network.queries.health()["port_scan"] == "learning"
    assert network.counts(100)
    network.goes_on(300)
    network.trained(seconds=300)
    network.goes_on(30)
    assert [name for name, _ in network.queries.learnt()] == ["port_scan"]
    assert not network.counts(100, {"src": "10.0.0.2"})


def test_a_time_far_ahead_does_not_keep_it_learning():
    """Whoever trains may be wrong about the time."""
    network = Network("port_scan")
    network.goes_on(300)
    far = TrainingState(packets=1, wanted=1, done=True, seconds=300, senders=1, event_time=1 << 62)
    network.queries.train("kitsune", far)
    network.goes_on(10)
    assert network.queries.health()["port_scan"] != "learning"


def test_estimates_are_no_evidence_where_they_may_be_too_large():
    """A count that is too small at most accuses nobody who is innocent."""
    network = after_training()
    assert not network.counts(100, exact=False, error="their counts too large by up to 80")
    assert network.counts(100, exact=False, error="keys without a cell in the switch were counted apart")
    flood = after_training("syn_flood", counts=(), more={"dst": "10.0.0.9"})
    assert not flood.counts(100, {"dst": "10.0.0.9"}, exact=False, error="3 cells could not be read")
