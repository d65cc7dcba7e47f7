"""Keys that somebody wants become requests; offers of other apps count only while observed."""

from apps.p4runtime_ctrl.demand import Offer, requests_for

KEY = "network.packets.p4runtime_ctrl"


def test_nobody_wants_anything():
    assert requests_for("s1", [], {}) == {}
    assert requests_for("s1", [f"{KEY}.s2.all"], {}) == {}


def test_all_packets_by_name_or_wildcard():
    for key in (f"{KEY}.s1.all", f"{KEY}.*.all", f"{KEY}.s1.*", f"{KEY}.**", "network.**"):
        found = requests_for("s1", [key], {})
        assert {segment: (r.name, r.bit, r.conditions) for segment, r in found.items()} == {
            "all": ("packets", 255, {})
        }


def test_ports_have_requests_of_their_own():
    found = requests_for("s1", [f"{KEY}.s1.3", f"{KEY}.*.1", f"{KEY}.s1.3"], {})
    assert {segment: (r.bit, r.conditions) for segment, r in found.items()} == {
        "1": (254, {"ingress_port": 1}),
        "3": (253, {"ingress_port": 3}),
    }


def test_offers_are_copied_only_while_observed():
    offers = {
        "scan": Offer(name="scan", bit=4, conditions={"dport": 23}),
        "count": Offer(name="count", bit=5, copy=False),
        "gone": Offer(name="gone", bit=6, active=False),
        "elsewhere": Offer(name="elsewhere", bit=7, switch="s2", copy=False),
    }
    assert set(requests_for("s1", [f"{KEY}.**"], offers)) == {"all", "count"}
    assert set(requests_for("s1", [f"{KEY}.s1.scan", f"{KEY}.s1.gone"], offers)) == {"scan", "count"}
