"""Layer 2: flooding, learning by digest, stations that move, VLANs; wires come first."""

from dataplane.v1model.tables import Exact
from tests.p4.sdnator_switch import CPU, FLOOD, FLOOD_10, entry, ethernet, mac, udp, want_all

A, B = mac(1), mac(2)
BROADCAST = (1 << 48) - 1


def flooding(switch, group=FLOOD):
    switch.tables["ingress.dmac"].set_default("ingress.flood", (group,))


def learn(switch, station, port, vid=0):
    """What a controller does with a learn digest."""
    switch.tables["ingress.smac"].insert(entry((Exact(vid), Exact(station)), "known_station", port))
    switch.tables["ingress.dmac"].insert(entry((Exact(vid), Exact(station)), "set_egress", port))


def sent(switch, port, data, now=7):
    """Ports that the frame leaves by, and who is to be learnt."""
    result = switch.process(port, data, now)
    assert all(out == data for _, out in result.outputs)
    assert {d.name for d in result.digests} <= {"learn_digest_t"}
    return [number for number, _ in result.outputs], [d.values for d in result.digests]


def test_without_entries_nothing_leaves_and_nobody_is_learnt(switch):
    assert sent(switch, 1, ethernet(A, B, udp())) == ([], [])


def test_a_frame_to_an_unknown_station_is_flooded_but_not_back(switch):
    flooding(switch)
    assert sent(switch, 2, ethernet(A, B, udp()), now=77) == ([1, 3], [(A, 2, 77, 0)])


def test_a_learnt_station_gets_its_frames_alone_and_is_not_told_again(switch):
    flooding(switch)
    learn(switch, A, 1)
    assert sent(switch, 2, ethernet(B, A, udp()))[0] == [1]
    assert sent(switch, 1, ethernet(A, BROADCAST, udp())) == ([2, 3], [])


def test_a_station_that_moved_is_told(switch):
    flooding(switch)
    learn(switch, A, 1)
    assert sent(switch, 3, ethernet(A, BROADCAST, udp())) == ([1, 2], [(A, 3, 7, 0)])


def test_a_frame_between_stations_of_one_port_goes_nowhere(switch):
    flooding(switch)
    learn(switch, A, 1)
    learn(switch, B, 1)
    assert sent(switch, 1, ethernet(A, B, udp())) == ([], [])


def test_a_group_address_is_no_station(switch):
    flooding(switch)
    assert sent(switch, 1, ethernet(A | 1 << 40, B, udp())) == ([2, 3], [])


def test_a_vlan_has_its_own_stations_and_flood_group(switch):
    flooding(switch)
    learn(switch, A, 3)
    switch.tables["ingress.vlan_flood"].insert(entry((Exact(10),), "flood_vlan", FLOOD_10))
    assert sent(switch, 1, ethernet(B, A, udp(), vid=10)) == ([2], [(B, 1, 7, 10)])
    assert sent(switch, 1, ethernet(B, A, udp(), vid=11))[0] == [2, 3]


def test_a_vlan_may_flood_where_others_drop(switch):
    switch.tables["ingress.vlan_flood"].insert(entry((Exact(10),), "flood_vlan", FLOOD_10))
    assert sent(switch, 1, ethernet(A, B, udp(), vid=10))[0] == [2]
    assert sent(switch, 1, ethernet(A, B, udp())) == ([], [])


def test_wires_win_and_teach_nobody(switch):
    flooding(switch)
    learn(switch, B, 3)
    switch.tables["ingress.forward_port"].insert(entry((Exact(1),), "to_port", 2))
    assert sent(switch, 1, ethernet(A, B, udp())) == ([2], [])


def test_learning_can_be_switched_off(switch):
    flooding(switch)
    switch.tables["ingress.smac"].set_default("ingress.ignore")
    assert sent(switch, 1, ethernet(A, B, udp())) == ([2, 3], [])


def test_idle_senders_are_reported(switch):
    key = (Exact(0), Exact(A))
    switch.tables["ingress.smac"].insert(
        entry(key, "known_station", 1)._replace(idle_timeout_ns=1_000_000_000)
    )
    learn(switch, B, 2)
    switch.process(1, ethernet(A, B, udp()), 500_000)
    assert switch.expired(1_400_000) == []
    assert [found.match for _, found in switch.expired(1_600_000)] == [key]


def test_a_frame_with_two_reasons_for_a_digest_makes_a_learn_digest_and_a_copy(switch):
    flooding(switch)
    want_all(switch, digests=1)
    result = switch.process(1, ethernet(A, B, udp()), 5)
    assert [d.name for d in result.digests] == ["learn_digest_t"]
    assert len(result.packet_ins) == 1
    learn(switch, A, 1)
    result = switch.process(1, ethernet(A, B, udp()), 5)
    assert [d.name for d in result.digests] == ["frame_digest_t"]
    assert result.packet_ins == []


def test_a_blocked_station_is_not_learnt(switch):
    flooding(switch)
    switch.tables["ingress.block_mac"].insert(entry((Exact(1), Exact(A)), "drop_mac"))
    assert sent(switch, 1, ethernet(A, B, udp())) == ([], [])


def test_the_cpu_is_no_flood_port(switch):
    flooding(switch)
    result = switch.process(1, ethernet(A, B, udp()), 0)
    assert CPU not in [port for port, _ in result.outputs]
    assert result.packet_ins == []
