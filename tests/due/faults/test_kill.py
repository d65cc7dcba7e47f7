"""kill -9 of the server, the producer or the consumer loses nothing of a reliable stream."""

import os
import signal
import subprocess
import sys
import time

import pytest

from due.drivers.embedded_redis import EmbeddedServer
from due.drivers.redis_wire import Wire
from tests.due.conftest import gone, wait_for
from tests.due.faults.conftest import ROOT


@pytest.mark.parametrize("durable", [False, True], ids=["volatile", "append_only"])
def test_killed_server(programs, tmp_path, durable):
    count = 200_000
    with EmbeddedServer(tmp_path / "u", durable=durable) as server:
        consumer = programs("consume", server.url, "reader", count, 0)
        consumer.wait_for("ready")
        producer = programs("produce", server.url, "reliable", count, 50)
        producer.wait_for("50000")
        server.kill()
        time.sleep(0.3)
        server.start()
        producer.wait_for("flushed")
        assert consumer.wait_for("gaps").startswith("gaps 0")
        assert consumer.numbers() == list(range(count))


def test_killed_consumer(programs, own_server):
    count = 20_000
    first = programs("consume", own_server.url, "reader", count, 0.1)
    first.wait_for("ready")
    producer = programs("produce", own_server.url, "reliable", count, 20)
    first.wait_for("3000 ")
    first.kill()
    seen = first.numbers()
    second = programs("consume", own_server.url, "reader", 10**9, 0)
    _until(lambda: set(seen) | set(second.numbers()) == set(range(count)))
    producer.wait_for("flushed")
    again = second.numbers()
    assert again == sorted(again), "order is kept after the take-over"


def test_reader_and_server_killed_together(programs, tmp_path):
    """What the dead reader had not done comes to the next one, though the server has forgotten both."""
    count = 20_000
    with EmbeddedServer(tmp_path / "u") as server:
        first = programs("consume", server.url, "reader", count, 0.1)
        first.wait_for("ready")
        producer = programs("produce", server.url, "reliable", count, 20)
        first.wait_for("3000 ")
        first.kill()
        server.kill()
        server.start()
        producer.wait_for("flushed")
        _until(lambda: _entries(server.url))
        second = programs("consume", server.url, "reader", 10**9, 0)
        second.wait_for("ready")
        producer.say()
        _until(lambda: set(first.numbers()) | set(second.numbers()) == set(range(count + 1)))
        again = second.numbers()
        assert again == sorted(again), "order is kept after the take-over"


def test_killed_producer(programs, own_server):
    consumer = programs("consume", own_server.url, "reader", 10**9, 0)
    consumer.wait_for("ready")
    producer = programs("produce", own_server.url, "reliable", 10_000, 20)
    producer.wait_for("flushed")
    producer.kill()
    _until(lambda: len(consumer.numbers()) >= 10_000)
    programs("produce", own_server.url, "reliable", 5_000, 20).wait_for("flushed")
    _until(lambda: len(consumer.numbers()) >= 15_000)
    assert consumer.numbers() == [*range(10_000), *range(5_000)]


def _entries(url: str) -> int:
    wire = Wire(url)
    entries = wire.call("XLEN", "due:stream:fault.stream")
    wire.close()
    return int(entries)


def _used_memory(url: str) -> int:
    wire = Wire(url)
    info = wire.call("INFO", "memory").decode()
    wire.close()
    return int(next(line for line in info.splitlines() if line.startswith("used_memory:")).split(":")[1])


def test_a_slow_consumer_holds_a_reliable_producer_back(programs, own_server):
    consumer = programs("consume", own_server.url, "reader", 30_000, 0.2)
    consumer.wait_for("ready")
    producer = programs("produce", own_server.url, "reliable", 30_000, 1000)
    peak = 0
    while not any(line.startswith("gaps") for line in consumer.lines()):
        peak = max(peak, _used_memory(own_server.url))
        time.sleep(0.1)
    assert consumer.wait_for("gaps").startswith("gaps 0")
    assert consumer.numbers() == list(range(30_000))
    producer.wait_for("flushed")
    assert peak < 48 << 20, "window and retained payloads, no more"


def test_a_slow_consumer_of_best_effort_data_is_told_of_gaps(programs, own_server):
    consumer = programs("consume", own_server.url, "reader", 10**9, 0.05)
    consumer.wait_for("ready")
    producer = programs("produce", own_server.url, "best_effort", 300_000, 1000)
    peak = 0
    while not any(line.startswith("flushed") for line in producer.lines()):
        peak = max(peak, _used_memory(own_server.url))
        time.sleep(0.05)
    assert peak < 160 << 20, (
        "what the server keeps for one subscriber (128 MB), and the messages on their way"
    )

    def hears_the_next() -> bool:
        producer.say()
        return consumer.numbers()[-1] >= 300_000

    # when it has caught up, the next message tells it what it missed
    _until(hears_the_next)
    _until(lambda: len(consumer.numbers()) + _missing(consumer) == consumer.numbers()[-1] + 1)
    heard = consumer.numbers()
    assert heard == sorted(heard)
    assert _missing(consumer) > 0


def _until(condition):
    deadline = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.1)


def _missing(consumer):
    return max((int(line.split()[1]) for line in consumer.lines() if line.startswith("missing")), default=0)


def test_the_server_dies_with_its_killed_parent(tmp_path):
    code = (
        "import sys, time\n"
        "from due.drivers.embedded_redis import EmbeddedServer\n"
        f"server = EmbeddedServer({str(tmp_path / 's')!r}).start()\n"
        "print(server.pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, cwd=ROOT)
    assert parent.stdout is not None
    with parent.stdout:
        pid = int(parent.stdout.readline())
        os.kill(parent.pid, signal.SIGKILL)
        parent.wait()
    wait_for(lambda: gone(pid))
