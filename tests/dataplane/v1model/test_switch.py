"""What one frame leads to, feature by feature, on both back ends; expectations are BMv2's behaviour."""

import zlib

import pytest

from dataplane.compiler.machine import Digest
from dataplane.v1model.externs import MeterConfig
from dataplane.v1model.switch import Replica, Switch
from dataplane.v1model.tables import Exact, Lpm, Range, TableEntry, Ternary
from sdnator.testing.switch_traffic import ethernet, frame
from tests.dataplane.loading import MAKERS, features, fields, shared
from tests.naive.p4.hashes import crc16, csum16
from tests.naive.p4.sample_encoding import encode_sample as encode


@pytest.fixture(params=MAKERS)
def switch(request):
    made = Switch(features(), maker=request.param)
    made.tables["I.ports"].insert(TableEntry((Exact(1),), "I.forward", (2,)))
    yield made
    made.close()


def only(switch: Switch, data: bytes, port: int = 1, now_us: int = 1000) -> bytes:
    """The single frame that leaves through port 2."""
    result = switch.process(port, data, now_us)
    assert [p for p, _ in result.outputs] == [2]
    assert result.verdicts == b"\x02"
    return result.outputs[0][1]


def ipv4(*, ihl: int = 5, ttl: int = 64, options: bytes = b"", dst: int = 0x0A000002) -> bytes:
    head = bytes([0x40 | ihl, 0]) + b"\0\x14\0\0\0\0" + bytes([ttl, 6])
    addresses = (0x0A000001).to_bytes(4, "big") + dst.to_bytes(4, "big")
    checksum = csum16(head + addresses + options)
    return ethernet(0x0800, head + checksum.to_bytes(2, "big") + addresses + options)


def test_frame_is_forwarded_unchanged(switch):
    data = ethernet(0x1234, b"payload")
    assert only(switch, data) == data


def test_unmatched_port_leaves_through_port_zero_as_in_bmv2(switch):
    assert switch.process(3, ethernet(0x1234, b""), 0).outputs == [(0, ethernet(0x1234, b""))]


def test_port_that_does_not_exist_drops_and_counts(switch):
    switch.set_ports({1, 3})
    result = switch.process(1, ethernet(0x1234, b""), 0)
    assert (result.outputs, result.verdicts) == ([], b"\0")
    assert switch.statistics()["no_such_port"] == 1
    assert switch.statistics()["dropped"] == 1


def test_packet_out_enters_at_the_cpu_port(switch):
    result = switch.packet_out((3 << 7).to_bytes(2, "big") + ethernet(0x1234, b"x"), 0)
    assert result.outputs == [(3, ethernet(0x1234, b"x"))]


def test_packet_in_carries_header_and_time(switch):
    result = switch.process(1, frame(15), 123_456)
    assert result.outputs == []
    assert result.verdicts == b"\x01"
    assert result.packet_ins[0][:2] == (1 << 7 | 3).to_bytes(2, "big")
    assert fields(result.packet_ins[0][2:])["e"] == 123_456


def test_lpm_hit_counts_and_rewrites_checksum(switch):
    route = switch.tables["I.route"]
    route.insert(TableEntry((Lpm(0x0A000000, 8),), "I.drop"))
    route.insert(TableEntry((Lpm(0x0A000000, 24),), "I.counted", (2,)))
    left = only(switch, ipv4())
    assert left[22] == 63
    assert csum16(left[14:34]) == 0
    counter = route.counter((Lpm(0x0A000000, 24),))
    assert (counter.packets, counter.bytes) == (1, 34)
    assert route.counter((Lpm(0x0A000000, 8),)).packets == 0


def test_saturating_subtraction_stays_at_zero(switch):
    switch.tables["I.route"].insert(TableEntry((Lpm(0, 0),), "I.counted", (2,)))
    assert only(switch, ipv4(ttl=0))[22] == 0


def test_varbit_options_are_checked_and_kept(switch):
    switch.tables["I.route"].insert(TableEntry((Lpm(0, 0),), "I.counted", (2,)))
    options = bytes(range(8))
    left = only(switch, ipv4(ihl=7, options=options))
    assert left[15] == 0, "checksum was right"
    assert left[34:] == options
    assert csum16(left[14:]) == 0
    broken = bytearray(ipv4(ihl=7, options=options))
    broken[36] ^= 1
    assert only(switch, bytes(broken))[15] == 0xFF


def test_truncated_frame_goes_on_with_parser_error(switch):
    data = ethernet(0x88B5, b"\x0d\0\0")
    assert only(switch, data) == data, "what was not extracted is payload"
    assert switch.statistics()["parser_errors"] == 1


def test_verify_sets_the_named_error(switch):
    assert fields(only(switch, frame(0xFF)))["what"] == 0xFF
    assert switch.statistics()["parser_errors"] == 1


def test_varbit_longer_than_the_frame_is_an_error(switch):
    switch.tables["I.route"].insert(TableEntry((Lpm(0, 0),), "I.counted", (2,)))
    data = ipv4(ihl=15)
    assert len(only(switch, data)) == len(data)
    assert switch.statistics()["parser_errors"] == 1


@pytest.mark.parametrize(
    ("label", "expected"),
    [
        (1, [(2, 0), (3, 1)]),
        (2, [(77, 0), (2, 0), (2, 0)]),
        (3, [(3, 0), (3, 0), (3, 1)]),
        (4, [(4, 0), (2, 0)]),
    ],
)
def test_header_stack(switch, label, expected):
    """pop, push (the last of three falls off), copy within, and an invalid member at the end."""
    labels = [(label, 0), (2, 0), (3, 1)]
    body = b"".join((n << 12 | bottom << 8 | 9).to_bytes(4, "big") for n, bottom in labels)
    left = only(switch, ethernet(0x88B6, body + b"tail"))
    words = [int.from_bytes(left[i : i + 4], "big") for i in range(14, len(left) - 4, 4)]
    assert [(w >> 12, w >> 8 & 1) for w in words] == expected
    assert left.endswith(b"tail")


def test_stack_overflow_is_an_error(switch):
    body = (5 << 12).to_bytes(4, "big") * 4
    assert only(switch, ethernet(0x88B6, body)) == ethernet(0x88B6, body)
    assert switch.statistics()["parser_errors"] == 1


def test_ingress_clone_keeps_its_field_list_and_is_parsed_anew(switch):
    switch.set_clone_session(5, [Replica(3, 7)])
    result = switch.process(1, frame(1, d=40, rest=b"z" * 60), 0)
    (clone_port, clone), (port, original) = result.outputs
    assert (clone_port, port) == (3, 2)
    assert fields(clone) | {"result": 0} == {
        "what": 1, "a": 0, "b": 0, "c": 93, "d": 41, "e": 0, "result": 0,
    }  # fmt: skip
    assert fields(clone)["result"] == 0x0107, "instance type 1, replica 7"
    assert len(clone) == 60
    assert original == frame(1, d=40, rest=b"z" * 60)


def test_clone_session_can_shorten_copies(switch):
    switch.set_clone_session(5, [Replica(3)], packet_length=20)
    assert [len(f) for _, f in switch.process(1, frame(1), 0).outputs] == [20, 33]


def test_clone_to_a_session_that_does_not_exist_makes_none(switch):
    assert len(switch.process(1, frame(1), 0).outputs) == 1
    switch.set_clone_session(5, [Replica(3)])
    switch.delete_clone_session(5)
    assert len(switch.process(1, frame(1), 0).outputs) == 1


def test_egress_clone_has_headers_as_they_were(switch):
    switch.set_clone_session(6, [Replica(4, 9)])
    result = switch.process(1, frame(17, b=1), 0)
    assert [p for p, _ in result.outputs] == [2, 4]
    assert fields(result.outputs[0][1])["b"] == 0x44
    assert fields(result.outputs[1][1])["b"] == 0x44
    assert fields(result.outputs[1][1])["d"] == 99
    assert fields(result.outputs[1][1])["result"] == 0x0209


def test_multicast_copies_in_order_and_drops_one_in_egress(switch):
    switch.tables["I.ports"].insert(TableEntry((Exact(4),), "I.flood", (9,)))
    switch.set_multicast_group(9, [Replica(1, 1), Replica(3, 2), Replica(5, 3)])
    outputs = switch.process(4, frame(19), 0).outputs
    assert [(p, fields(f)["result"]) for p, f in outputs] == [(1, 0x0501), (5, 0x0503)]
    switch.delete_multicast_group(9)
    assert switch.process(4, frame(19), 0).outputs == []


def test_resubmit_keeps_its_field_list_and_nothing_else(switch):
    # metadata starts at zero again, the ingress port included, as in BMv2
    switch.tables["I.ports"].insert(TableEntry((Exact(0),), "I.forward", (2,)))
    got = fields(only(switch, frame(2, a=3)))
    assert (got["b"], got["c"], got["d"]) == (3, 0, 6)


def test_recirculate_until_done(switch):
    switch.tables["I.ports"].insert(TableEntry((Exact(0),), "I.forward", (2,)))
    assert fields(only(switch, frame(18, a=5, c=100)))["c"] == 105


def test_endless_recirculation_is_cut(switch):
    switch.tables["I.ports"].insert(TableEntry((Exact(4),), "I.flood", (9,)))
    switch.tables["I.ports"].insert(TableEntry((Exact(0),), "I.flood", (9,)))
    switch.set_multicast_group(9, [Replica(1, 1), Replica(3, 2)])
    switch.process(4, frame(18, a=255), 0)
    assert switch.statistics()["loop_drops"] > 0


def test_registers(switch):
    cells = switch.registers["I.cells"]
    cells.write(3, 1000)
    assert fields(only(switch, frame(3, a=3, d=5)))["e"] == 1000
    assert cells.read(3) == 1005


def test_wide_register(switch):
    wide = switch.registers["I.wide_cells"]
    value = 0x1234 << 180 | 0xABCDEF << 64 | 99
    wide.write(2, value)
    got = fields(only(switch, frame(4, a=2, d=0x55)))
    expected = ((value << 8) & (2**200 - 1)) ^ 0x55
    assert wide.read(2) == expected
    assert got["e"] == expected >> 67 & (2**64 - 1)
    assert got["result"] == expected >> 184 & 0xFFFF


def test_indirect_meter_runs_on_packet_time(switch):
    switch.meters["I.rate"].configure(2, MeterConfig(1, 1, 1, 2))
    colours = [fields(only(switch, frame(5, a=2), now_us=t))["b"] for t in (0, 0, 0, 1_000_000, 1_000_000)]
    assert colours == [0, 1, 2, 0, 2]


def test_indirect_counter(switch):
    for _ in range(3):
        only(switch, ethernet(1, b"abc"))
    assert switch.counters["I.seen"].read(1).packets == 3
    assert switch.counters["I.seen"].read(1).bytes == 51


def test_range_ternary_exact_with_direct_meter_and_action_run(switch):
    flows = switch.tables["I.flows"]
    low = (Range(10, 20), Ternary(0x100, 0xF00), Exact(1))
    high = (Range(0, 0xFFFF), Ternary(0, 0), Exact(1))
    flows.insert(TableEntry(low, "I.metered", (2,), 5))
    flows.insert(TableEntry(high, "I.drop", (), 4))
    flows.set_meter(low, 5, MeterConfig(1, 40, 1, 40))
    assert fields(only(switch, frame(6, a=1, c=15, d=0x1FF)))["b"] == 0
    assert fields(only(switch, frame(6, a=1, c=15, d=0x1FF)))["b"] == 2
    result = switch.process(1, frame(6, a=1, c=21, d=0x1FF), 0)
    assert (result.outputs, result.digests) == ([], [Digest("other_t", encode((6, 253)))])
    assert fields(only(switch, frame(6, a=2)))["b"] == 0xEE


def test_const_entries_first_wins(switch):
    assert fields(only(switch, frame(10, a=1, b=0x1F)))["b"] == 0x11
    assert fields(only(switch, frame(10, a=1, b=0x2F)))["b"] == 0x22
    assert switch.process(1, frame(10, a=2, b=5), 0).outputs == []


def test_digest_values(switch):
    result = switch.process(1, frame(11, d=77), 0)
    assert result.digests == [Digest("note_t", encode((1, 0x020000000001, 77)))]


def test_truncate_in_ingress(switch):
    assert len(only(switch, frame(12, a=17, rest=b"r" * 50))) == 17


def test_header_set_valid_again_is_zero_and_length_follows(switch):
    got = fields(only(switch, frame(13, a=9, d=9, e=9)))
    assert got == {"what": 13, "a": 0, "b": 0, "c": 33, "d": 0, "e": 0, "result": 0}


def test_identity_hash_with_base_and_size(switch):
    e = 0x0102030405060708
    assert fields(only(switch, frame(14, a=3, c=1000, e=e)))["result"] == e % 1000 + 3
    assert fields(only(switch, frame(14, a=3, c=0, e=e)))["result"] == 3, "size 0 counts as 1"


def test_crc_hashes(switch):
    left = only(switch, ethernet(0x9000, b"\x12\x34" + b"\0" * 8))
    counted, hashed, crc = (int.from_bytes(left[a:b], "big") for a, b in ((14, 16), (16, 18), (18, 22)))
    assert counted == 24
    text = bytes.fromhex("020000000001 020000000002") + (24).to_bytes(4, "big") + b"\xa0"
    assert hashed == crc16(text) % 1000 + 100
    assert crc == zlib.crc32(b"\x90\x00\x12\x34")


def test_unsigned_arithmetic_wraps(switch):
    a, b, c, d, e = 5, 3, 0x1234, 0x80000000, 0x8000000000000001
    got = fields(only(switch, frame(16, a=a, b=b, c=c, d=d, e=e)))
    new_c = (c * c & 0xFFFF) ^ (~c & 0xFFFF)
    assert got == {
        "what": 16, "a": a, "b": 1, "c": new_c, "d": d >> b, "e": e << a & (2**64 - 1),
        "result": (new_c - a) & 0xFFFF,
    }  # fmt: skip


@pytest.mark.parametrize(("x", "y"), [(100, 100), (-100, -100), (-128, -1), (5, -3), (-1, 1), (127, 1)])
def test_signed_arithmetic(switch, x, y):
    left = only(switch, frame(7, rest=bytes([x & 0xFF, y & 0xFF]) + b"\0" * 7))
    values = left[33:]
    wrapped = (x + y) & 0xFF
    clamped = min(max(x + y, -128), 127) & 0xFF
    ux, uy = x & 0xFF, y & 0xFF
    assert values[2:6] == bytes([wrapped, clamped, min(ux + uy, 255), max(ux - uy, 0)])
    assert int.from_bytes(values[6:8], "big", signed=True) == x * y
    assert values[8] == (x >> 2) & 0xFF
    assert fields(left)["result"] == (1 if x < y else 2 if x == -128 else 0)


@pytest.mark.parametrize(
    ("left", "right"), [(2**128 - 1, 2**128 - 1), (0, 1), (1 << 127, 3), (12345678901234567890123, 987654321)]
)
def test_wide_arithmetic(switch, left, right):
    body = left.to_bytes(16, "big") + right.to_bytes(16, "big") + b"\0" * 112
    out = only(switch, frame(8, a=4, rest=body))
    got = out[33:]
    total = (left + (right << 64)) % 2**256
    assert int.from_bytes(got[32:64], "big") == total
    assert int.from_bytes(got[64:80], "big") == left * right % 2**128
    joined = left << 384 | right << 256 | (total - 1) % 2**256
    assert int.from_bytes(got[80:144], "big") == joined
    assert fields(out)["result"] == (1 if left > right else 2 if total >= right else 0)


def test_checksum_over_payload(switch):
    left = only(switch, frame(20, a=7, rest=b"odd"))
    assert fields(left)["result"] == csum16(b"\x14\x07odd")


def test_exit_skips_the_rest(switch):
    switch.tables["I.ports"].modify(TableEntry((Exact(1),), "I.stop"))
    assert switch.process(1, frame(11), 0).digests == []
    assert switch.counters["I.seen"].read(1).packets == 0


def test_batches_equal_single_frames(switch):
    frames = [frame(3, a=1, d=1), frame(11), b"", ethernet(0x1234, b"x" * 9000)]
    batch = switch.process_many(1, frames, [1, 2, 3, 4])
    assert batch.verdicts == b"\2\2\2\2"
    assert len(batch.outputs) == 4
    assert batch.digests == [Digest("note_t", encode((1, 0x020000000001, 0)))]
    assert switch.process_many(1, [], []).verdicts == b""


def test_oversized_frames_are_counted(switch):
    assert switch.process(1, b"\0" * 65_536, 0).verdicts == b"\0"
    assert switch.statistics()["oversized"] == 1


@pytest.mark.parametrize("maker", MAKERS)
def test_small_program_punts_clones_and_learns(maker):
    switch = Switch(shared("small"), maker=maker)
    acl = switch.tables["I.acl"]
    data = ethernet(0x0800, ipv4()[14:] + b"\0\x50\0\x51" + b"\0" * 16)
    any_ = Ternary(0, 0)
    key = (any_, Ternary(0x0800, 0xFFFF), any_, any_, any_, any_)
    assert switch.process(1, data, 0).verdicts == b"\0", "the default drops"
    acl.insert(TableEntry(key, "I.punt", (5,), 1))
    assert switch.process(1, data, 0).packet_ins == [b"\0\x85" + data]
    acl.insert(TableEntry(key, "I.learn", (2,), 2))
    assert switch.process(1, data, 0).digests == [Digest("digest_t", encode((0x0A000001, 0x0A000002, 0x51)))]
    acl.insert(TableEntry(key, "I.punt_clone", (2,), 3))
    switch.set_clone_session(99, [Replica(510, 1)])
    result = switch.process(1, data, 0)
    # a plain clone forgets the ingress port
    assert (result.packet_ins, result.outputs) == ([b"\0\x63" + data], [(2, data)])
    assert result.verdicts == b"\x03"
    switch.close()
