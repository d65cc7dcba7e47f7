"""`threshold=auto`: what benign traffic does is not reported, what it does once in 100 hours is, and nothing meanwhile."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apps.evidence import TrainingState
from apps.sonata_adapter.control import Control
from apps.sonata_adapter.evidence.auto_thresholds import FOLLOW_US, AutoThresholds, auto_keys, auto_told
from apps.sonata_adapter.evidence.count_baseline import CountBaseline, CountTraining
from apps.sonata_adapter.evidence.evidence_queries import EVIDENCE_PREFIX, EvidenceQueries
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

    def trained(self, seconds=None):
        self.queries.train(
            "kitsune",
            TrainingState(
                packets=1, wanted=1, done=True, senders=1, event_time=self.now * 1000,
                seconds=(self.now - BEGIN) / SECOND if seconds is None else seconds,
            ),
        )  # fmt: skip
        self.goes_on(60)

    def counts(self, count, *, request=-1, host="192.0.2.1"):
        """What is written for a result of the window that has just begun."""
        asked = self.query.requests[request]
        length = asked.query.window_us
        measure = self.query.recipe.measure
        result = QueryResult(
            query=asked.identity, window_us=self.now - self.now % length, length_us=length, at_us=self.now,
            fields={"dst": host, measure: count},
        )  # fmt: skip
        return self.queries.take([(asked.identity, "s1", result)])


def after_training(name="new_tcp", counts=(20, 26, 22, 24, 21, 25, 23, 22, 24, 20), **options):
    network = AutoNetwork(name, **options)
    for count in counts * 12:
        assert network.counts(count) == []
        network.goes_on(10)
    network.trained()
    assert network.query.threshold is not None
    return network


def test_nothing_is_reported_while_it_learns():
    """Neither at the declared threshold nor above it."""
    network = AutoNetwork()
    assert network.counts(5_000) == []
    assert network.queries.health() == {
        f"{PREFIX}.new_tcp:dst=any,refine=none,threshold=auto,window=3s": "learning"
    }
    told = auto_told(network.query)
    assert (told["threshold"], told["learning"]) == (None, True)
    assert "reports nothing before it knows" in told["text"]


def test_results_go_under_the_wanted_key_from_the_threshold_on():
    """The key says `auto` and has all other parameters; what is less than the threshold is not reported."""
    network = after_training(more=",window=5s")
    threshold = network.query.threshold
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
    assert network.query.threshold == 45


def test_more_than_training_saw_is_learnt_unless_it_is_reported():
    """The threshold follows an hour later; what was reported changes nothing."""
    network = after_training()
    before = network.query.threshold
    assert network.counts(before - 1, request=0) == []
    network.goes_on(30)
    assert network.query.baseline.newcomer == before - 1
    assert network.counts(before + 500)
    network.goes_on(FOLLOW_US / SECOND + 1)
    assert network.query.baseline.newcomer == before - 1
    assert network.query.threshold > before


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
