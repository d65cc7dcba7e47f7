"""Numbers are right also where the dispatcher comes late: what was asked first is done first."""

import threading

from due import NO_WAIT, PUB_ONLY
from tests.due.conftest import wait_for


def test_what_came_between_two_subscriptions_is_no_gap(make_engine, monkeypatch):
    producer, consumer = make_engine("steady"), make_engine("on_and_off")
    got = []
    subject = consumer.observe("t.off")
    subscription = subject.subscribe(lambda item: got.append(item.value))
    producer.write("t.off", 1, [PUB_ONLY, NO_WAIT])
    wait_for(lambda: got == [1])
    receiver = consumer._session.dispatcher.receiver
    receive, late, go_on = receiver.receive, threading.Event(), threading.Event()

    def receive_late(timeout):
        late.set()
        go_on.wait(60)
        return receive(timeout)

    monkeypatch.setattr(receiver, "receive", receive_late)
    receiver.wake()
    assert late.wait(60)
    subscription.dispose()
    producer.write("t.off", 2, [PUB_ONLY, NO_WAIT])
    producer.flush()
    subject.subscribe(lambda item: got.append(item.value))
    producer.write("t.off", 3, [PUB_ONLY, NO_WAIT])
    producer.flush()
    go_on.set()
    wait_for(lambda: got == [1, 3])
    assert consumer.health()["receiving"]["gaps"] == 0
