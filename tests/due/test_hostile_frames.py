"""Frames that cannot be, or came where they do not belong, are refused, counted and set aside; the others arrive."""

import pytest
import redis

from benchmarks.hostile_due import KILLER
from due import NO_WAIT, Capability
from due.codec import Frame, encode_frame
from due.drivers.redis_aside import aside_name
from tests.due.conftest import wait_for


def _frame(key, value="forged", **fields):
    app = fields.get("app_id", "stranger")
    standard = {"app_id": app, "instance_id": app, "epoch": 0, "sequence": 1, "before": 0}
    return Frame(key=key, timestamps=[1], event_times=None, values=[value], **{**standard, **fields})


@pytest.fixture
def bus(server):
    with redis.Redis.from_url(server.url, protocol=2) as client:
        yield client


@pytest.fixture
def pair(make_engine):
    """A producer of a reliable key, and a consumer; the values it got."""

    def make(key):
        producer = make_engine("pro", init={"capabilities": [Capability(key, delivery="reliable")]})
        consumer = make_engine("con")
        got = []
        consumer.observe(key).subscribe(lambda item: got.append(item.value))
        producer.write(key, 0, [NO_WAIT])
        wait_for(lambda: got == [0])
        return producer, consumer, got

    return make


def _forge(bus, path, payload):
    bus.xadd(f"due:stream:{path}", {"f": payload})


REFUSED = {
    "undecodable": lambda _key: KILLER,
    "misplaced": lambda _key: encode_frame(_frame("h.elsewhere")),
    "foreign": lambda key: encode_frame(_frame(key)),
    "out_of_range": None,
    "newer_version": lambda _key: b"DUE\x02" + bytes(5000),
}


@pytest.mark.parametrize("cause", REFUSED)
def test_what_is_refused_in_a_stream_is_set_aside_once_and_the_rest_arrives(pair, bus, caplog, cause):
    key = f"h.{cause}.pro"
    producer, consumer, got = pair(key)
    make = REFUSED[cause]
    far = _frame(key, app_id="pro", instance_id=producer.instance_id, before=2**40)
    payload = make(key) if make is not None else encode_frame(far)
    before = bus.xlen(aside_name("con"))
    for _ in range(2):
        _forge(bus, key, payload)
    for number in range(1, 5):
        producer.write(key, number, [NO_WAIT])
    producer.flush()
    wait_for(lambda: got == [0, 1, 2, 3, 4])
    counts = consumer.health()["receiving"]
    assert (counts[cause], counts["repeats"], counts["fenced"]) == (2, 0, 0)
    assert bus.xlen(aside_name("con")) == before + 2
    wait_for(lambda: bus.xpending(f"due:work:con:{key}", "con")["pending"] == 0)
    assert caplog.text.count("refused a frame") == 1
    latest = bus.xrevrange(aside_name("con"), count=1)[0][1]
    assert latest[b"reason"].startswith(cause.encode())
    assert latest[b"f"] == (payload if cause == "newer_version" else payload[:4096]), (
        "an upgraded app can read it"
    )
    assert all(
        reason.startswith(("misplaced", "foreign", "out_of_range")) for _, reason in consumer.set_aside()
    )


@pytest.mark.parametrize(
    "forged", [{"before": 2**30}, {"epoch": 2**31, "before": 1}], ids=lambda f: next(iter(f))
)
def test_a_forged_number_costs_no_genuine_item(pair, bus, forged):
    key = f"h.number.{next(iter(forged))}"
    producer, _, got = pair(key)
    frame = _frame(key, app_id="pro", instance_id=producer.instance_id, **{"before": 2**20, **forged})
    _forge(bus, key, encode_frame(frame))
    wait_for(lambda: got == [0, "forged"])
    for number in range(1, 5):
        producer.write(key, number, [NO_WAIT])
    producer.flush()
    genuine = [1, 2, 3, 4] if forged.get("before") != 1 else [2, 3, 4]
    wait_for(lambda: [n for n in got if n in (1, 2, 3, 4)] == genuine)


def test_best_effort_frames_are_held_to_the_same(make_engine, bus):
    engine = make_engine("con")
    got = []
    engine.observe("h.**").subscribe(lambda item: got.append(item.value))
    for payload in (
        KILLER,
        encode_frame(_frame("h.other")),
        encode_frame(_frame("h.*")),
        encode_frame(_frame("h.<b>", "markup")),
        encode_frame(_frame("h.bus:a=1", "fine")),
    ):
        bus.publish("due:h.bus", payload)
    wait_for(lambda: got == ["fine"])
    counts = engine.health()["receiving"]
    assert (counts["undecodable"], counts["misplaced"]) == (1, 3)


def test_the_third_segment_binds_once_its_app_has_written(make_engine, bus):
    engine = make_engine("con")
    got = []
    for key in ("net.score.*", "due.heartbeat.*"):
        engine.observe(key).subscribe(lambda item: got.append(item.value))
    bus.publish("due:net.score.own", encode_frame(_frame("net.score.own", "test")))
    bus.publish("due:net.score.own", encode_frame(_frame("net.score.own", "own", app_id="own")))
    bus.publish("due:net.score.own", encode_frame(_frame("net.score.own", "late", before=1)))
    bus.publish("due:net.score.kept", encode_frame(_frame("net.score.kept", "other name", app_id="own")))
    bus.publish("due:due.heartbeat.own", encode_frame(_frame("due.heartbeat.own", "never")))
    bus.publish("due:due.heartbeat.own", encode_frame(_frame("due.heartbeat.own", "beat", app_id="own")))
    wait_for(lambda: got == ["test", "own", "other name", "beat"])
    assert engine.health()["receiving"]["foreign"] == 2
