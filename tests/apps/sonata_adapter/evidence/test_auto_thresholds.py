"""`threshold=auto`: what benign traffic does is not reported, what it does once in 100 hours is, and nothing meanwhile."""

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apps.evidence import TrainingState
from apps.sonata_adapter.control import Control
from apps.sonata_adapter.evidence.auto_thresholds import (
    FALSE_AN_HOUR,
    FOLLOW_US,
    AutoThresholds,
    Thresholds,
    auto_keys,
    auto_told,
)
from apps.sonata_adapter.evidence.count_baseline import CountBaseline, CountTraining
from apps.sonata_adapter.evidence.evidence_queries import EVIDENCE_PREFIX, EvidenceQueries
from apps.sonata_adapter.evidence.known_hosts import MOST_IN_A_ROW, KnownHosts
from apps.sonata_adapter.plan_answer import plan_answer
from apps.sonata_adapter.query.catalogue import CATALOGUE, PAPER
from apps.sonata_adapter.results import QueryResult

SECOND = 10**6
BEGIN = 1_700_000_000 * SECOND
PREFIX = "network.traffic_query.sonata"


class AutoNetwork:
    """One query at `threshold=auto`, and the time."""

    def __init__(self, name="new_tcp", more="", stored=None):
        self.key = f"{PREFIX}.{name}:threshold=auto{more}"
        self.queries = AutoThresholds(lambda _name, _text: stored)
        assert not self.queries.want([self.key], CATALOGUE)
        self.now = BEGIN
        self.queries.hear(self.now)

    @property
    def query(self):
        return self.queries.of(self.key)

    def goes_on(self, seconds):
        self.now += int(seconds * SECOND)
        self.queries.hear(self.now)

    def trained(self, seconds=None, *, more=True):
        self.queries.train(
            "kitsune",
            TrainingState(
                packets=1, wanted=1, done=True, senders=1, event_time=self.now * 1000,
                seconds=(self.now - BEGIN) / SECOND if seconds is None else seconds,
            ),
        )  # fmt: skip
        self.goes_on(60)  # here thresholds are chosen, ...
        if more:
            self.goes_on(60)  # ... and this is the first window that begins after it

    def counts(self, count, *, request=-1, host="192.0.2.1", switch="s1", ago=0):
        """What is written for a result of the window that has just begun, or of one that began some seconds ago."""
        asked = self.query.requests[request]
        length = asked.query.window_us
        measure = self.query.recipe.measure
        at_us = self.now - ago * SECOND
        result = QueryResult(
            query=asked.identity, window_us=at_us - at_us % length, length_us=length, at_us=at_us,
            fields={"dst": host, measure: count},
        )  # fmt: skip
        return self.queries.take([(asked.identity, switch, result)])


def after_training(name="new_tcp", counts=(20, 26, 22, 24, 21, 25, 23, 22, 24, 20), **options):
    network = AutoNetwork(name, **options)
    for count in counts * 12:
        assert network.counts(count) == []
        network.goes_on(10)
    network.trained()
    assert network.query.thresholds is not None
    return network


OPEN_AT_THE_EDGE = (0, 1, 0, 1, 0, 2, 1, 0)
"""Connections of a busy server that are open at the end of a window less those at its begin."""
NEW = "198.51.100.7"


def two_busy_servers(*, more=True):
    """An hour of incomplete_flows: connections that are open at a window's edge, in one direction or the other."""
    network = AutoNetwork("incomplete_flows")
    for place in range(120):
        for number in (1, 2):
            count = OPEN_AT_THE_EDGE[(place + 3 * number) % len(OPEN_AT_THE_EDGE)]
            if count:
                assert network.counts(count, host=f"192.0.2.{number}") == []
        network.goes_on(30)
    network.trained(more=more)
    return network


def test_nothing_is_reported_while_it_learns():
    """Neither at the declared threshold nor above it."""
    network = AutoNetwork()
    assert network.counts(5_000) == []
    assert network.queries.health() == {
        f"{PREFIX}.new_tcp:dst=any,refine=none,threshold=auto,window=3s": "learning"
    }
    told = auto_told(network.query)
    assert (told["threshold"], told["new_hosts_threshold"], told["learning"]) == (None, None, True)
    assert "reports nothing before it knows" in told["text"]


def test_results_go_under_the_wanted_key_from_the_threshold_on():
    """The key says `auto` and has all other parameters; what is less than the threshold is not reported."""
    network = after_training(more=",window=5s")
    threshold = network.query.thresholds.known
    assert 26 < threshold < 40
    assert network.counts(threshold - 1) == []
    ((key, result),) = network.counts(threshold)
    assert key == network.key
    assert result.fields["count"] == threshold
    assert network.query.output == f"{PREFIX}.new_tcp:dst=any,refine=none,threshold=auto,window=5s"


def test_a_network_that_is_quiet_keeps_the_declared_threshold():
    """Training has not seen a quarter of it."""
    network = AutoNetwork("ddos")
    network.goes_on(1_200)
    network.trained()
    assert network.query.thresholds == Thresholds(known=45, new=45)


def test_more_than_training_saw_is_learnt_unless_it_is_reported():
    """The threshold follows an hour later; what was reported changes nothing."""
    network = after_training()
    before = network.query.thresholds.known
    assert network.counts(before - 1, request=0) == []
    network.goes_on(30)
    assert network.query.baseline.newcomer == before - 1
    assert network.counts(before + 500)
    network.goes_on(FOLLOW_US / SECOND + 1)
    assert network.query.baseline.newcomer == before - 1
    assert network.query.thresholds.known > before


def test_a_new_host_is_reported_from_less_on_than_one_that_was_seen_before():
    """Five connections that stay open at a host without any; busy servers come to that in some hundred hours."""
    network = two_busy_servers()
    assert network.counts(5, host="192.0.2.1") == []
    ((_, result),) = network.counts(5, host=NEW)
    assert result.fields == {"dst": NEW, "count": 5}
    chosen, told = network.query.thresholds, auto_told(network.query)
    assert 2 < chosen.new <= 5 < chosen.known
    assert (told["threshold"], told["new_hosts_threshold"]) == (chosen.known, chosen.new)
    assert f"of hosts that are new here from {chosen.new} on" in told["text"]
    assert f"of new hosts >= {chosen.new}" in next(iter(network.queries.health().values()))


def test_a_new_host_is_known_once_it_was_seen():
    """From its first window on that is not reported; it stays known after a restart."""
    network = two_busy_servers()
    assert network.counts(1, host=NEW) == []
    network.goes_on(60)
    assert network.counts(5, host=NEW) == []
    network.goes_on(FOLLOW_US / SECOND + 1)
    assert network.query.baseline.met == (NEW,)
    again = AutoNetwork("incomplete_flows", stored=network.query.baseline)
    again.trained(seconds=3600)
    assert again.counts(5, host=NEW) == []
    assert again.counts(again.query.thresholds.new, host="198.51.100.8")


def test_what_is_left_of_an_attack_makes_nobody_known():
    """The window after a report is not learnt; a later one is."""
    network = two_busy_servers()
    assert network.counts(5, host=NEW)
    network.goes_on(30)
    assert network.counts(1, host=NEW) == []
    network.goes_on(60)
    assert network.counts(5, host=NEW)
    network.goes_on(60)
    assert network.counts(1, host=NEW) == []
    network.goes_on(60)
    assert network.counts(5, host=NEW) == []


def test_a_window_that_began_before_the_thresholds_makes_nobody_known():
    """Its count may be that of a part: of an attack that goes on."""
    network = two_busy_servers(more=False)
    assert network.counts(1, host=NEW) == []
    network.goes_on(60)
    assert network.counts(5, host=NEW)


def test_what_a_new_host_does_again_and_again_is_its_way():
    """It is reported in ten windows in a row; with a window between, the tenth is the first."""
    network = two_busy_servers()
    for _ in range(2):
        for _ in range(MOST_IN_A_ROW - 1):
            assert network.counts(5, host=NEW)
            network.goes_on(30)
        network.goes_on(30)
    for _ in range(MOST_IN_A_ROW):
        assert network.counts(5, host=NEW)
        network.goes_on(30)
    assert network.counts(5, host=NEW) == []


def test_a_new_host_that_reaches_both_thresholds_is_reported_once():
    """By each switch, in each window; the first report is the one of the lower threshold."""
    network = after_training()
    low, new, known = (request.query.steps[-1].condition.right.value for request in network.query.requests)
    assert (new, known) == (network.query.thresholds.new, network.query.thresholds.known)
    assert network.counts(low, request=0, host=NEW) == []
    assert network.counts(new, request=1, host=NEW)
    assert network.counts(known, request=2, host=NEW) == []
    assert network.counts(new, request=1, host=NEW, switch="s2")
    network.goes_on(3)
    assert network.counts(new, request=1, host=NEW)


def test_reports_that_come_late_are_of_their_window():
    """A capture is replayed so fast that all windows have ended when the second threshold of the first is reported."""
    network = after_training()
    _, new, known = (request.query.steps[-1].condition.right.value for request in network.query.requests)
    for _ in range(2):
        assert network.counts(10, request=0, host=NEW) == []
        network.goes_on(30)
    assert network.counts(new, request=1, host=NEW, ago=60)
    assert network.counts(new, request=1, host=NEW, ago=30)
    network.goes_on(30)
    assert network.counts(known, request=2, host=NEW, ago=90) == []
    assert network.counts(new, request=1, host=NEW)


def test_where_hosts_come_and_go_new_ones_are_like_all_others():
    """Half of the results of training are of hosts that nobody had seen before."""
    network = AutoNetwork("incomplete_flows")
    for place in range(120):
        network.counts(OPEN_AT_THE_EDGE[place % 8] or 1, host=f"192.0.2.{place if place % 2 else 0}")
        network.goes_on(30)
    network.trained()
    assert network.query.baseline.fresh == 45
    assert network.query.thresholds.new > two_busy_servers().query.thresholds.new


def test_where_hosts_differ_a_new_one_may_differ_as_much():
    """Eight servers at one count, and eight at counts that lie far apart; the busiest is the same."""
    found = []
    for counts in ([20] * 8, [5, 6, 7, 8, 9, 10, 15, 20]):
        network = AutoNetwork()
        for place in range(400):
            network.counts(counts[place % 8] - place % 16 // 8, host=f"192.0.2.{place % 8}")
            network.goes_on(3)
        network.trained()
        found.append(network.query.thresholds)
    alike, different = found
    assert alike.new < alike.known
    assert alike.new < different.new


def test_more_new_hosts_than_in_training_raise_their_threshold():
    """An hour later, as the other one follows."""
    network = two_busy_servers()
    before = network.query.thresholds
    for number in range(40):
        network.counts(1, host=f"203.0.113.{number}")
        network.goes_on(60)
    network.goes_on(FOLLOW_US / SECOND)
    assert network.query.thresholds.new > before.new
    assert network.query.thresholds.known == before.known


def test_a_network_with_too_many_results_does_not_tell_new_hosts_apart():
    """They would have to be looked at for ever."""
    baseline = two_busy_servers().query.baseline
    busy = msgspec.structs.replace(baseline, windows=36_001)
    assert Thresholds.of(busy, 1).new == Thresholds.of(busy, 1).known == baseline.rare(FALSE_AN_HOUR)


def test_it_goes_on_with_an_earlier_baseline_of_the_same_query():
    """The firewall's evidence and a threshold of its own learn the same counts once."""
    stored = after_training().query.baseline
    network = AutoNetwork(stored=stored)
    network.trained(seconds=1200)
    assert network.query.baseline == stored
    evidence = EvidenceQueries()
    evidence.want([f"{EVIDENCE_PREFIX}.new_tcp"], CATALOGUE)
    shared, other = (AutoNetwork(more=more).queries.requests[0] for more in ("", ",dst=10.0.0.0/8"))
    assert evidence.requests[0].identity == shared.identity != other.identity


@pytest.mark.parametrize("name", PAPER)
def test_every_query_of_the_paper_can_have_one(name):
    queries = AutoThresholds()
    assert not queries.want([f"{PREFIX}.{name}:threshold=auto"], CATALOGUE)
    (request,) = queries.requests
    assert queries.owns(request.identity)


@pytest.mark.parametrize(
    ("key", "reason"),
    [
        (f"{PREFIX}.nonsense:threshold=auto", "there is no query nonsense"),
        (f"{PREFIX}.new_tcp:threshold=auto,size=3", "no parameter size"),
        (f"{PREFIX}.new_tcp:threshold=auto,window=1ms", "100ms to 1h"),
        (f"{PREFIX}.new_tcp:threshold=auto,refine=8/16", "refine needs a threshold that is a number"),
    ],
)
def test_what_it_cannot_serve_is_refused_with_a_reason(key, reason):
    assert reason in AutoThresholds().want([key], CATALOGUE)[key]


def test_only_such_keys_are_its_own():
    mine = f"{PREFIX}.new_tcp:threshold=auto"
    others = (
        f"{PREFIX}.new_tcp",
        f"{PREFIX}.new_tcp:threshold=*",
        "network.x.y.z:threshold=auto",
        "no key :",
    )
    assert auto_keys([mine, *others]) == {mine}


@given(
    st.lists(st.integers(5, 10**6), max_size=400),
    st.integers(60, 10**6),
    st.sampled_from([0.01, 1.0]),
)
def test_no_count_of_training_is_reported_whatever_it_was(counts, seconds, rate):
    """The threshold is above all that was seen, and finite."""
    training = CountTraining()
    for place, count in enumerate(counts):
        at = BEGIN + place * seconds * SECOND // max(1, len(counts))
        training.learn(f"10.0.0.{place % 200}", at, 3 * SECOND, count)
    found = training.close("text", 5, begin_us=BEGIN, end_us=BEGIN + seconds * SECOND)
    assert CountBaseline.from_value(found.to_value()) == found
    assert max([4, *counts]) < found.rare(rate) < 10**9


def test_the_budget_holds_for_counts_of_independent_events():
    """Windows whose counts are sums of many independent events, as a server's new connections are."""
    rng = np.random.default_rng(1)
    exceeded = 0
    for _ in range(30):
        training = CountTraining()
        for place, count in enumerate(rng.poisson(30, 400).tolist()):
            training.learn("192.0.2.1", BEGIN + place * 3 * SECOND, 3 * SECOND, count)
        threshold = training.close("t", 5, begin_us=BEGIN, end_us=BEGIN + 1200 * SECOND).rare(0.01)
        exceeded += int((rng.poisson(30, 12_000) >= threshold).sum())
    assert exceeded <= 30 * 10 * 0.01 + 3 * (30 * 10 * 0.01) ** 0.5


def test_the_budget_holds_while_servers_come_and_go():
    """Both thresholds together, over 20 hours after each of 20 trainings of an hour, at twice the budget at most."""
    rng = np.random.default_rng(2)
    window_us, false = 30 * SECOND, 0
    for _ in range(20):
        server = np.concatenate([np.zeros(10), rng.integers(0, 21 * 120, 40)])
        leaves = server + np.where(server > 0, rng.exponential(60, 50), 21 * 120)
        windows = np.arange(21 * 120)[:, None]
        counts = rng.poisson(0.34, (21 * 120, 50)) - rng.poisson(0.34, (21 * 120, 50))
        counts[(windows < server) | (windows >= leaves)] = 0
        training, seen = (
            CountTraining(),
            [pair for pair in np.argwhere(counts >= 1).tolist() if pair[0] < 120],
        )
        for window, host in seen:
            training.learn(f"host{host}", window * window_us, window_us, float(counts[window, host]))
        baseline = training.close("t", 1, begin_us=0, end_us=120 * window_us)
        chosen, known = Thresholds.of(baseline, 1), KnownHosts(baseline)
        for window, host in np.argwhere(counts >= 1).tolist()[len(seen) :]:
            name, begin_us = f"host{host}", window * window_us
            if counts[window, host] < (chosen.known if known.knows(name, begin_us) else chosen.new):
                known.meet(name, begin_us, window_us)
            else:
                known.suspect(name, begin_us, window_us)
                false += 1
    assert false <= 2 * 20 * 20 * FALSE_AN_HOUR


@pytest.mark.parametrize("name", PAPER)
def test_a_plan_is_told_of_keys_that_nobody_wants(name):
    """What would run while it learns; a wrong parameter is refused with its reason."""
    key = f"{PREFIX}.{name}:threshold=auto"
    told = plan_answer(key, Control(CATALOGUE), CATALOGUE, AutoThresholds())
    assert (told["state"], told["auto"]["learning"]) == ("possible", True)
    assert told["output"].startswith(f"{PREFIX}.{name}:")
    refused = plan_answer(f"{key},window=1ms", Control(CATALOGUE), CATALOGUE)
    assert refused["state"] == "refused"
    assert "100ms to 1h" in refused["reason"]
