"""A switch that sends what is no message of its program: counted, and the connection goes on."""

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from apps.p4runtime_ctrl.southbound.digest_in import DigestReader
from apps.p4runtime_ctrl.southbound.loss_tracker import LossTracker
from apps.p4runtime_ctrl.southbound.packet_in import PacketReader
from apps.p4runtime_ctrl.southbound.values import canonical
from p4rt import p4runtime
from sdnator.testing.product_program import packet_in, program
from tests.apps.p4runtime_ctrl.test_hostile import controller, still_works

KNOWN = [digest.preamble.id for digest in program().message.digests]
BAD_VALUES = (b"", b"\0" * 50, b"\xff" * 9, b"\xff" * 40, b"\x01" + b"\0" * 7)


def bad_packets():
    """Packet-ins with fields missing, too many, too long or unknown, and frames of no or of too many bytes."""
    short = packet_in(1)
    del short.metadata[2:]
    yield short
    for field in range(len(packet_in(1).metadata)):
        for value in BAD_VALUES[2:4]:
            wrong = packet_in(1)
            wrong.metadata[field].value = value
            yield wrong
    unknown = packet_in(1)
    unknown.metadata[0].metadata_id = 99
    yield from (unknown, p4runtime.PacketIn(), p4runtime.PacketIn(payload=b"x" * 100_000))
    yield packet_in(1, timestamp=(1 << 48) + 1)
    yield packet_in(1, frame=b"y" * 70_000)


def bad_digests():
    """Lists of unknown digests, and of known ones with other members."""
    for digest_id in (*KNOWN, 0, 77, 2**32 - 1):
        for members in (0, 1, 5, 100):
            for value in BAD_VALUES:
                found = p4runtime.DigestList(digest_id=digest_id, list_id=2**64 - 1)
                data = found.data.add().struct
                for _ in range(members):
                    data.members.add(bitstring=value)
                found.data.add(bitstring=value)
                found.data.add()
                yield found


def odd_messages():
    """Messages of the other kinds, and of none."""
    entry = p4runtime.TableEntry(table_id=1)
    entry.match.add(field_id=3)
    note = p4runtime.IdleTimeoutNotification(table_entry=[entry])
    yield p4runtime.StreamMessageResponse(idle_timeout_notification=note)
    yield p4runtime.StreamMessageResponse(
        idle_timeout_notification=p4runtime.IdleTimeoutNotification(
            table_entry=[p4runtime.TableEntry(table_id=2**32 - 1), p4runtime.TableEntry()]
        )
    )
    yield p4runtime.StreamMessageResponse()
    yield p4runtime.StreamMessageResponse(error=p4runtime.StreamError(canonical_code=-5, message="\n" * 1000))


@pytest.mark.parametrize("telemetry", ["packet-in", "digest"])
def test_malformed_messages_are_counted_and_the_connection_goes_on(telemetry):
    """No thread ends, the stream stays the same one, and genuine packets are counted behind all that."""
    with controller(telemetry=telemetry, learn={"ports": (1, 2)}) as (engine, service, switch):
        out = switch.primary().outgoing.put
        for packet in bad_packets():
            out(p4runtime.StreamMessageResponse(packet=packet))
        for digest in bad_digests():
            out(p4runtime.StreamMessageResponse(digest=digest))
        for message in odd_messages():
            out(message)
        out(p4runtime.StreamMessageResponse(packet=packet_in(5)))

        def state():
            return service.health()["switches"][0]

        engine.until(lambda: state()["packet_in"] >= 1)
        still_works(engine, service, 7)
        engine.until(lambda: state()["malformed"] > 60 and state()["learn_malformed"] > 0)
        assert state()["primary"]
        assert sum("primary" in value["change"] for value in engine.values("network.switch")) >= 1
        assert not any("lost:" in value["change"] for value in engine.values("network.switch"))


@settings(max_examples=100, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.lists(st.lists(st.tuples(st.integers(0, 20), st.binary(max_size=40)), max_size=12), max_size=6))
def test_any_metadata_and_members_are_read_or_counted(rows):
    """Every message is either a record or counted as malformed."""
    packets = [
        p4runtime.PacketIn(metadata=[p4runtime.PacketMetadata(metadata_id=i, value=v) for i, v in row])
        for row in rows
    ]
    progress = LossTracker()
    found = PacketReader(program(), 0, progress).read([*packets, packet_in(1)])
    cells = 0 if found.cells is None else len(found.cells)
    assert len(found) + cells + progress.malformed >= len(rows)
    lists = p4runtime.DigestList()
    for row in rows:
        members = lists.data.add().struct.members
        for _, value in row:
            members.add(bitstring=value)
    progress = LossTracker()
    reports = DigestReader(program(), 0, progress).read([lists])
    assert len(reports) + progress.malformed == len(rows)


def test_one_report_from_the_future_does_not_move_the_clock():
    """The capture time of decisions and of idle entries follows it."""
    progress = LossTracker()
    reader = PacketReader(program(), 0, progress)
    hour = 3_600_000_000
    reader.read([packet_in(1, timestamp=hour)])
    reader.read([packet_in(2, timestamp=(1 << 48) - 1)])
    assert progress.time_us == hour
    reader.read([packet_in(3, timestamp=hour + 7)])
    assert (progress.time_us, progress.times_doubted) == (hour + 7, 1)


def test_a_highest_election_id_ends_no_thread():
    """Nobody can outbid the highest number there is; the controller asks with it, and goes on."""
    with controller() as (engine, service, switch):
        out = switch.primary().outgoing.put
        reply = p4runtime.StreamMessageResponse()
        reply.arbitration.election_id.CopyFrom(p4runtime.Uint128(high=2**64 - 1, low=2**64 - 1))
        reply.arbitration.status.code = 5
        out(reply)
        still_works(engine, service, 7)


def test_padding_and_canonical_values_are_still_read():
    """What real switches send differs in zeros only."""
    message = packet_in(1, port=3)
    for field in message.metadata:
        field.value = b"\0" * 40 + (field.value or canonical(0))
    assert PacketReader(program(), 0, LossTracker()).read([message]).port.tolist() == [3]


@pytest.mark.parametrize("size", [7, 50, 4000])
@pytest.mark.parametrize("name", ["ingress.smac", "ingress.block_src"])
def test_an_entry_with_too_wide_a_value_can_be_named(name, size):
    """What a switch says it holds is shown in answers and logs, whatever it is."""
    table = program().table(name)
    entry = p4runtime.TableEntry(table_id=table.id)
    for field in table.fields:
        entry.match.add(field_id=field.id).exact.value = b"\xff" * size
    assert name in program().describe(entry)
