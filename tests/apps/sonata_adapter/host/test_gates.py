"""Gates: a query sees a host's packets from the one on that opens the gate, and no others."""

import pytest

from apps.sonata_adapter.errors import QueryError
from apps.sonata_adapter.host.engine import HostEngine
from apps.sonata_adapter.host.gates import with_passed
from apps.sonata_adapter.query.catalogue import CATALOGUE
from apps.sonata_adapter.query.dataflow import compile_query
from apps.sonata_adapter.query.language import Query, count, field, ip, tcp, udp
from sdnator.testing.query_traffic import BASE_US, TimedFrame, batch_of, mixed
from sdnator.testing.query_traffic import udp as datagram
from tests.apps.sonata_adapter.query.test_catalogue import expect, run, same

GATED = [name for name in CATALOGUE if CATALOGUE[name].query().gated is not None]


@pytest.mark.parametrize("name", GATED)
@pytest.mark.parametrize("gate", [1, 4, 30])
@pytest.mark.parametrize("size", [13, 4096])
def test_equals_naive_wherever_the_gate_opens(name, gate, size):
    """Whatever the batches; no attack of a kind is quieter than its gate of four."""
    values = {"gate": gate}
    frames = mixed(GATED, seconds=9)
    found = run([name], frames, size=size, values=values)[name]
    same(found, expect(name, frames, values))
    assert found or gate == 30


def answers(hosts):
    """A DNS answer to each of these hosts in turn, 10 ms apart."""
    return [
        TimedFrame(BASE_US + 10_000 * at, 90, datagram("192.0.2.53", f"10.0.0.{host}", 53, 5000, bytes(12)))
        for at, host in enumerate(hosts)
    ]


def counting(at_least):
    """DNS answers to a host, behind a gate that they open."""
    gated = Query("q", 1000).gate(udp.sport == 53, at_least, dst=ip.dst)
    counted = gated.filter(udp.sport == 53).map(dst=ip.dst).reduce("dst", count=count())
    return counted.filter(field("count") >= 2)


def results(batch, query, **options):
    engine = HostEngine(**options)
    engine.add(query)
    return engine.process(batch) + engine.finish()


def test_the_packet_that_opens_is_the_first_that_counts():
    found = results(batch_of(answers([1, 1, 1, 2, 1, 2])), counting(3))
    assert [(each.fields, each.at_us - BASE_US) for each in found] == [
        ({"dst": "10.0.0.1", "count": 2}, 40_000)
    ]


def test_each_window_has_a_gate_of_its_own():
    frames = answers([1, 1])
    later = [frame._replace(time_us=frame.time_us + 10**6) for frame in frames]
    assert not results(batch_of([*frames, *later]), counting(3))


def test_what_has_passed_in_the_switch_passes_here_and_does_not_count():
    """The switch has seen the packets that opened it; others must open the gate here."""
    passed = with_passed(batch_of(answers([1, 1])), passed=True)
    assert len(results(passed, counting(100))) == 1
    kept = with_passed(batch_of(answers([1, 1])), passed=False)
    assert not results(kept, counting(2))


def test_keys_beyond_the_bound_pass_and_their_results_are_estimates():
    """Nothing is missed: what cannot be counted is looked at."""
    found = results(batch_of(answers([*range(1, 9), 40, 40, 40])), counting(3), limit=8)
    assert [each.fields["dst"] for each in found] == ["10.0.0.40"]
    assert all(not each.exact and "gate" in each.error for each in found)


@pytest.mark.parametrize(
    ("make", "what"),
    [
        (lambda q: q.gate(ip.dst, 3, dst=ip.dst), "needs a condition"),
        (lambda q: q.gate(tcp.dport == 23, 0, dst=ip.dst), "not 0"),
        (lambda q: q.gate(tcp.dport == 23, 3), "has one field"),
        (lambda q: q.filter(tcp.dport == 23).gate(tcp.dport == 23, 3, dst=ip.dst), "comes first"),
        (lambda q: q.gate(tcp.dport == 23, 3, dst=ip.dst).map(src=ip.src).distinct(), "makes dst"),
        (lambda q: q.gate(tcp.dport == 23, 3, dst=ip.dst).map(dst=ip.dst), "behind it"),
        (lambda q: q.gate(tcp.dport == 23, 3, dst=ip.dst).map(dst=tcp.dport).distinct(), "makes dst"),
        (
            lambda q: (
                q.gate(tcp.dport == 23, 3, dst=ip.dst)
                .map(dst=ip.dst)
                .distinct()
                .join(q.map(dst=ip.dst).distinct(), "dst")
            ),
            "same gate",
        ),
    ],
)
def test_a_gate_that_does_not_fit_says_why(make, what):
    with pytest.raises(QueryError, match=what):
        compile_query(make(Query("q")))
