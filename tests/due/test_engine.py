"""Engines on a real server: what is written arrives, in order, once, with its types, and is found again."""

import os
import threading
import time
from typing import Any

import numpy as np
import pytest

from due import CONSUMER, DB_ONLY, NO_WAIT, PRODUCER, PUB_ONLY, Capability, Engine, Item, RecordBatch
from due.errors import InvalidKey, InvalidOption, NotAllowed, NotInitialised, UnsupportedValue
from tests.due.conftest import wait_for

RELIABLE = {"capabilities": [Capability("t.**", delivery="reliable")]}


@pytest.mark.parametrize("init", [{}, RELIABLE], ids=["best_effort", "reliable"])
def test_items_arrive_in_order_with_types_and_times(make_engine, init):
    producer, consumer = make_engine("producer", init=init), make_engine("consumer")
    got: list[Any] = []
    consumer.observe("t.order.producer").subscribe(got.append)
    values = [None, 7, 1.5, "text", b"bytes", {"a": [1, np.arange(3)]}, b"x" * 10_000]
    for number in range(300):
        for value in values:
            assert producer.write("t.order.producer", value, event_time=number)
    producer.flush()
    wait_for(lambda: len(got) == 300 * len(values))
    assert [item.sequence for item in got] == list(range(1, len(got) + 1))
    assert [item.event_time for item in got] == [n for n in range(300) for _ in values]
    assert all(got[i].timestamp <= got[i + 1].timestamp for i in range(len(got) - 1))
    assert [item.value for item in got[:5]] == values[:5]
    assert (got[0].app_id, got[0].instance_id) == ("producer", producer.instance_id)
    assert consumer.health()["receiving"]["gaps"] == 0


def test_health_counts_items_by_key_without_specs(make_engine):
    producer = make_engine("counted")
    for key in ("t.a.counted:n=1", "t.a.counted:n=2", "t.b.counted"):
        producer.write(key, 1)
    assert producer.health()["keys"] == {"t.a.counted": 2, "t.b.counted": 1}


@pytest.mark.parametrize("init", [{}, RELIABLE], ids=["best_effort", "reliable"])
def test_a_record_batch_travels_whole(make_engine, init):
    producer, consumer = make_engine("batcher", init=init), make_engine("batch_reader")
    got: list[Any] = []
    consumer.observe("t.batch.**").subscribe(got.append)
    batch = RecordBatch({"time_us": np.arange(10_000), "mac": np.full(10_000, b"abcdef")})
    producer.write("t.batch.batcher", batch, [PUB_ONLY])
    wait_for(lambda: got)
    assert got[0].value == batch


@pytest.mark.parametrize("init", [{}, RELIABLE], ids=["best_effort", "reliable"])
def test_wildcards_and_specs_select_and_no_item_comes_twice(make_engine, init):
    producer, consumer = make_engine("selected", init=init), make_engine("selector")
    got: dict[str, list[Any]] = {
        key: [] for key in ("t.w.*.a", "t.w.**", "t.w.x.a:flag=syn", "t.*.x.a:flag=*", "t.w.x.b")
    }
    for key, items in got.items():
        consumer.observe(key).subscribe(lambda item, items=items: items.append(item.key))
    written = ["t.w.x.a:flag=syn,dst=1", "t.w.x.a:flag=ack", "t.w.x.a", "t.w.y.a", "t.w.x.b.c"]
    for key in written:
        producer.write(key, 1)
    producer.flush()
    canonical = ["t.w.x.a:dst=1,flag=syn", *written[1:]]
    wanted = {
        "t.w.*.a": canonical[:4],
        "t.w.**": canonical,
        "t.w.x.a:flag=syn": canonical[:1],
        "t.*.x.a:flag=*": canonical[:2],
        "t.w.x.b": [],
    }
    # streams come in any order, and observations get an item one after the other
    wait_for(lambda: all(len(got[key]) >= len(keys) for key, keys in wanted.items()))
    assert {key: sorted(keys) for key, keys in got.items()} == {
        key: sorted(keys) for key, keys in wanted.items()
    }


def test_flags_choose_the_backend(make_engine):
    engine = make_engine("flags")
    got: list[Any] = []
    engine.observe("t.flags.**").subscribe(got.append)
    engine.write("t.flags.both", 1)
    engine.write("t.flags.pub", 2, [PUB_ONLY])
    engine.write("t.flags.db", 3, [DB_ONLY])
    engine.write("t.flags.both", 4, [DB_ONLY])
    engine.write("t.flags.both", 5, [NO_WAIT])
    engine.flush()
    wait_for(lambda: len(got) == 3)
    assert sorted(item.value for item in got) == [1, 2, 5]
    assert sorted(item.value for item in engine.get("t.flags.**")) == [1, 3, 4, 5]
    assert engine.health()["receiving"]["gaps"] == 0
    with pytest.raises(InvalidOption, match="cannot be combined"):
        engine.write("t.flags.both", 1, [PUB_ONLY, DB_ONLY])


def test_get_finds_what_was_just_written(make_engine):
    engine = make_engine("getter")
    for number in range(2500):
        engine.write("t.get.getter", {"n": number})
    items = engine.get("t.get.getter")
    assert [item.value["n"] for item in items] == list(range(2500))
    later = engine.get(
        {"dataKey": "t.get.*", "timestamp": {"$gt": items[2000].timestamp}, "value.n": {"$lt": 2400}}
    )
    assert [item.value["n"] for item in later] == list(range(2001, 2400))


def test_a_no_wait_item_carries_what_waited_before_it(make_engine):
    engine = make_engine("hasty", linger=30.0)
    got: list[Any] = []
    engine.observe("t.hasty").subscribe(lambda item: got.append(item.value))
    engine.write("t.hasty", 1, [PUB_ONLY])
    engine.write("t.hasty", 2, [PUB_ONLY, NO_WAIT])
    wait_for(lambda: len(got) == 2)
    assert got == [1, 2]


def test_a_failing_callback_does_not_stop_the_others(make_engine, caplog):
    engine = make_engine("careless")
    got: list[Any] = []
    engine.observe("t.fail").subscribe(lambda item: 1 / item.value)
    engine.observe("t.fail").subscribe(lambda item: got.append(item.value))
    for value in (0, 1, 0, 2):
        engine.write("t.fail", value, [PUB_ONLY])
    engine.flush()
    wait_for(lambda: len(got) == 4)
    assert got == [0, 1, 0, 2]
    assert engine.health()["receiving"]["callback_errors"] == 2
    assert "t.fail" in caplog.text


def test_reliable_items_are_tried_again_and_then_set_aside(make_engine):
    engine = make_engine("stubborn", init=RELIABLE, tries=3)
    calls, got = [], []

    def callback(item):
        calls.append(item.value)
        if item.value == "poison" or calls.count("flaky") == 1:
            raise ValueError(item.value)
        got.append(item.value)

    engine.observe("t.poison").subscribe(callback)
    for value in ("good", "poison", "flaky", "end"):
        engine.write("t.poison", value)
    engine.flush()
    wait_for(lambda: "end" in got)
    assert got == ["good", "flaky", "end"]
    assert calls.count("poison") == 3
    assert engine.health()["receiving"]["set_aside"] == 1
    assert [(item.key, item.value) for item, _ in engine.set_aside()] == [("t.poison", "poison")]
    assert engine.set_aside()[0][1] == "ValueError: poison"


def test_observers_may_come_and_go(make_engine):
    producer, consumer = make_engine("constant"), make_engine("visitor")
    got: list[Any] = []
    subject = consumer.observe("t.visit")
    first, second = subject.subscribe(got.append), subject.subscribe(got.append)
    producer.write("t.visit", 1, [NO_WAIT, PUB_ONLY])
    wait_for(lambda: len(got) == 2)
    first.dispose()
    second.dispose()
    second.dispose()
    producer.write("t.visit", 2, [NO_WAIT, PUB_ONLY])
    subject.subscribe(got.append)
    producer.write("t.visit", 3, [NO_WAIT, PUB_ONLY])
    wait_for(lambda: len(got) == 3)
    assert [item.value for item in got] == [1, 1, 3]
    assert consumer.health()["receiving"]["gaps"] == 0


def _value(item: Item) -> int:
    return int(item.value)


def _even(value: int) -> bool:
    return value % 2 == 0


def test_reactive_operators_work(make_engine):
    import reactivex.operators as ops

    engine = make_engine("reactive")
    got: list[Any] = []
    engine.observe("t.rx").pipe(ops.map(_value), ops.filter(_even), ops.buffer_with_count(2)).subscribe(
        got.append
    )
    for value in range(8):
        engine.write("t.rx", value, [PUB_ONLY])
    wait_for(lambda: len(got) == 2)
    assert got == [[0, 2], [4, 6]]


def test_many_threads_may_write(make_engine):
    engine = make_engine("threads", init=RELIABLE)
    got: list[Any] = []
    engine.observe("t.threads").subscribe(got.append)

    def work(name):
        for number in range(500):
            engine.write("t.threads", (name, number), [PUB_ONLY])

    threads = [threading.Thread(target=work, args=(name,)) for name in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    engine.flush()
    wait_for(lambda: len(got) == 2000)
    assert [item.sequence for item in got] == list(range(1, 2001))
    for name in range(4):
        assert [n for m, n in (item.value for item in got) if m == name] == list(range(500))


def test_a_callback_may_write_get_and_observe(make_engine):
    engine = make_engine("nested")
    got: list[Any] = []

    def echo(item):
        if item.value == 1:
            engine.observe("t.nested.two").subscribe(got.append)
        engine.write("t.nested.two", item.value + len(engine.get("t.nested.one")), [NO_WAIT])

    engine.observe("t.nested.one").subscribe(echo)
    engine.write("t.nested.one", 1, [NO_WAIT])
    wait_for(lambda: got)
    assert got[0].value == 2


def test_what_goes_wrong_is_said_at_once(make_engine):
    engine = make_engine("strict")
    with pytest.raises(InvalidKey, match="concrete"):
        engine.write("t.*", 1)
    with pytest.raises(UnsupportedValue, match="set"):
        engine.write("t.x", {1, 2})
    with pytest.raises(InvalidKey):
        engine.observe("t..x")
    with pytest.raises(InvalidOption, match="before init"):
        engine.set_pubsub("redis://127.0.0.1:1/0")
    with pytest.raises(NotAllowed, match="CONSUMER"):
        make_engine("mute", PRODUCER).observe("t.x")
    with pytest.raises(NotAllowed, match="PRODUCER"):
        make_engine("deaf", CONSUMER).write("t.x", 1)
    with pytest.raises(NotInitialised):
        Engine().flush()
    with pytest.raises(InvalidOption, match="redis://"):
        make_engine("lost", url="http://nowhere")


def test_a_forked_child_speaks_for_itself(make_engine):
    engine = make_engine("parent")
    got: list[Any] = []
    engine.observe("t.fork").subscribe(got.append)
    engine.write("t.fork", "before", [PUB_ONLY, NO_WAIT])
    child = os.fork()
    if child == 0:
        try:
            engine.write("t.fork", "child", [PUB_ONLY])
            engine.close()
        finally:
            os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    engine.write("t.fork", "after", [PUB_ONLY, NO_WAIT])
    wait_for(lambda: len(got) == 3)
    assert sorted(item.value for item in got) == ["after", "before", "child"]
    assert len({item.instance_id for item in got}) == 2


def test_close_sends_what_waits_and_may_be_repeated(make_engine):
    writer, reader = make_engine("leaver", linger=30.0), make_engine("stayer")
    got: list[Any] = []
    reader.observe("t.close").subscribe(got.append)
    writer.write("t.close", 1)
    writer.close()
    writer.close()
    wait_for(lambda: got)
    assert len(reader.get("t.close")) == 1


def test_replay_from_a_time(make_engine):
    producer, consumer = make_engine("historian", init=RELIABLE), make_engine("latecomer")
    for value in range(3):
        producer.write("t.replay", value, [NO_WAIT])
    producer.flush()  # the server has stamped them, in ms
    middle = _a_millisecond_later()
    _a_millisecond_later()
    for value in range(3, 6):
        producer.write("t.replay", value, [NO_WAIT])
    producer.flush()
    late, all_of_it = [], []
    consumer.observe("t.replay", since=middle).subscribe(lambda item: late.append(item.value))
    wait_for(lambda: len(late) == 3)
    make_engine("archivist").observe("t.replay", since="0").subscribe(
        lambda item: all_of_it.append(item.value)
    )
    wait_for(lambda: len(all_of_it) == 6)
    assert late == [3, 4, 5]
    assert all_of_it == list(range(6))


def _a_millisecond_later() -> int:
    began = time.time_ns() // 10**6
    wait_for(lambda: time.time_ns() // 10**6 > began + 1)
    return time.time_ns()


def test_idle_writers_are_put_away_and_their_numbers_go_on(make_engine, monkeypatch):
    monkeypatch.setattr("due.session._MOST_WRITERS", 50)
    engine = make_engine("many")
    got = []
    engine.observe("t.many.*").subscribe(lambda item: got.append((item.key, item.sequence, item.value)))
    for round_ in range(3):
        for number in range(200):
            engine.write(f"t.many.k{number}", round_, [PUB_ONLY, NO_WAIT])
    wait_for(lambda: len(got) == 600)
    for number in range(200):
        mine = [(sequence, value) for key, sequence, value in got if key == f"t.many.k{number}"]
        assert mine == [(1, 0), (2, 1), (3, 2)]
    health = engine.health()
    assert health["key_writers"] <= 60
    assert health["written"] == 600
    assert health["receiving"]["gaps"] == health["receiving"]["repeats"] == 0


@pytest.mark.parametrize("app_id", ["", "<b>", "a.b", "*", "a\n", "a" * 65])
def test_app_ids_that_no_key_could_hold(app_id):
    with pytest.raises(InvalidOption, match="app id"):
        Engine().init(app_id)
