"""Apps' frames leave through the switch; what its counting stages have counted is told to who asks."""

import socket
from contextlib import ExitStack, contextmanager

import numpy as np
import pytest

from apps.messages import MessageError, TableCommand, TableUpdate
from apps.p4runtime_ctrl.arrivals import frames_in, questions_in
from apps.p4runtime_ctrl.errors import EntryError
from apps.p4runtime_ctrl.southbound.packet_out import PacketOuts, question_of
from due import Capability, Item, RecordBatch
from sdnator.capture.interfaces import VethPair
from sdnator.testing.controller_run import BASE_US, ControllerRun, Heard, frame
from sdnator.testing.product_program import program, without
from sdnator.testing.switch_target import KINDS
from sdnator.testing.waiting import wait_for
from tests.requirements import optional_program, require_netns

BIT = 3
WINDOW_US = 3_600_000_000
_EVERY = 3  # ETH_P_ALL
FRAMES = "network.packet_out.firewall.s1"
REQUEST = "network.cell_request.sonata_adapter.s1"
CAPABILITIES = tuple(
    Capability(f"network.{kind}.*", delivery="reliable", archive="always")
    for kind in ("cell_request.sonata_adapter", "p4_command.sonata_adapter", "telemetry.sonata")
)
STATE = "network.switch.p4runtime_ctrl.s1"


def counting(kind="count", stage=0, bit=BIT):
    """UDP frames by their source address, in windows of an hour; a difference tells of sources with two or more."""
    table = program().table(f"ingress.count_{stage}.queries")
    given = {
        "query": bit,
        "bit_of_query": hex(1 << bit),
        "source_mask": hex((1 << 128) - 1),
        "reciprocal": hex((1 << 64) // WINDOW_US),
        "size": 1024,
        "count_of": bit,
        "generation": 1,
        "threshold": (1 << 31) + 2 if kind == "difference" else 0,
    }
    action = next(action for action in table.actions if action.name.endswith(f".{kind}"))
    params = {param.name: given.get(param.name, 0) for param in action.params}
    match = {"query_map": [hex(1 << bit), hex(1 << bit)]}
    return TableUpdate(
        kind="insert", table=table.name, match=match, action=action.name, params=params, priority=1
    )


@contextmanager
def wired(kind, folder):
    """A stage and a function that sends frames into its switch."""
    if kind == "embedded":
        with ControllerRun(folder) as stage:
            feed = stage.feed()
            yield stage, lambda frames: feed.send([1000] * len(frames), [60] * len(frames), frames)
            feed.close()
        return
    optional_program("simple_switch_grpc")
    with cabled(kind, folder) as (stage, wire):
        yield stage, lambda frames: [wire.send(each) for each in frames]


@contextmanager
def cabled(kind, folder):
    """A stage whose switch has one end of a cable, and a socket at the other."""
    require_netns()
    with ExitStack() as held:
        cable = VethPair.make(held, "out")
        stage = held.enter_context(ControllerRun(folder, kind=kind, veth=cable.far, forward={}))
        # protocol 0 until it is bound, or frames of all interfaces would wait in it
        wire = held.enter_context(socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0))
        wire.bind((cable.near, _EVERY))
        wire.settimeout(90)
        yield stage, wire


def request(numbers, sources, time_us=BASE_US + 5_000_000):
    zeros = np.zeros(len(numbers), dtype=np.uint64)
    return RecordBatch(
        {
            "id": np.array(numbers, dtype=np.uint64),
            "query": np.full(len(numbers), BIT, dtype=np.uint8),
            "src_hi": zeros,
            "src_lo": np.array([0x0A000000 + source for source in sources], dtype=np.uint64),
            "dst_hi": zeros,
            "dst_lo": zeros,
            "port": zeros.astype(np.uint16),
            "length": zeros.astype(np.uint16),
            "time_us": np.full(len(numbers), time_us, dtype=np.int64),
        }
    )


def asked_for(stage):
    """An app whose query is installed and under way, and what it hears."""
    engine = stage.engine("sonata_adapter", capabilities=CAPABILITIES)
    heard = Heard(
        engine, "network.cell.p4runtime_ctrl.*", "network.confirmation.p4runtime_ctrl.*",
        f"network.packets.p4runtime_ctrl.s1.q{BIT}", f"network.counts.p4runtime_ctrl.s1.q{BIT}", STATE,
    )  # fmt: skip
    # the state was asked for last: when it comes, the controller knows that all the others are wanted
    wait_for(lambda: any(value["primary"] for value in heard.values("network.switch")), 90, why=stage.log)
    wanted = ("network.p4_command.sonata_adapter.s1", f"network.telemetry.sonata.q{BIT}", REQUEST)
    wait_for(lambda: all(map(engine.wanted, wanted)), 90, why=stage.log)
    command = TableCommand(id="c1", updates=(counting(), counting("difference", stage=1)))
    engine.write("network.p4_command.sonata_adapter.s1", command.to_value())
    offer = {"name": f"q{BIT}", "bit": BIT, "conditions": {"protocol": 17}}
    engine.write(f"network.telemetry.sonata.q{BIT}", offer)
    engine.flush()
    wait_for(lambda: heard.values("confirmation"), 90, why=stage.log)
    assert {value["state"] for value in heard.values("confirmation")} == {"installed"}
    wait_for(lambda: any(v["telemetry"] for v in heard.values("network.switch")), 90, why=stage.log)
    assert heard.values("network.switch")[-1]["base_us"] == BASE_US
    return engine, heard


def answers(heard):
    """The counts that questions brought back, by their numbers."""
    found = {}
    for batch in heard.values("network.cell"):
        found |= dict(zip(batch["id"].tolist(), batch["count"].tolist(), strict=True))
    return found


def counted(heard):
    """Window, count and host of what the switch reported."""
    batches = heard.values("network.counts")
    rows = [zip(each["window"], each["count"], each["src_lo"], strict=True) for each in batches]
    return sorted(
        (int(window), int(count), int(host) - 0x0A000000) for row in rows for window, count, host in row
    )


@pytest.mark.parametrize("kind", KINDS)
def test_cells_are_read_and_swept_in_band(kind, tmp_path):
    with wired(kind, tmp_path) as (stage, send):
        stage.controller()
        engine, heard = asked_for(stage)
        send([frame(1 + number % 3) for number in range(8)])
        wait_for(lambda: sum(map(len, heard.values("network.packets"))) == 8, 60, why=stage.log)
        engine.write(REQUEST, request([7, 1 << 40, 9, 11], [1, 2, 3, 4]))
        wait_for(lambda: len(answers(heard)) == 4, 60, why=stage.log)
        # the key has a cell in two stages: the later one answers, and its differences begin at 2^31
        found = {number: count - (1 << 31) for number, count in answers(heard).items()}
        assert found == {7: 3, 1 << 40: 3, 9: 2, 11: 0}
        later = BASE_US + 2 * WINDOW_US
        engine.write(REQUEST, sweep_request([2, 2, 2, 1], [0, later, later, later]))
        wait_for(lambda: len(counted(heard)) == 3, 60, why=stage.log)
        assert counted(heard) == [(0, 2, 3), (0, 3, 1), (0, 3, 2)]
        wait_for(lambda: {0, 1, 2} <= answers(heard).keys(), 60, why=stage.log)
        # nobody waits behind the last one, so the last question is not answered
        assert [answers(heard).get(number) for number in range(4)] == [0, 1, 1, None]
        engine.write(REQUEST, request([12], [1], time_us=5))
        wait_for(
            lambda: heard.values("network.switch")[-1]["packet_outs_refused"] == 1,
            60,
            why=lambda: heard.values("network.switch")[-1],
        )
        state = heard.values("network.switch")[-1]
        assert (state["cells_asked"], state["cells_answered"], state["lost"]) == (8, 7, 0)
        assert state["counts_reported"] == 3


@pytest.mark.parametrize("kind", KINDS)
def test_frames_leave_through_their_port(kind, tmp_path):
    if kind == "bmv2":
        optional_program("simple_switch_grpc")
    with cabled(kind, tmp_path) as (stage, wire):
        out = Capability("network.packet_out.firewall.*", delivery="reliable")
        engine = stage.engine(capabilities=(out,))
        heard = Heard(engine, STATE)  # before the controller comes: it tells its state when that changes
        stage.controller()
        frames = [frame(1), frame(2) + b"y" * 40, frame(3)]
        value = {
            "port": np.ones(3, dtype=np.uint16),
            "length": np.array([len(each) for each in frames], dtype=np.uint16),
            "frames": b"".join(frames),
        }
        wait_for(
            lambda: heard.values("network.switch")[-1:] and heard.values("network.switch")[-1]["primary"]
        )
        wait_for(lambda: engine.wanted(FRAMES), 90, why=stage.log)
        engine.write(FRAMES, {**value, "frames": b"short"})
        engine.write(FRAMES, value)
        engine.flush()
        got = []
        while len(got) < 3:
            data, address = wire.recvfrom(2000)
            got += [data] if address[2] != socket.PACKET_OUTGOING else []
        assert got == frames
        wait_for(lambda: heard.values("network.switch")[-1]["frames_sent"] == 3, 60, why=stage.log)
        assert "3 lengths of 220 bytes in all, 5 bytes of frames" in stage.log()


OUTS = PacketOuts(program(), BASE_US)


def sent(key, value):
    return Item(key, value, 1, 1, key.split(".")[2], "i", 1)


def asked(batch):
    return questions_in(sent(REQUEST, batch))


def header_of(packet):
    by_id = {field.id: field.name for field in program().headers["packet_out"]}
    return {by_id[item.metadata_id]: int.from_bytes(item.value, "big") for item in packet.metadata}


def test_a_question_carries_its_key_and_its_number():
    batch = {**request([77], [1]), "dst_hi": np.array([1], np.uint64), "port": np.array([53], np.uint16)}
    (packet,), refused = OUTS.questions(asked(RecordBatch(batch)))
    header = header_of(packet)
    assert refused == 0
    assert question_of(packet.payload) == 77
    assert (header["operation"], header["query"], header["key_port"]) == (1, BIT, 53)
    assert (header["key_source"], header["key_destination"]) == (0x0A000001, 1 << 64)
    assert header["timestamp"] == 5_000_000
    assert question_of(b"short") is None


def sweep_request(kinds, times_us):
    batch = request(range(len(kinds)), [0] * len(kinds))
    columns = {name: batch[name] for name in batch.columns}
    length = np.full(len(kinds), 60, dtype=np.uint16)
    times = np.array(times_us, dtype=np.int64)
    return RecordBatch({**columns, "length": length, "time_us": times, "sweep": np.array(kinds, np.uint8)})


def test_a_sweep_is_asked_for_in_the_place_of_a_cell():
    times = [BASE_US, 0, BASE_US, BASE_US + 7, 0, BASE_US - 1]
    packets, refused = OUTS.questions(asked(sweep_request([0, 1, 1, 2, 2, 1], times)))
    found = [header_of(packet) for packet in packets]
    assert [header["operation"] for header in found] == [1, 2, 2, 2, 2]
    assert [header["key_length"] for header in found] == [60, 0, 0, 1, 1]
    assert [header["timestamp"] for header in found] == [0, 0, 1, 7, 0], "0 is now for a sweep"
    assert [question_of(packet.payload) for packet in packets] == [0, 1, 2, 3, 4]
    assert refused == 1


def test_sweeps_that_cannot_be_are_counted():
    assert OUTS.questions(asked(sweep_request([3, 1], [0, 0])))[1] == 1
    assert PacketOuts(without("count_digest_t"), BASE_US).questions(asked(sweep_request([2], [0]))) == ([], 1)


@pytest.mark.parametrize("time_us", [BASE_US - 1, BASE_US + (1 << 48)])
def test_times_outside_the_switch_clock_are_counted(time_us):
    assert OUTS.questions(asked(request([1, 2], [1, 2], time_us=time_us))) == ([], 2)


@pytest.mark.parametrize(
    "value",
    [
        None,
        {"port": [1], "length": [60]},
        {"port": [1, 2], "length": [1], "frames": b"x"},
        {"port": [1], "length": [2], "frames": b"x"},
        {"port": [1], "length": [0], "frames": b""},
        {"port": [512], "length": [1], "frames": b"x"},
    ],
)
def test_frames_of_another_shape_are_refused(value):
    with pytest.raises((EntryError, MessageError), match="packet_out"):
        OUTS.frames(frames_in(sent(FRAMES, value)))


@pytest.mark.parametrize(
    "value", [None, {"id": [1]}, RecordBatch({"id": [1]}), np.ones(3), {**request([1], [1])}]
)
def test_questions_of_another_shape_are_refused(value):
    with pytest.raises(MessageError, match="cell_request"):
        questions_in(sent(REQUEST, value))
