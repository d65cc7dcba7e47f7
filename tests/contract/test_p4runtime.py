"""One behaviour for every P4Runtime target: what the embedded switch does, BMv2 does too.

Where BMv2 departs from the P4Runtime specification, the embedded switch follows the specification; every
such matter has a name in differences.py.
"""

import time

import grpc
import pytest

from p4rt import p4runtime
from sdnator.testing.p4runtime_client import (
    TIMEOUT_S,
    clone_session,
    delete,
    insert,
    modify,
    program_config,
    text,
)
from tests.contract.asking import codes, entries, flow, forward, frame, ip_frame, route, status_of
from tests.contract.differences import differs
from tests.requirements import shared_data

UNKNOWN, INVALID, NOT_FOUND, EXISTS, DENIED, EXHAUSTED = 2, 3, 5, 6, 7, 8
ABORTED, RANGE, UNIMPLEMENTED = 10, 11, 12
CPU = 510


# -- arbitration --------------------------------------------------------------------------------------


def test_the_primary_is_told_and_a_lower_id_is_backup(target, connect):
    backup, primary = connect(), connect()
    assert primary.arbitrate().status.code == 0
    answer = backup.arbitrate()
    assert answer.status.code == EXISTS
    assert answer.election_id.low == primary.election_id


def test_a_higher_id_takes_over_and_the_old_primary_is_told(target, connect):
    old, new = connect(), connect()
    old.arbitrate()
    assert new.arbitrate().status.code == 0
    told = old.arbitrations.get(timeout=TIMEOUT_S)
    assert (told.status.code, told.election_id.low) == (EXISTS, new.election_id)


def test_an_election_id_in_use_ends_the_stream(target, connect):
    first = connect()
    first.arbitrate()
    second = connect(election_id=first.election_id)
    second.ask_for_arbitration()
    assert second.ended.wait(TIMEOUT_S)
    assert second.error.code() == grpc.StatusCode.INVALID_ARGUMENT


def test_another_device_is_not_found(target, connect):
    if differs(target, "device-ids"):
        return
    stranger = connect(device_id=77)
    stranger.ask_for_arbitration()
    assert stranger.ended.wait(TIMEOUT_S)
    assert stranger.error.code() == grpc.StatusCode.NOT_FOUND


def test_backups_must_not_write(target, connect, controller, names):
    backup = connect(election_id=None)
    backup.arbitrate()
    backup.election_id = controller.election_id - 1
    assert status_of(lambda: backup.write(insert(route(names, 0x0A000000, 8)))) == DENIED
    assert backup.read(entries(names, "I.route")) == []


def test_when_the_primary_leaves_the_backup_is_told(target, connect):
    backup, primary = connect(), connect()
    backup.arbitrate()
    primary.arbitrate()
    backup.arbitrations.get(timeout=TIMEOUT_S)
    primary.close()
    told = backup.arbitrations.get(timeout=TIMEOUT_S)
    assert told.status.code == (0 if differs(target, "takeover") else NOT_FOUND)
    # a controller that answers with a higher id is primary on either
    assert backup.arbitrate(primary.election_id + 1).status.code == 0


# -- pipeline -----------------------------------------------------------------------------------------


def test_the_pipeline_is_handed_back_as_it_was_set(target, bare, config):
    config.cookie.cookie = 4711
    bare.set_pipeline(config)
    assert bare.get_pipeline() == config
    assert bare.get_pipeline("COOKIE_ONLY").cookie.cookie == 4711
    assert not bare.get_pipeline("COOKIE_ONLY").p4_device_config
    assert not bare.get_pipeline("P4INFO_AND_COOKIE").p4_device_config
    assert not bare.get_pipeline("DEVICE_CONFIG_AND_COOKIE").HasField("p4info")


def test_setting_a_pipeline_clears_the_tables(target, controller, config, names):
    controller.write(insert(route(names, 0x0A000000, 8)))
    controller.set_pipeline(config)
    assert controller.read(entries(names, "I.route")) == []


def test_verify_changes_nothing(target, controller, config, names):
    controller.write(insert(route(names, 0x0A000000, 8)))
    controller.set_pipeline(config, "VERIFY")
    assert len(controller.read(entries(names, "I.route"))) == 1


def test_a_saved_pipeline_takes_writes_and_then_comes_into_force(target, controller, config, names):
    if differs(target, "save-and-reconcile"):
        return
    controller.write(insert(route(names, 0x0A000000, 8, 2)))
    controller.set_pipeline(config, "VERIFY_AND_SAVE")
    assert controller.read(entries(names, "I.route")) == []
    controller.write(insert(route(names, 0x0A000000, 8, 3)))
    target.inject(1, ip_frame(0x0A000001))
    assert len(target.sent(2, 1)) == 1
    controller.set_pipeline(None, "COMMIT")
    target.inject(1, ip_frame(0x0A000001))
    assert len(target.sent(3, 1)) == 1
    assert status_of(lambda: controller.set_pipeline(None, "COMMIT")) == NOT_FOUND


def test_reconciling_keeps_what_was_written(target, controller, config, names):
    if differs(target, "save-and-reconcile"):
        return
    written = [insert(route(names, 0x0A000000, 8)), insert(flow(names)), insert(clone_session(5, CPU))]
    controller.write(
        *written, modify(_meter(names, 2, 1, 1, 1, 2)), modify(names.default("I.ports", "I.forward", [3]))
    )
    controller.set_pipeline(config, "RECONCILE_AND_COMMIT")
    asked = [entries(names, "I.route"), entries(names, "I.flows"), clone_session(5)]
    assert controller.read(*asked) == [update.entity for update in written]
    assert controller.read(_meter(names, 2)) == [_meter(names, 2, 1, 1, 1, 2)]
    assert controller.read(names.default("I.ports", None)) == [names.default("I.ports", "I.forward", [3])]


def test_a_p4info_that_does_not_fit_is_refused(target, controller, config):
    if differs(target, "empty-program"):
        return
    other = type(config)()
    other.CopyFrom(config)
    other.p4info.tables[0].match_fields[0].bitwidth += 1
    assert status_of(lambda: controller.set_pipeline(other)) == INVALID


def test_what_is_no_program_is_refused(target, controller, config):
    if differs(target, "empty-program"):
        return
    broken = type(config)()
    broken.CopyFrom(config)
    broken.p4_device_config = b"{}"
    assert status_of(lambda: controller.set_pipeline(broken)) == INVALID
    assert controller.get_pipeline().p4_device_config == config.p4_device_config


def test_the_shared_programs_run(target, bare):
    for name in ("small", "sketch"):
        bare.set_pipeline(program_config(shared_data(f"p4/{name}.json").with_suffix("")))
        assert bare.read(p4runtime.Entity(table_entry=p4runtime.TableEntry())) == []


# -- entries ------------------------------------------------------------------------------------------


def test_entries_read_back_as_written(target, controller, names):
    written = [
        route(names, 0x0A000000, 8),
        route(names, 0x0A010000, 16, 3, idle_timeout_ns=10**9),
        names.entry("I.route", {}, "I.drop"),
        flow(names),
        flow(names, priority=4),
        names.entry("I.flows", {"h.test.a": 4}, "I.drop", priority=9, metadata=b"mine"),
        names.entry("I.maybe", {"h.test.b": 0}, "I.label_as", [1, 0], priority=1),
        names.entry("I.maybe", {}, "I.label_as", [255, 0xFFFFFFFF], priority=7),
        names.entry("I.ports", {"sm.ingress_port": 0}, "I.flood", [0xFFFF]),
    ]
    controller.write(*map(insert, written))
    tables = ("I.route", "I.flows", "I.maybe", "I.ports")
    found = [entity for table in tables for entity in controller.read(entries(names, table))]
    assert sorted(map(str, found)) == sorted(map(str, written))


def test_reads_select(target, controller, names):
    a, b = route(names, 0x0A000000, 8), names.entry("I.route", {"h.ip.dst": (0x0B000000, 8)}, "I.drop")
    controller.write(*map(insert, (a, b, flow(names), flow(names, priority=4))))
    assert controller.read(names.entry("I.route", {"h.ip.dst": (0x0B000000, 8)})) == [b]
    if not differs(target, "read-by-priority"):
        assert controller.read(entries(names, "I.flows", priority=4)) == [flow(names, priority=4)]
    assert controller.read(names.entry("I.route", {"h.ip.dst": (0x0C000000, 8)})) == []


def test_insert_modify_delete(target, controller, names):
    first, second = route(names, 0x0A000000, 8, 2), route(names, 0x0A000000, 8, 3)
    controller.write(insert(first))
    assert codes(lambda: controller.write(insert(second))) == [EXISTS]
    controller.write(modify(second))
    assert controller.read(entries(names, "I.route")) == [second]
    controller.write(delete(names.entry("I.route", {"h.ip.dst": (0x0A000000, 8)})))
    assert codes(lambda: controller.write(delete(first))) == [NOT_FOUND]
    assert codes(lambda: controller.write(modify(first))) == [NOT_FOUND]


def test_every_update_has_its_own_error_in_order(target, controller, names):
    good, other = route(names, 0x0A000000, 8), route(names, 0x0B000000, 8)
    updates = [insert(good), insert(good), insert(other), delete(flow(names))]
    assert codes(lambda: controller.write(*updates)) == [0, EXISTS, 0, NOT_FOUND]
    assert len(controller.read(entries(names, "I.route"))) == 2


def test_the_errors_of_a_large_batch_arrive(target, controller, names):
    good = insert(route(names, 0x0A000000, 8))
    limit = 60 if differs(target, "metadata-limit") else 2000
    controller.write(good)
    assert codes(lambda: controller.write(*[good] * limit)) == [EXISTS] * limit


def _zero_mask(entry):
    entry.match[1].ternary.value = entry.match[1].ternary.mask = b"\0"


WRONG = {
    "table": lambda entry: setattr(entry, "table_id", 33554431),
    "field": lambda entry: setattr(entry.match[0], "field_id", 99),
    "field twice": lambda entry: entry.match.add().CopyFrom(entry.match[0]),
    "kind": lambda entry: setattr(entry.match[2].optional, "value", b"\x04"),
    "exact missing": lambda entry: entry.match.pop(2),
    "mask of zero": _zero_mask,
    "bits outside the mask": lambda entry: setattr(entry.match[1].ternary, "value", b"\xff"),
    "range upside down": lambda entry: setattr(entry.match[0].range, "low", b"\x20"),
    "value too wide": lambda entry: setattr(entry.match[2].exact, "value", b"\x01\x00"),
    "no priority": lambda entry: setattr(entry, "priority", 0),
    "action of another table": lambda entry: setattr(entry.action.action, "action_id", 27646489),
    "no parameter": lambda entry: entry.action.action.params.pop(),
    "unknown parameter": lambda entry: setattr(entry.action.action.params[0], "param_id", 9),
    "parameter too wide": lambda entry: setattr(entry.action.action.params[0], "value", b"\x02\x00"),
    "idle time-out without support": lambda entry: setattr(entry, "idle_timeout_ns", 10**9),
    "group": lambda entry: setattr(entry.action, "action_profile_group_id", 1),
}


@pytest.mark.parametrize("what", WRONG)
def test_malformed_entries_are_invalid(target, controller, names, what):
    entity = flow(names)
    WRONG[what](entity.table_entry)
    assert codes(lambda: controller.write(insert(entity))) == [INVALID]
    assert controller.read(entries(names, "I.flows")) == []


def test_an_entry_with_a_wrong_meter_is_not_inserted(target, controller, names):
    if differs(target, "meter-check"):
        return
    wrong = flow(names)
    wrong.table_entry.meter_config.cir, wrong.table_entry.meter_config.pir = 9, 3
    assert codes(lambda: controller.write(insert(wrong))) == [INVALID]
    assert controller.read(entries(names, "I.flows")) == []
    controller.write(insert(flow(names)))
    wrong.table_entry.action.action.params[0].value = b"\x03"
    assert codes(lambda: controller.write(modify(wrong))) == [INVALID]
    assert controller.read(entries(names, "I.flows")) == [flow(names)]


def test_a_full_table_is_exhausted(target, controller, names):
    updates = [insert(names.entry("I.ports", {"sm.ingress_port": n}, "I.forward", [1])) for n in range(17)]
    full = UNKNOWN if differs(target, "table-full") else EXHAUSTED
    assert codes(lambda: controller.write(*updates)) == [0] * 16 + [full]


def test_default_actions_can_only_be_modified(target, controller, names):
    default = names.default("I.route", "I.counted", [3])
    assert codes(lambda: controller.write(insert(default))) == [INVALID]
    controller.write(modify(default))
    assert controller.read(names.default("I.route", None)) == [default]
    forward(names, controller)
    target.inject(1, ip_frame(0x01020304))
    assert len(target.sent(3, 1)) == 1
    controller.write(modify(names.default("I.route", None)))
    assert controller.read(names.default("I.route", None)) == [names.default("I.route", "I.drop")]


def test_constant_tables_stay(target, controller, names):
    entry = names.entry("I.fixed", {"h.test.a": 9}, "I.drop", priority=1)
    refused = UNKNOWN if differs(target, "constant-table") else DENIED
    assert codes(lambda: controller.write(insert(entry))) == [refused]
    assert len(controller.read(entries(names, "I.fixed"))) == 3


def test_a_batch_that_rolls_back_leaves_no_trace(target, controller, names):
    old = route(names, 0x0A000000, 8, 2)
    controller.write(insert(old))
    updates = [
        modify(route(names, 0x0A000000, 8, 3)),
        insert(route(names, 0x0B000000, 8)),
        insert(clone_session(9, CPU)),
        insert(route(names, 0x0B000000, 8)),
        insert(route(names, 0x0C000000, 8)),
    ]
    if differs(target, "atomicity"):
        assert status_of(lambda: controller.write(*updates, atomicity="ROLLBACK_ON_ERROR")) == UNIMPLEMENTED
        return
    for atomicity in ("ROLLBACK_ON_ERROR", "DATAPLANE_ATOMIC"):
        got = codes(lambda kind=atomicity: controller.write(*updates, atomicity=kind))
        assert got == [ABORTED, ABORTED, ABORTED, EXISTS, ABORTED]
        assert controller.read(entries(names, "I.route")) == [old]
        assert controller.read(clone_session(0)) == []


# -- counters, meters, registers ----------------------------------------------------------------------


def _counter(names, name, index):
    entity = p4runtime.Entity()
    counter = next(c for c in names.info.counters if c.preamble.name == name)
    entity.counter_entry.counter_id = counter.preamble.id
    if index is not None:
        entity.counter_entry.index.SetInParent()
        entity.counter_entry.index.index = index
    return entity


def counted(controller, names, port, frames):
    """Wait until so many frames of a port were seen; their counter."""
    deadline = time.monotonic() + TIMEOUT_S
    while True:
        data = controller.read(_counter(names, "I.seen", port))[0].counter_entry.data
        if data.packet_count == frames:
            return data
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_direct_counters_count_and_can_be_reset(target, controller, names):
    asked = route(names, 0x0A000000, 8)
    controller.write(insert(asked))
    sent = ip_frame(0x0A000005)
    target.inject(1, sent, sent)
    assert len(target.sent(2, 2)) == 2
    read = p4runtime.Entity()
    read.direct_counter_entry.table_entry.CopyFrom(
        names.entry("I.route", {"h.ip.dst": (0x0A000000, 8)}).table_entry
    )
    data = controller.read(read)[0].direct_counter_entry.data
    assert (data.packet_count, data.byte_count) == (2, 2 * len(sent))
    asked.table_entry.counter_data.SetInParent()
    assert controller.read(asked)[0].table_entry.counter_data.packet_count == 2
    read.direct_counter_entry.data.packet_count = 0
    controller.write(modify(read))
    assert controller.read(asked)[0].table_entry.counter_data.packet_count == 0


def test_indirect_counters_by_cell_array_and_all(target, controller, names):
    sent = frame()
    target.inject(3, sent)
    assert counted(controller, names, 3, 1).byte_count == len(sent)
    assert len(controller.read(_counter(names, "I.seen", None))) == 16
    written = _counter(names, "I.seen", 5)
    written.counter_entry.data.packet_count, written.counter_entry.data.byte_count = 7, 70
    controller.write(modify(written))
    assert controller.read(_counter(names, "I.seen", 5)) == [written]
    assert codes(lambda: controller.write(insert(written))) == [INVALID]


@pytest.mark.parametrize(("index", "code"), [(-1, INVALID), (16, RANGE)])
def test_cells_outside_the_array_are_refused(target, controller, names, index, code):
    entity = _counter(names, "I.seen", index)
    entity.counter_entry.data.packet_count = 1
    got = codes(lambda: controller.write(modify(entity)))
    assert got == [code] or differs(target, "cell-index")


def _meter(names, index, *config):
    entity = p4runtime.Entity()
    entity.meter_entry.meter_id = names.info.meters[0].preamble.id
    entity.meter_entry.index.SetInParent()
    entity.meter_entry.index.index = index
    if config:
        meter = entity.meter_entry.config
        meter.cir, meter.cburst, meter.pir, meter.pburst = config
    return entity


def test_meters_colour_packets(target, controller, names):
    forward(names, controller)
    bursts = _meter(names, 2, 0, 1, 0, 2)  # no rates: BMv2's clock is the wall's, and frames may come late
    controller.write(modify(bursts))
    assert controller.read(_meter(names, 2)) == [bursts]
    target.inject(1, *[frame(5, a=2)] * 4)
    assert [sent[16] for sent in target.sent(2, 4)] == [0, 1, 2, 2]
    controller.write(modify(_meter(names, 2)))
    target.inject(1, *[frame(5, a=2)] * 4)
    assert [sent[16] for sent in target.sent(2, 4)] == [0] * 4


def test_registers_are_read_and_written(target, controller, names):
    entity = p4runtime.Entity()
    entity.register_entry.register_id = next(
        r for r in names.info.registers if r.preamble.name == "I.cells"
    ).preamble.id
    entity.register_entry.index.index = 3
    entity.register_entry.data.bitstring = text(0xDEADBEEF01)
    if differs(target, "registers"):
        assert codes(lambda: controller.write(modify(entity))) == [UNIMPLEMENTED]
        return
    controller.write(modify(entity))
    assert controller.read(entity) == [entity]
    forward(names, controller)
    target.inject(1, frame(3, a=3, d=2))
    assert target.sent(2, 1)[0][23:31] == (0xDEADBEEF01).to_bytes(8, "big")
    assert controller.read(entity)[0].register_entry.data.bitstring == text(0xDEADBEEF03)


# -- replication --------------------------------------------------------------------------------------


def _group(number, *replicas):
    entity = p4runtime.Entity()
    group = entity.packet_replication_engine_entry.multicast_group_entry
    group.multicast_group_id = number
    for port, instance in replicas:
        group.replicas.add(egress_port=port, instance=instance)
    return entity


def test_groups_and_sessions_are_entities(target, controller):
    group, session = _group(7, (2, 1), (3, 2)), clone_session(5, CPU)
    controller.write(insert(group), insert(session))
    found = controller.read(_group(0))[0].packet_replication_engine_entry.multicast_group_entry
    assert sorted((r.egress_port, r.instance) for r in found.replicas) == [(2, 1), (3, 2)]
    assert controller.read(clone_session(0)) == [session]
    assert codes(lambda: controller.write(insert(group), insert(session))) == [EXISTS, EXISTS]
    controller.write(modify(_group(7, (2, 1))))
    assert controller.read(_group(7)) == [_group(7, (2, 1))]
    controller.write(delete(_group(7)), delete(clone_session(5)))
    got = codes(lambda: controller.write(delete(_group(7)), delete(clone_session(5))))
    assert got == [NOT_FOUND, NOT_FOUND]
    assert codes(lambda: controller.write(insert(_group(0)), insert(clone_session(0)))) == [INVALID, INVALID]
    assert codes(lambda: controller.write(insert(_group(8, (2, 1), (2, 1))))) == [INVALID]


def test_a_group_floods_its_ports(target, controller, names):
    controller.write(insert(_group(7, (2, 1), (3, 2))))
    controller.write(insert(names.entry("I.ports", {"sm.ingress_port": 1}, "I.flood", [7])))
    target.inject(1, frame(77))
    two, three = target.sent(2, 1)[0], target.sent(3, 1)[0]
    # the program writes instance type and replica number into `result`
    assert (two[31:33], three[31:33]) == (b"\x05\x01", b"\x05\x02")


# -- stream -------------------------------------------------------------------------------------------


def test_a_clone_reaches_the_controller(target, controller, names):
    controller.write(insert(clone_session(5, CPU)))
    forward(names, controller)
    target.inject(1, frame(1, d=0x1234))
    packet = controller.packets.get(timeout=TIMEOUT_S)
    assert len(target.sent(2, 1)) == 1
    # the program sets no packet_in header here: the frame's first two bytes are taken for one
    assert packet.payload[:12] == frame()[2:14]
    assert len(packet.payload) == 58


def test_a_punted_frame_carries_the_packet_in_header(target, controller, names):
    target.inject(3, frame(15))
    packet = controller.packets.get(timeout=TIMEOUT_S)
    assert {m.metadata_id: m.value for m in packet.metadata} == {1: b"\x03", 2: b"\x03"}
    assert packet.payload[:23] == frame(15)[:23]


def test_packets_out_leave_by_the_port_they_name(target, controller):
    controller.packet_out(frame(0), {1: b"\x03", 2: b"\x00"})
    assert target.sent(3, 1) == [frame(0)]


@pytest.mark.parametrize(
    "metadata", [{1: b"\x03"}, {1: b"\x03", 2: b"\0", 9: b"\0"}, {1: b"\x04\x00", 2: b"\0"}]
)
def test_packets_out_with_wrong_metadata_are_answered(target, controller, metadata):
    controller.packet_out(frame(0), metadata)
    if not differs(target, "stream-errors"):
        error = controller.others.get(timeout=TIMEOUT_S)
        assert error.canonical_code == INVALID
        assert error.HasField("packet_out")
    assert target.quiet(3) or (differs(target, "packet-out-metadata") and 2 not in metadata)


def test_a_backup_must_not_send_packets(target, connect, controller):
    backup = connect(election_id=None)
    backup.arbitrate()
    backup.packet_out(frame(0), {1: b"\x03", 2: b"\x00"})
    if not differs(target, "stream-errors"):
        assert backup.others.get(timeout=TIMEOUT_S).canonical_code == DENIED
    assert target.quiet(3)


def _digest(names, name, *config):
    entity = p4runtime.Entity()
    entity.digest_entry.digest_id = next(d for d in names.info.digests if d.preamble.name == name).preamble.id
    if config:
        settings = entity.digest_entry.config
        settings.max_timeout_ns, settings.max_list_size, settings.ack_timeout_ns = config
    return entity


def _acknowledge(digest_id, list_id):
    request = p4runtime.StreamMessageRequest()
    request.digest_ack.digest_id, request.digest_ack.list_id = digest_id, list_id
    return request


def _members(digest):
    return [[member.bitstring for member in data.struct.members] for data in digest.data]


def test_digests_need_a_configuration(target, controller, names):
    digest = _digest(names, "note_t", 10**7, 10, 10**9)
    if not differs(target, "digest-lists"):
        target.inject(2, frame(11, d=1))
        counted(controller, names, 2, 1)
    controller.write(insert(digest))
    assert controller.read(digest) == [digest]
    target.inject(2, frame(11, d=2))
    found = controller.digests.get(timeout=TIMEOUT_S)
    assert found.digest_id == digest.digest_entry.digest_id
    assert _members(found) == [[b"\x02", bytes(range(6, 12)), b"\x02"]]
    controller.write(delete(digest))
    assert codes(lambda: controller.write(modify(digest))) == [NOT_FOUND]


def test_a_full_list_is_sent_at_once_and_unacknowledged_samples_stay_away(target, controller, names):
    controller.write(insert(_digest(names, "note_t", 10**12, 2, 10**12)))
    target.inject(2, frame(11, d=1), frame(11, d=1), frame(11, d=2))
    first = controller.digests.get(timeout=TIMEOUT_S)
    assert [members[2] for members in _members(first)] == [b"\x01", b"\x02"]
    if differs(target, "digest-lists"):
        return
    target.inject(2, frame(11, d=1), frame(11, d=3), frame(11, d=4))
    second = controller.digests.get(timeout=TIMEOUT_S)
    assert [members[2] for members in _members(second)] == [b"\x03", b"\x04"]
    controller.send(_acknowledge(first.digest_id, first.list_id))
    # an answer to something sent later shows that the acknowledgement was taken
    controller.send(_acknowledge(99, 1))
    controller.others.get(timeout=TIMEOUT_S)
    target.inject(2, frame(11, d=1), frame(11, d=3), frame(11, d=5))
    third = controller.digests.get(timeout=TIMEOUT_S)
    assert [members[2] for members in _members(third)] == [b"\x01", b"\x05"]


def test_a_digest_ack_without_digest_is_answered(target, controller):
    controller.send(_acknowledge(99, 1))
    if differs(target, "stream-errors"):
        return
    error = controller.others.get(timeout=TIMEOUT_S)
    assert (error.canonical_code, error.HasField("digest_list_ack")) == (INVALID, True)


def test_idle_entries_are_reported_until_deleted(target, controller, names):
    entry = route(names, 0x0A000000, 8, idle_timeout_ns=3 * 10**8)
    controller.write(insert(entry), insert(route(names, 0x0B000000, 8)))
    for _ in range(2):
        found = controller.others.get(timeout=TIMEOUT_S)
        assert [e.match for e in found.table_entry] == [entry.table_entry.match]
        assert found.table_entry[0].idle_timeout_ns == 3 * 10**8
    controller.write(delete(entry))
    asked = route(names, 0x0B000000, 8)
    asked.table_entry.time_since_last_hit.SetInParent()
    age = controller.read(asked)[0].table_entry.time_since_last_hit.elapsed_ns
    assert age > 0 or differs(target, "hit-age")


def test_capabilities(target, bare):
    answer = bare.stub.Capabilities(p4runtime.CapabilitiesRequest(device_id=1), timeout=TIMEOUT_S)
    assert answer.p4runtime_api_version.startswith("1.")


# -- packets ------------------------------------------------------------------------------------------


def test_a_write_that_returned_holds_for_the_next_frame(target, controller, names):
    entry = route(names, 0x0A000000, 8)
    for port in (2, 3, 2, 3):
        entry = route(names, 0x0A000000, 8, port)
        controller.write(insert(entry) if port == 2 else modify(entry))
        target.inject(1, ip_frame(0x0A000001))
        assert len(target.sent(port, 1)) == 1
        if port == 3:
            controller.write(delete(entry))
