"""Every key that somebody wants gets its packets, in order, and nobody else gets any."""

from apps.p4runtime_ctrl.packet_publisher import PacketPublisher
from apps.p4runtime_ctrl.telemetry.demand import Offer, demand_for, key_of
from sdnator.testing.controller_run import frame
from sdnator.testing.product_program import EVERY_PACKET, packet_in, program
from tests.apps.p4runtime_ctrl.southbound.test_digest_in import QUOTED, SYN, digest_list

ALL = key_of("packets", "s1", "all")


def publisher(*keys, offers=None, **options):
    written = []
    made = PacketPublisher("s1", program(), 1_000_000, lambda *item: written.append(item), **options)
    by_digest = options.get("by_digest", False)
    made.route(demand_for("s1", keys, offers or {}, by_digest=by_digest))
    return made, written


def test_packets_go_where_they_are_wanted():
    offers = {"one": Offer(name="one", bit=1)}
    made, written = publisher(
        ALL, key_of("packets", "s1", "one"), key_of("frames", "s1", "one"), offers=offers
    )
    made.packets([packet_in(1, frame=frame(1), timestamp=5, queries=EVERY_PACKET | 2)])
    made.packets([packet_in(2, frame=frame(2), timestamp=6)])
    assert [(key, time) for key, _, time in written] == [
        (ALL, 1_000_005_000),
        (key_of("packets", "s1", "one"), 1_000_005_000),
        (key_of("frames", "s1", "one"), 1_000_005_000),
        (ALL, 1_000_006_000),
    ]
    assert written[2][1]["frames"] == [frame(1)]
    assert (made.progress.received, made.second) == (2, 1)


def test_nothing_is_written_that_nobody_wants():
    made, written = publisher()
    made.packets([packet_in(1, frame=frame(1))])
    made.digests([digest_list(SYN)])
    assert not written


def test_records_come_from_digests_where_that_is_chosen():
    made, written = publisher(ALL, by_digest=True)
    made.digests([digest_list(SYN, QUOTED)])
    assert not written, "numbers 1 to 3 may still come"
    made.settle()
    made.settle()
    assert [(key, value["arrival"].tolist()) for key, value, _ in written] == [(ALL, [3])]
    made, written = publisher(key_of("digests", "s1", "q"), offers={"q": Offer(name="q", bit=3, copy=False)})
    made.digests([digest_list(SYN, QUOTED)])
    assert [value["crossed"].tolist() for _, value, _ in written] == [[1]]


def test_a_frame_that_its_digest_does_not_tell_comes_from_its_copy():
    made, written = publisher(ALL, by_digest=True)
    made.digests([digest_list({**SYN, "sequence": 1, "arrival": 0}, {**SYN, "sequence": 2, "l4_valid": 0})])
    assert [value["sequence"].tolist() for _, value, _ in written] == [[1]]
    made.packets([packet_in(2, frame=frame(1), timestamp=9)])
    assert [value["sequence"].tolist() for _, value, _ in written] == [[1], [2]]
    assert written[1][1]["udp_dport"].tolist() == [53]
    assert made.fell_back == 1
