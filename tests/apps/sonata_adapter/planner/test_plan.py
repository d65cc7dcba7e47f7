"""Plans keep the limits of the switch, stay in place, and say what they do."""

import itertools
import random

import pytest

from apps.sonata_adapter.host.columns import PacketColumns
from apps.sonata_adapter.host.evaluation import evaluate
from apps.sonata_adapter.keys import request_of
from apps.sonata_adapter.planner.conditions import conditions_of, disjoint, narrowed
from apps.sonata_adapter.planner.explain import explain
from apps.sonata_adapter.planner.placement import SwitchLimits, reciprocal
from apps.sonata_adapter.planner.plan import QueryPlans, clock_period, plan
from apps.sonata_adapter.planner.refinement import coarsest
from apps.sonata_adapter.query.catalogue import CATALOGUE, PAPER
from apps.sonata_adapter.query.dataflow import PacketSource, WindowTable, compile_query, sources
from sdnator.testing.query_traffic import batch_of, mixed
from tests.apps.sonata_adapter.switch_model import matches

PREFIX = "network.traffic_query.sonata"
EVERY = [f"{PREFIX}.{name}" for name in CATALOGUE]


def requests(*keys):
    return [request_of(key, CATALOGUE) for key in keys]


def test_no_frame_matches_two_entries_of_a_stage():
    """And cells do not overlap, a reduce stands behind its distinct, bits are unlike."""
    found = plan(requests(*EVERY))
    entries = found.entries
    for one, other in itertools.combinations(entries.values(), 2):
        if one.stage == other.stage:
            assert disjoint(one.match, other.match)
            if one.action == other.action != "count" and one.count_of == other.count_of:
                assert (one.base, one.size) == (other.base, other.size)
                continue
            assert one.base + one.size <= other.base or other.base + other.size <= one.base
    for entry in entries.values():
        assert entry.base + entry.size <= SwitchLimits().cells
        for bit in entry.behind:
            assert entries[bit].stage < entry.stage
            assert narrowed(entries[bit].match, entry.match) == entries[bit].match
    bits = [*entries, *found.gate_bits, *(copy.bit for copy in found.copies)]
    assert len(bits) == len(set(bits))


def test_counts_are_taken_in_the_switch():
    """Those of the paper, each alone; the rest says why it is not."""
    for key in EVERY:
        found = plan(requests(key)).queries[0]
        assert found.in_switch == (key.rpartition(".")[2] in PAPER)
        assert found.in_switch or found.reason


def test_what_does_not_fit_says_so():
    """Where all together need more stages than there are, those that save most go in; the plan names the reason."""
    found = plan(requests(*EVERY), SwitchLimits(stages=8))
    inside = {one.identity.split(":")[0].rpartition(".")[2] for one in found.queries if one.in_switch}
    assert {"superspreader", "port_scan", "ddos"} <= inside < set(PAPER)
    left = [one for one in found.queries if not one.in_switch]
    assert any("no counting stage of 8 has room" in one.reason for one in left)
    assert all(one.reason for one in left)


def test_the_papers_queries_fit_together():
    """All eleven in one switch; those that read payloads are counted up to their gates."""
    found = plan(requests(*(f"{PREFIX}.{name}" for name in PAPER)))
    assert all(one.in_switch for one in found.queries)
    gated = {one.identity.split(":")[0].rpartition(".")[2] for one in found.queries if one.gate is not None}
    assert gated == {"dns_tunnel", "zorro", "dns_reflection"}
    assert not found.copies


@pytest.mark.parametrize("seed", range(5))
def test_what_stays_keeps_its_place(seed):
    """Whatever comes and goes beside it."""
    rng = random.Random(seed)
    keys = [*EVERY, *(f"{PREFIX}.new_tcp:dst=10.0.{n}.0/24" for n in range(20))]
    present: set[str] = set()
    found: QueryPlans | None = None
    for _ in range(30):
        changed = set(rng.sample(keys, 3)) ^ present
        before = found
        found = plan(requests(*changed), before=before)
        if before is not None:
            staying = {one.identity for one in found.queries} & {one.identity for one in before.queries}
            for identity in staying:
                if before.of(identity).in_switch:
                    assert counting(found.of(identity)) == counting(before.of(identity))
            for copy in found.copies:
                assert all(old.match == copy.match for old in before.copies if old.bit == copy.bit)
        present = changed
    assert found is not None


def counting(one):
    """Its entries but for the switch's clock, whose pace follows the windows."""
    return [entry for entry in one.entries if entry.role != "clock"]


def test_two_hundred_queries_fit_or_fall_back():
    """Bits run out: the last one copies every packet, and everything is still answered."""
    keys = [f"{PREFIX}.dns_reflection:dst=10.{n // 250}.{n % 250}.0/24" for n in range(400)]
    found = plan(requests(*keys), SwitchLimits(stages=0))
    assert len(found.copies) <= SwitchLimits().bits
    assert any(not copy.match for copy in found.copies)
    assert all(one.copies for one in found.queries)


def test_a_distinct_is_split_where_that_takes_no_querys_room():
    """By source port into two with cells of their own, behind both of which the count stands."""
    alone = plan(requests(f"{PREFIX}.slowloris")).queries[0].entries
    parts = [entry for entry in alone if entry.role == "distinct"]
    assert [entry.match["sport"] for entry in parts] == [[0, 1023], [1024, 65_535]]
    assert [entry.behind for entry in alone if entry.behind] == [tuple(entry.bit for entry in parts)]
    four = plan(requests(f"{PREFIX}.slowloris"), SwitchLimits(stages=4)).queries[0].entries
    assert [entry.role for entry in four] == ["clock", "distinct", "reduce", "reduce"]


@pytest.mark.parametrize(
    ("windows", "period"),
    [
        ([3000], 1500),
        ([3000, 30_000], 1500),
        ([1000], 1000),
        ([2000, 3000], 1000),
        ([60_000], 10_000),
        ([1999], 1999),
    ],
)
def test_the_clock_ticks_at_the_end_of_every_window_and_within(windows, period):
    """As seldom as that can be, but not less than every ten seconds, nor more often than every second."""
    assert clock_period(windows, 1000) == period


def test_same_conditions_share_a_copy():
    """SYNs that three queries need are copied once."""
    found = plan(requests(f"{PREFIX}.syn_flood", f"{PREFIX}.incomplete_flows", f"{PREFIX}.dns_tunnel"))
    matches_ = [str(sorted(copy.match.items())) for copy in found.copies]
    assert len(matches_) == len(set(matches_))


def packets_of(node):
    return node if isinstance(node, PacketSource) else packets_of(node.source)


@pytest.mark.parametrize("name", CATALOGUE)
def test_conditions_mean_what_the_filters_mean(name):
    """Exact ones select the same packets; the others select at least those."""
    batch = batch_of(mixed(CATALOGUE, seconds=6))
    packets = PacketColumns(batch)
    outcome = compile_query(CATALOGUE[name].query())
    for node in sources(outcome) if isinstance(outcome, WindowTable) else [outcome.node]:
        filters = packets_of(node).filters
        conditions = conditions_of(filters)
        wanted = packets
        for condition in filters:
            wanted = wanted.where(condition)
        chosen = set(wanted.origin.tolist())
        rows = [{column: batch[column][row] for column in batch.columns} for row in range(len(batch))]
        selected = {
            row for row, packet in enumerate(rows) if any(matches(m, packet) for m in conditions.alternatives)
        }
        assert selected == chosen if conditions.exact else selected >= chosen
        assert len(evaluate(filters[0], packets)) == len(batch)


@pytest.mark.parametrize("window_ms", [100, 333, 3000, 60_000, 3_600_000])
def test_reciprocal_divides_exactly(window_ms):
    """Around the edges of windows, as far as the docstring says."""
    window = window_ms * 1000
    factor = reciprocal(window)
    horizon = min((1 << 64) // max(1, factor * window - (1 << 64)), 1 << 48)
    assert horizon >= 85 * 60 * 10**6
    for number in (0, 1, 2, 1000, horizon // window - 1):
        if (number + 1) * window > horizon:
            continue
        for time_us in (number * window, (number + 1) * window - 1):
            assert time_us * factor >> 64 == time_us // window


@pytest.mark.parametrize("key", EVERY)
def test_explain_names_switch_and_host(key):
    """For people: the query, the entries, what is left."""
    (request,) = requests(key)
    text = explain(request, plan([request]), meaning="meaning")
    assert request.identity in text
    assert "in the switch" in text
    assert "on the host" in text


def test_explain_shows_levels_and_their_delay():
    """What is counted first, what below prefixes that cross, and when results come at the latest."""
    (request,) = requests(f"{PREFIX}.ddos:refine=8/16,window=3s")
    text = explain(request, plan([coarsest(request)]))
    assert "by (destination /8), reports 45" in text
    assert "by (destination /32), reports 45" in text
    assert "at the latest 9s after it began" in text
