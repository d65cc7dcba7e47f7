"""Engines of one process meet on memory:// without any server or file."""

from due import CONSUMER, PRODUCER, PUB_ONLY, Capability, Engine, Options
from tests.due.conftest import wait_for


def engine(app_id: str, name: str, tmp_path, **init: object) -> Engine:
    made = Engine(Options(coordinated=False, directory=str(tmp_path)))
    made.set_pubsub(f"memory://{name}")
    made.set_db(f"memory://{name}")
    made.init(app_id, PRODUCER | CONSUMER, **init)
    return made


def test_two_engines_share_data_and_history(tmp_path):
    producer = engine("producer", "shared", tmp_path, capabilities=[Capability("lab.reading.producer.**")])
    consumer = engine("consumer", "shared", tmp_path)
    got: list[object] = []
    consumer.observe("lab.reading.producer.*").subscribe(lambda item: got.append(item.value))
    for number in range(100):
        producer.write("lab.reading.producer.one", number)
    producer.flush()
    wait_for(lambda: len(got) == 100)
    assert got == list(range(100))
    assert [item.value for item in consumer.get("lab.reading.producer.*")] == got
    producer.close()
    consumer.close()


def test_reliable_data_waits_for_the_next_instance(tmp_path):
    capabilities = [Capability("lab.order.producer.**", delivery="reliable")]
    producer = engine("producer", "reliable", tmp_path, capabilities=capabilities)
    first, got = engine("worker", "reliable", tmp_path), []
    first.observe("lab.order.producer.**").subscribe(lambda item: got.append(item.value))
    producer.write("lab.order.producer.one", 1, [PUB_ONLY])
    wait_for(lambda: got == [1])
    first.close()
    for number in (2, 3):
        producer.write("lab.order.producer.one", number, [PUB_ONLY])
    producer.flush()
    second = engine("worker", "reliable", tmp_path)
    second.observe("lab.order.producer.**").subscribe(lambda item: got.append(item.value))
    wait_for(lambda: got == [1, 2, 3])
    producer.close()
    second.close()


def test_other_names_are_other_places(tmp_path):
    one, other = engine("one", "here", tmp_path), engine("two", "there", tmp_path)
    one.write("lab.note.one.text", "hello")
    one.flush()
    assert [item.value for item in one.get("lab.note.**")] == ["hello"]
    assert other.get("lab.note.**") == []
    one.close()
    other.close()
