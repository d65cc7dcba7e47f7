"""Samples of the SYNs towards hosts that the switch reports."""

from apps.firewall.syn.suspect_samples import SAMPLE_BITS, SuspectSamples
from apps.firewall.syn.syn_policy import SynRules
from apps.p4runtime_ctrl.telemetry.classifier import Classifier
from apps.p4runtime_ctrl.telemetry.demand import Offer
from sdnator.testing.product_program import program
from tests.apps.firewall.desk import NOW, Desk
from tests.apps.firewall.syn.test_recent_syns import batch

VICTIM = "10.0.0.1"
SURGE = "network.traffic_query.sonata.new_tcp:threshold=100,window=200ms"
FIRST = f"suspect{SAMPLE_BITS[0]}"


def surge(desk, host=VICTIM):
    desk.hand(SURGE, {"dst": host, "count": 100, "window_start": NOW, "at": NOW})


def sampled(desk, *sources, host=VICTIM):
    rows = [(NOW // 1000, source, host, 80) for source in sources]
    key = f"network.packets.p4runtime_ctrl.s1.{FIRST}"
    desk.hand(key, batch(*rows), pattern=f"network.packets.p4runtime_ctrl.*.{FIRST}")


def test_no_syn_is_copied_before_a_report_then_those_to_the_victim_only():
    """The controller's classifier takes the request as it is."""
    desk = Desk(copies="suspects")
    assert desk.written("network.telemetry") == []
    surge(desk)
    (offer,) = desk.written("network.telemetry")
    assert offer["conditions"]["dst"] == f"{VICTIM}/32"
    assert Classifier(program()).entries([Offer.from_value(offer).request()])


def test_a_sample_leads_to_a_guard_and_ends():
    """600 spoofed SYNs are more than a sample: it ends, and the service is guarded after the grace period."""
    desk = Desk(copies="suspects", syn=SynRules(grace_ms=0))
    surge(desk)
    sampled(desk, *(f"77.0.{n // 256}.{n % 256}" for n in range(600)))
    desk.tick_until(lambda: desk.guarded)
    assert desk.guarded == [VICTIM]
    assert [each["active"] for each in desk.written("network.telemetry")] == [True, False]


def test_a_small_sample_is_looked_at_again():
    """Ten SYNs tell nothing yet: neither a guard nor an end of the examination."""
    desk = Desk(copies="suspects", syn=SynRules(grace_ms=1, least=20))
    surge(desk)
    sampled(desk, *(f"77.0.0.{n}" for n in range(10)))
    desk.service.tick()
    assert desk.guarded == []
    sampled(desk, *(f"77.0.1.{n}" for n in range(10)))
    desk.tick_until(lambda: desk.guarded)


def test_samples_are_bounded_in_number_and_time():
    """One a host, as many as there are bits; each ends by itself."""
    samples = SuspectSamples(most=5, seconds=2.0)
    begun = [list(samples.begin(f"10.0.0.{n}", now=0.0)) for n in (1, 1, 2, 3, 4, 5)]
    assert list(map(len, begun)) == [1, 0, 1, 1, 1, 0]
    samples.taken(begun[0][0]["name"], 1, now=1.0)
    assert list(samples.ended(2.9)) == []
    assert [each["name"] for each in samples.ended(3.0)] == [FIRST]
    assert list(samples.begin("10.0.0.1", 4.0)) == []
    assert list(samples.begin("10.0.0.1", 13.0))
    assert len(list(samples.ended(15.0))) == 3
    assert begun[2][0]["conditions"] != next(samples.begin("2001:db8::1", 15.0))["conditions"]
    assert list(samples.begin("10.0.0.2", 15.0)), "an empty sample is no reason to wait"
