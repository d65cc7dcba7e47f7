"""Which rate limit follows from evidence, and how long it lasts."""

import pytest
from msgspec import structs

from apps.firewall.policy.rate_limits import (
    LEAST_RATE,
    MOST_LIMITS,
    SCAN_RATE,
    RateLimits,
    limit_of,
    limit_words,
    scan_limit_of,
)
from apps.firewall.policy.rules import Rules
from apps.messages import MOST_OPEN_PORTS, Confirmation, MessageError, RateLimit
from tests.apps.firewall.policy.test_sequential_test import evidence

SECOND = 1_000_000_000
AT = 1_000
VICTIM = "10.0.0.1"


def flood(service="from-udp/53", at=AT, **fields):
    made = structs.replace(evidence(20.0, at), sender=None, victims=(VICTIM,), service=service, kind="flood")
    return structs.replace(made, **fields)


def opened(limits, at=AT, service="from-udp/53", victim=VICTIM):
    said = flood(service, at)
    return limits.open(victim, limit_of([said]), "a flood", (), said)


@pytest.mark.parametrize(
    ("service", "kind", "port"),
    [
        ("from-udp/53", "udp_from", 53),
        ("udp/123", "udp_to", 123),
        ("udp", "udp", None),
        ("tcp-ack/443", "tcp", 443),
        ("icmp", "icmp", None),
    ],
)
def test_a_limit_is_as_narrow_as_its_evidence(service, kind, port):
    limit = limit_of([flood(service)])
    assert (limit.kind, limit.port, limit.rate) == (kind, port, LEAST_RATE)


@pytest.mark.parametrize("service", ["", "tcp/80", "arp", "ip", "udp/x", "udp/99999"])
def test_what_names_no_packets_or_fits_a_guard_is_not_limited(service):
    assert limit_of([flood(service)]) is None


def test_the_rate_is_that_of_training_with_a_margin():
    assert limit_of([flood(training_rate=70.0)]).rate == 140


def test_sources_of_training_have_a_rate_of_their_own_and_do_not_raise_that_of_others():
    said = flood(training_rate=100.0, usual_sources=("192.0.2.53", "2001:db8::53"), usual_share=0.75)
    limit = limit_of([said])
    assert (limit.rate, limit.spared, limit.spared_rate) == (50, ("192.0.2.53",), 200)
    assert "training saw 100 at most" in limit_words(limit, 100.0)
    assert "192.0.2.53 of training has 200/s" in limit_words(limit, 100.0)


def test_a_query_that_knows_nothing_of_training_does_not_hide_who_does():
    known = flood(training_rate=100.0, usual_sources=("192.0.2.53",), usual_share=1.0)
    assert limit_of([flood(), known]).spared == limit_of([known, flood()]).spared == ("192.0.2.53",)


def test_more_evidence_sets_no_second_limit_but_other_packets_have_one_of_their_own():
    limits = RateLimits(Rules())
    (first,) = opened(limits)
    assert (first.action, first.target.address, first.expires) == ("meter", VICTIM, (AT + 60) * SECOND)
    assert not opened(limits, AT + 1)
    (other,) = opened(limits, AT, "udp/123")
    assert other.id != first.id


def test_a_scan_is_slowed_down_where_the_victim_has_no_service():
    limit = scan_limit_of((443, 22))
    assert limit == RateLimit(kind="syn", rate=SCAN_RATE, open_ports=(22, 443))
    assert limit.words == "SYNs to ports other than 22, 443"
    assert scan_limit_of(()).words == "SYNs"
    assert scan_limit_of(range(MOST_OPEN_PORTS + 1)) is None


def test_a_service_that_came_to_be_known_is_left_alone_from_then_on():
    """The limit that would hit it is lifted; one that knows fewer services changes nothing."""
    limits = RateLimits(Rules())

    def scanned(at, *ports):
        return limits.open(VICTIM, scan_limit_of(ports), "a scan", (), flood("", at))

    (first,) = scanned(AT, 22)
    lifted, second = scanned(AT + 1, 22, 80)
    assert (lifted.id, lifted.action, second.action) == (first.id, "unmeter", "meter")
    assert second.limit.open_ports == (22, 80)
    assert not scanned(AT + 2, 80)
    assert list(limits.standing) == [second.id]


def test_it_is_lifted_when_its_time_is_over():
    limits = RateLimits(Rules(limit_s=30))
    (made,) = opened(limits)
    assert not limits.due((AT + 29) * SECOND)
    (lifted,) = limits.due((AT + 30) * SECOND)
    assert (lifted.action, lifted.id, lifted.limit) == ("unmeter", made.id, made.limit)
    assert not limits.standing


def test_it_lasts_while_it_drops_a_flood_and_not_for_a_trickle():
    limits = RateLimits(Rules())
    (made,) = opened(limits)
    limits.count_drops(made.id, 60 * LEAST_RATE, (AT + 59) * SECOND)
    (longer,) = limits.due((AT + 60) * SECOND)
    assert (longer.action, longer.id, longer.expires) == ("meter", made.id, (AT + 120) * SECOND)
    limits.count_drops(made.id, 60 * LEAST_RATE + 9, (AT + 119) * SECOND)
    assert [each.action for each in limits.due((AT + 120) * SECOND)] == ["unmeter"]


def test_evidence_that_goes_on_keeps_it():
    limits = RateLimits(Rules())
    opened(limits)
    opened(limits, AT + 50)
    assert [each.action for each in limits.due((AT + 60) * SECOND)] == ["meter"]
    assert [each.action for each in limits.due((AT + 120) * SECOND)] == ["unmeter"]


def test_the_table_of_the_switch_has_an_end_and_people_are_told():
    limits = RateLimits(Rules())
    for number in range(MOST_LIMITS):
        assert opened(limits, victim=f"10.0.1.{number}")
    assert not opened(limits)
    assert not opened(limits, AT + 1)
    assert limits.refused == 2
    assert [VICTIM in each.text for each in limits.notices] == [True]
    assert not opened(limits, AT - 86_400)
    assert len(limits.notices) == 2, "also after a clock that was a day ahead was set right"


def test_what_a_switch_refuses_is_not_in_force():
    limits = RateLimits(Rules())
    (made,) = opened(limits)
    said = Confirmation(id=made.id, switch="s1", state="failed", action="meter", event_time=1)
    limits.confirm(said)
    assert not limits.standing


def test_people_lift_it_by_id_or_victim_and_a_restart_keeps_it():
    limits = RateLimits(Rules())
    (made,) = opened(limits)
    again = RateLimits(Rules())
    again.restore([made])
    assert not again.release("10.0.0.9", AT * SECOND, "by hand")
    assert [each.action for each in again.release(VICTIM, AT * SECOND, "by hand")] == ["unmeter"]
    assert [each.id for each in limits.release(made.id, AT * SECOND, "by hand")] == [made.id]


@pytest.mark.parametrize(
    "wrong",
    [
        {"kind": "udp_from"},
        {"kind": "icmp", "port": 1},
        {"kind": "syn", "port": 1},
        {"kind": "udp", "open_ports": (22,)},
        {"kind": "udp", "spared": ("x",)},
        {"rate": 0},
    ],
)
def test_a_limit_that_cannot_be_is_refused(wrong):
    with pytest.raises(MessageError):
        RateLimit.from_value({"kind": "udp", "rate": 9, **wrong})
