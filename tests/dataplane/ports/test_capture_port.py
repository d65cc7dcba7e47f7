"""A capture port loses nothing, keeps order, pads cut frames and answers every frame."""

import contextlib
import select
import threading

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataplane.ports.capture_port import (
    MAX_TIME_US,
    BlockReader,
    CaptureFeed,
    CapturePort,
    CapturePortError,
    pack_block,
)
from dataplane.ports.port import PortError

FRAMES = st.lists(st.tuples(st.integers(0, 1 << 48), st.binary(max_size=80), st.integers(0, 20)), max_size=30)


@given(FRAMES, st.lists(st.integers(1, 60), min_size=1), st.integers(1, 7))
def test_blocks_survive_any_cutting_into_pieces(frames, cuts, limit):
    times = [time for time, _, _ in frames]
    wire = [len(data) + more for _, data, more in frames]
    sent = pack_block(times, wire, [data for _, data, _ in frames]) * 2
    reader, got, position, turn = BlockReader(), [], 0, 0
    while position < len(sent) or reader.waiting():
        step = cuts[turn % len(cuts)]
        reader.feed(sent[position : position + step])
        position, turn = position + step, turn + 1
        arrived = reader.take(limit)
        got += zip(arrived.times_us.tolist(), arrived.frames(), strict=True)
    assert got == [(time, data + bytes(more)) for time, data, more in frames] * 2
    assert reader.unfinished() == 0


@pytest.mark.parametrize("data", [b"GET / HTTP/1.1\r\n\r\n", b"SDNF" + b"\xff" * 8])
def test_what_is_no_block_is_refused(data):
    with pytest.raises(CapturePortError):
        BlockReader().feed(data)


def test_lengths_that_do_not_add_up_are_refused():
    block = bytearray(pack_block([1], [3], [b"abc"]))
    block[12 + 12] = 2
    with pytest.raises(CapturePortError, match="add up"):
        BlockReader().feed(bytes(block))


@pytest.mark.parametrize("time_us", [-1, MAX_TIME_US + 1])
def test_times_that_the_switch_s_clock_does_not_have_are_refused(time_us):
    """The clock goes into every entry that is written afterwards."""
    reader = BlockReader()
    reader.feed(pack_block([0, MAX_TIME_US], [1, 1], [b"a", b"b"]))
    with pytest.raises(CapturePortError, match="clock"):
        reader.feed(pack_block([5, time_us], [1, 1], [b"a", b"b"]))


@pytest.mark.parametrize("wire", [[1 << 32 - 1], [1 << 18] * 2000])
def test_a_length_on_the_wire_is_not_made_of_nothing(wire):
    """Twenty bytes asked for four gigabytes of padding."""
    with pytest.raises(CapturePortError, match="on the wire"):
        BlockReader().feed(pack_block([0] * len(wire), wire, [b""] * len(wire)))


@settings(deadline=None)
@given(st.data())
def test_blocks_with_bytes_exchanged_are_read_or_refused(data):
    block = bytearray(pack_block([1, 2], [3, 60], [b"abc", bytes(60)]))
    for _ in range(data.draw(st.integers(1, 4))):
        block[data.draw(st.integers(0, len(block) - 1))] = data.draw(st.integers(0, 255))
    reader = BlockReader()
    with contextlib.suppress(CapturePortError):
        reader.feed(bytes(block) * 2)
    assert reader.waiting() <= 4


def wait(port):
    if not port.waiting():
        select.select([port], [], [], 60)


def drain(port, count):
    """Receive so many frames, as the packet loop does, and answer all of them."""
    frames = []
    while len(frames) < count:
        wait(port)
        arrived = port.receive(7)
        if len(arrived):
            frames += arrived.block.frames()
            port.done(bytes([3]) * len(arrived))
    return frames


def answer(port, stop):
    while not stop.is_set():
        if port.unsent():
            select.select([], [port], [], 0.1)
            port.flush()
        stop.wait(0.001)


def test_frames_go_in_and_verdicts_come_back(tmp_path):
    port = CapturePort(str(tmp_path / "s"))
    frames = [bytes([n % 256]) * 60 for n in range(3000)]
    with contextlib.closing(port), CaptureFeed(str(tmp_path / "s")) as feed:
        sender = threading.Thread(target=feed.send, args=(range(3000), [64] * 3000, frames))
        sender.start()
        assert drain(port, 3000) == [frame + bytes(4) for frame in frames]
        sender.join(60)
        stop = threading.Event()
        answering = threading.Thread(target=answer, args=(port, stop))
        answering.start()
        verdicts = b""
        while len(verdicts) < 3000:
            select.select([feed], [], [], 60)
            verdicts += feed.verdicts()
        stop.set()
        answering.join(60)
        assert verdicts == b"\x03" * 3000
    assert not (tmp_path / "s").exists()


def test_a_feeder_that_leaves_is_followed_by_the_next_and_its_frames_are_processed(tmp_path):
    with contextlib.closing(CapturePort(str(tmp_path / "s"))) as port:
        for turn in b"ab":
            with CaptureFeed(str(tmp_path / "s")) as feed:
                feed.send([1, 2], [1, 1], [bytes([turn])] * 2)
            assert drain(port, 2) == [bytes([turn])] * 2
            # the end of file, then the listener again
            wait(port)
            port.receive(1)


def test_a_feeder_that_speaks_something_else_is_hung_up_on(tmp_path):
    with (
        contextlib.closing(CapturePort(str(tmp_path / "s"))) as port,
        CaptureFeed(str(tmp_path / "s")) as feed,
    ):
        feed._socket.send(b"GET / HTTP/1.1\r\n")
        while not select.select([feed], [], [], 0)[0]:
            wait(port)
            port.receive(1)
        with pytest.raises(CapturePortError, match="closed"):
            feed.verdicts()


def test_a_socket_in_use_is_an_error_and_a_stale_one_is_replaced(tmp_path):
    path = tmp_path / "s"
    port = CapturePort(str(path))
    with pytest.raises(PortError, match="in use"):
        CapturePort(str(path))
    port._listener.close()
    again = CapturePort(str(path))
    again.close()


def test_nobody_there_is_said_plainly(tmp_path):
    with pytest.raises(CapturePortError, match="is the switch running"):
        CaptureFeed(str(tmp_path / "none"))


def test_a_folder_that_does_not_exist_is_said_plainly(tmp_path):
    with pytest.raises(PortError, match="writable folder"):
        CapturePort(str(tmp_path / "none" / "s"))


def test_a_switch_that_stops_reading_is_an_error_not_a_wait_for_ever(tmp_path):
    """A replay whose switch hangs ends with a reason."""
    path = str(tmp_path / "s")
    with contextlib.closing(CapturePort(path)), CaptureFeed(path, patience_s=0.05) as feed:
        frames = [bytes(60_000)] * 400
        with pytest.raises(CapturePortError, match="has read nothing"):
            feed.send([0] * len(frames), [60_000] * len(frames), frames)
