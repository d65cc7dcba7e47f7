"""Keys that somebody wants become requests and routes; offers of other apps count only while observed."""

from apps.p4runtime_ctrl.telemetry.demand import Demand, Offer, demand_for, key_of

KEY = "network.packets.p4runtime_ctrl"


def names(demand):
    return [(request.name, request.bit) for request in demand.requests]


def test_nobody_wants_anything():
    for wanted in ([], [f"{KEY}.s2.all"], ["network.anomaly.**"]):
        demand = demand_for("s1", wanted, {})
        assert not demand.requests
        assert not any(demand.routes.values())
    assert Demand().to("packets") == {}


def test_all_packets_by_name_or_wildcard():
    for key in (f"{KEY}.s1.all", f"{KEY}.*.all", f"{KEY}.s1.*", f"{KEY}.**", "network.packets.**"):
        demand = demand_for("s1", [key], {})
        assert names(demand) == [("packets", 255)]
        assert demand.to("packets") == {"all": 255}
        assert demand.to("frames") == {}


def test_frames_are_routed_apart_and_asked_for_once():
    demand = demand_for("s1", [f"{KEY}.s1.all", key_of("frames", "s1", "all")], {})
    assert names(demand) == [("packets", 255)]
    assert demand.to("packets") == demand.to("frames") == {"all": 255}
    everything = demand_for("s1", ["network.**"], {})
    assert everything.to("digests") == everything.to("counts") == {"all": 255}


def test_ports_have_requests_of_their_own():
    demand = demand_for("s1", [f"{KEY}.s1.3", f"{KEY}.*.1", f"{KEY}.s1.3", key_of("frames", "s1", "7")], {})
    assert [(r.name, r.bit, r.conditions) for r in demand.requests] == [
        ("port7", 254, {"ingress_port": 7}),
        ("port3", 253, {"ingress_port": 3}),
        ("port1", 252, {"ingress_port": 1}),
    ]
    assert demand.to("packets") == {"1": 252, "3": 253}
    assert demand.to("frames") == {"7": 254}


def test_offers_are_sent_only_while_observed():
    offers = {
        "scan": Offer(name="scan", bit=4, conditions={"dport": 23}),
        "gone": Offer(name="gone", bit=6, active=False),
        "elsewhere": Offer(name="elsewhere", bit=7, switch="s2", copy=False),
        "report": Offer(name="report", bit=8, copy=False, digest=True),
    }
    assert names(demand_for("s1", [f"{KEY}.**"], offers)) == [("packets", 255)]
    demand = demand_for(
        "s1",
        [
            f"{KEY}.s1.scan",
            f"{KEY}.s1.gone",
            key_of("digests", "*", "report"),
            key_of("counts", "s1", "report"),
        ],
        offers,
    )
    assert names(demand) == [("report", 8), ("scan", 4)]
    assert demand.to("packets") == {"scan": 4}
    assert demand.to("digests") == demand.to("counts") == {"report": 8}


def test_a_port_that_no_switch_has_is_not_requested():
    wanted = [f"{KEY}.s1.600", f"{KEY}.s1.{'9' * 900}", f"{KEY}.s1.511", f"{KEY}.s1.all"]
    demand = demand_for("s1", wanted, {})
    assert names(demand) == [("packets", 255), ("port511", 254)]
    assert demand.to("packets") == {"all": 255, "511": 254}
    assert names(demand_for("s1", wanted, {}, last_port=255)) == [("packets", 255)]


def test_what_is_left_out_of_a_demand_is_not_published_either():
    wanted = [f"{KEY}.s1.1", f"{KEY}.s1.all", key_of("frames", "s1", "1"), "network.telemetry_counters.**"]
    demand = demand_for("s1", wanted, {}, by_digest=True)
    left = demand.only(request for request in demand.requests if request.name != "port1")
    assert "port1" not in [name for name, _ in names(left)]
    assert left.routes == {"packets": {"all": 255}, "frames": {}, "digests": {}, "counts": {}}
    assert left.counters
