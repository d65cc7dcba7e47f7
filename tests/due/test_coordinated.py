"""Engines under a Coordinator: production on demand, pace, one active instance, refusal of the others.

The Coordinator here is a scripted one that says what the test wants; the real one has its own tests.
"""

import threading
import time
from typing import Any

import pytest

from benchmarks.chaos_links import UnixLink
from due import DB_ONLY, NO_WAIT, PUB_ONLY, Capability, Interest
from due.drivers import redis_wire
from due.errors import Superseded
from due.membership import ASSIGNMENT, Assignments, Registration
from due.messages import Assignment
from tests.due.conftest import wait_for

FAST = {"coordinated": True, "handshake_timeout": 60.0, "heartbeat": 0.05, "pause_limit": 60.0}
"""Beats often, but neither gives up the Coordinator nor takes itself for stopped where cores are short."""


class Script:
    """Hears registrations and answers each with what it is told to; used by the test and by callbacks."""

    def __init__(self, engine) -> None:
        self.engine = engine
        self.lock = threading.RLock()
        self.registrations: dict[str, Registration] = {}
        self.heartbeats: list[Any] = []
        self.say: dict[str, dict[str, Any]] = {}
        self.version = 0
        self.sent: dict[str, int] = {}
        engine.observe("due.registration.*").subscribe(self._registered)
        engine.observe("due.heartbeat.*").subscribe(self._beaten)

    def _registered(self, item) -> None:
        registration = Registration.from_value(item.value)
        with self.lock:
            self.registrations[registration.instance_id] = registration
            if registration.app_id in self.say:
                self.assign(registration.app_id)

    def _beaten(self, item) -> None:
        self.heartbeats.append(item.value)
        app = item.value["app_id"]
        with self.lock:
            if app in self.say and item.value["version"] != self.sent.get(app):
                self.assign(app)

    def assign(self, app: str, **changes) -> None:
        with self.lock:
            self.say[app] = {**self.say.get(app, {}), **changes}
            self.version += 1
            self.sent[app] = self.version
            revisions = self.revisions(app)
            fields = {"epoch": 1, "revisions": revisions, "version": self.version, **self.say[app]}
            message = Assignments(app_id=app, coordinator="script", **fields)
            self.engine.write(f"{ASSIGNMENT}.{app}", message.to_value(), [PUB_ONLY, NO_WAIT])

    def revisions(self, app: str) -> dict[str, int]:
        with self.lock:
            return {i: r.revision for i, r in self.registrations.items() if r.app_id == app}


@pytest.fixture
def script(make_engine) -> Script:
    return Script(make_engine("coordinator"))


def _wants(key, frequency=None, epoch=1):
    return (Assignment(key, frequency, epoch, key),)


def test_items_written_before_the_handshake_are_kept_in_order(make_engine, script):
    consumer = make_engine("early_reader")
    got: list[Any] = []
    consumer.observe("t.early.**").subscribe(lambda item: got.append(item.value))
    engine = make_engine(
        "early", init={"capabilities": [Capability("t.early.**", delivery="reliable")]}, **FAST
    )
    assert all(engine.write("t.early.x", number) for number in range(100))
    wait_for(lambda: engine.instance_id in script.registrations)
    assert got == []
    script.assign("early", assignments=_wants("t.early.**"))
    wait_for(lambda: len(got) == 100)
    assert engine.write("t.early.x", 100)
    wait_for(lambda: len(got) == 101)
    assert got == list(range(101))


def test_without_an_answer_items_go_out_as_if_wanted(make_engine):
    engine = make_engine(
        "alone", init={"capabilities": [Capability("t.alone")]}, coordinated=True, handshake_timeout=0.2
    )
    got: list[Any] = []
    engine.observe("t.alone").subscribe(lambda item: got.append(item.value))
    assert engine.write("t.alone", 1)
    wait_for(lambda: got == [1])
    assert engine.health()["phase"] == "alone"


def test_what_nobody_wants_is_not_produced(make_engine, script):
    init = {"capabilities": [Capability("t.quiet.a"), Capability("t.quiet.b", archive="always")]}
    engine = make_engine("quiet", init=init, **FAST)
    changes = []
    engine.on_assignments(lambda wanted: changes.append([a.key for a in wanted]))
    script.say["quiet"] = {"assignments": ()}
    wait_for(lambda: engine.health()["phase"] == "coordinated")
    assert engine.write("t.quiet.a", 1) is False
    assert engine.write("t.quiet.b", 2) is False
    assert [item.value for item in engine.get("t.quiet.*")] == [2]
    assert not engine.wanted("t.quiet.a")
    script.assign("quiet", assignments=_wants("t.quiet.*"))
    wait_for(lambda: changes[-1:] == [["t.quiet.*"]])
    assert engine.wanted("t.quiet.a")
    assert engine.write("t.quiet.a", 3) is True
    assert engine.health()["unwanted"] == 2


def test_an_app_that_was_stopped_for_a_moment_is_not_told_that_nothing_is_wanted(make_engine, script):
    """Or a controller would empty its switches, and an adapter withdraw all its queries, for nothing."""
    engine, changes = make_engine("stopped", **FAST), []
    script.assign("stopped", active=engine.instance_id, assignments=_wants("t.stopped"))
    wait_for(lambda: engine.health()["phase"] == "coordinated")
    engine.on_assignments(lambda wanted: changes.append([a.key for a in wanted]))
    heartbeats = engine._session.heartbeats
    with heartbeats.lock:
        assert heartbeats.member.paused(time.monotonic())
    heartbeats.wake()
    wait_for(lambda: not engine.health()["asking"])
    script.assign("stopped", assignments=_wants("t.other"))
    wait_for(lambda: changes[-1:] == [["t.other"]])
    assert changes == [["t.stopped"], ["t.other"]]


@pytest.fixture
def link(server, tmp_path, monkeypatch):
    # how long each attempt to connect takes while the link is cut
    monkeypatch.setattr(redis_wire, "_ANSWER_SECONDS", 0.5)
    made = UnixLink(tmp_path / "link.sock", server.socket)
    yield made
    made.close()


@pytest.fixture
def cut_off(make_engine, script, link):
    """An active instance that lost its connection, and has noticed."""
    init = {"capabilities": [Capability("t.cut.**", delivery="reliable")]}
    engine = make_engine("cut", init=init, url=link.url, **FAST | {"pause_limit": 0.2})
    script.assign("cut", active=engine.instance_id, assignments=_wants("t.cut.**"))
    wait_for(lambda: engine.write("t.cut.x", 0) and engine.health()["phase"] == "coordinated")
    engine.flush()
    link.cut()
    wait_for(lambda: engine.health()["asking"])
    assert not engine.connected
    return engine


def test_an_instance_without_data_updates_keeps_its_items_until_it_is_told_that_it_is_active(
    make_engine, script, cut_off, link
):
    got: list[Any] = []
    make_engine("cut_reader").observe("t.cut.x").subscribe(lambda item: got.append(item.value))
    assert cut_off.write("t.cut.x", 1)
    link.mend()
    wait_for(lambda: 1 in got)
    assert not cut_off.health()["asking"]
    assert cut_off.connected
    cut_off.flush()


def test_what_is_to_be_archived_and_cannot_be_held_without_data_updates_is_refused(cut_off, link):
    """The writer hears it; it need not wait, which would stop its app for as long as Data Updates are away."""
    value = bytes(1 << 20)
    assert [cut_off.write("t.beside.x", value, [DB_ONLY]) for _ in range(20)] == [True] * 17 + [False] * 3
    assert cut_off.write("t.beside.x", value, [PUB_ONLY])
    assert cut_off.health()["refused"] == 3
    link.mend()
    wait_for(lambda: not cut_off.health()["asking"])
    cut_off.flush()
    assert len(cut_off.get("t.beside.x")) == 17


def test_an_instance_that_was_replaced_while_it_was_cut_off_writes_nothing_and_flush_says_so(
    make_engine, script, cut_off, link
):
    """Two instances never write at once, and nothing counts as acknowledged that readers refuse."""
    got: list[Any] = []
    make_engine("cut_reader").observe("t.cut.x").subscribe(lambda item: got.append(item.value))
    script.assign("cut", active="another", epoch=2)
    assert cut_off.write("t.cut.x", 1)
    link.mend()
    wait_for(lambda: not cut_off.health()["active"] and not cut_off.health()["asking"])
    with pytest.raises(Superseded, match="another instance took over"):
        cut_off.flush()
    assert not cut_off.write("t.cut.x", 2)
    cut_off.flush()
    assert 1 not in got


def test_what_an_instance_writes_while_another_is_named_is_not_acknowledged(make_engine, script):
    """Right after a kill the Coordinator still names the dead instance."""
    init = {"capabilities": [Capability("t.heir.**", delivery="reliable")]}
    script.assign("heir", active="dead")
    engine = make_engine("heir", init=init, **FAST)
    assert not engine.active
    wait_for(lambda: engine.health()["phase"] == "coordinated")
    assert not engine.active
    assert not engine.write("t.heir.x", 1)
    with pytest.raises(Superseded, match="another instance took over"):
        engine.flush()
    script.assign("heir", active=engine.instance_id, assignments=_wants("t.heir.**"), epoch=2)
    wait_for(lambda: engine.active)
    assert engine.write("t.heir.x", 2)
    engine.flush()


def test_a_subscription_is_in_force_before_its_interest_is_declared(make_engine, script):
    """A producer that speaks only when something changes has spoken already where it is the other way round."""
    producer = make_engine("once", init={"capabilities": [Capability("t.once")]}, **FAST)
    spoken = threading.Event()

    def answer(item) -> None:
        """As soon as the interest is there, and never again."""
        if any(one["key"] == "t.once" for one in item.value["interests"]) and not spoken.is_set():
            script.assign("once", assignments=_wants("t.once"))
            wait_for(lambda: producer.wanted("t.once"))
            producer.write("t.once", 1, [PUB_ONLY, NO_WAIT])
            producer.flush()
            spoken.set()

    listener = make_engine("late", **FAST)
    script.engine.observe("due.registration.late").subscribe(answer)
    receiver, got = listener._session.dispatcher.receiver, []
    subscribe = receiver.subscribe

    def slowly(pattern: str) -> None:
        """Data Updates that answer late."""
        spoken.wait(1.0)
        subscribe(pattern)

    receiver.subscribe = slowly
    listener.observe("t.once").subscribe(lambda item: got.append(item.value))
    wait_for(lambda: got == [1])


def test_interests_are_registered_and_withdrawn(make_engine, script):
    engine = make_engine("curious", init={"interests": [Interest("t.fixed", 2.0)]}, **FAST)
    script.say["curious"] = {}

    def registered():
        known = script.registrations.get(engine.instance_id)
        return [i.key for i in known.interests] if known else None

    wait_for(lambda: registered() == ["t.fixed"])
    subscription = engine.observe("t.more.*").subscribe(print)
    wait_for(lambda: registered() == ["t.fixed", "t.more.*"])
    subscription.dispose()
    wait_for(lambda: registered() == ["t.fixed"])


def test_writes_keep_the_assigned_pace(make_engine, script):
    reader = make_engine("paced_reader")
    got: list[Any] = []
    reader.observe("t.pace.*").subscribe(lambda item: got.append((item.key, item.value)))
    capabilities = [Capability("t.pace.latest"), Capability("t.pace.queue", pacing="queue")]
    engine = make_engine("paced", init={"capabilities": capabilities}, **FAST)
    # so slow that not all of ten can have their turn while they are written
    script.say["paced"] = {"assignments": _wants("t.pace.latest", 2.0) + _wants("t.pace.queue", 20.0)}
    wait_for(lambda: engine.health()["phase"] == "coordinated")
    for number in range(10):
        engine.write("t.pace.latest", number)
        engine.write("t.pace.queue", number)
    engine.flush()
    wait_for(lambda: {("t.pace.latest", 9), ("t.pace.queue", 9)} <= set(got))
    latest = [value for key, value in got if key == "t.pace.latest"]
    replaced = engine.health()["replaced"]
    assert (latest[0], latest[-1]) == (0, 9)
    assert latest == sorted(latest)
    assert len(latest) + replaced == 10
    assert replaced > 0
    assert [value for key, value in got if key == "t.pace.queue"] == list(range(10))


def test_only_the_active_instance_speaks_and_reads_and_a_new_epoch_moves_both(make_engine, script):
    writer = make_engine("feeder", init={"capabilities": [Capability("t.feed", delivery="reliable")]})
    watcher = make_engine("watcher")
    said = []
    watcher.observe("t.pair.said").subscribe(lambda item: said.append(item.value))
    script.say["pair"] = {"active": "nobody", "assignments": _wants("t.pair.**")}
    pair, read, works = [], [], {}
    for name in range(2):
        engine = make_engine("pair", **FAST)
        engine.observe("t.feed").subscribe(lambda item, name=name: read.append((name, item.value)))
        # called when all of the engine obeys; its health says so a moment before
        engine.on_assignments(lambda wanted, name=name: works.update({name: bool(wanted)}))
        pair.append(engine)
    wait_for(lambda: len(script.revisions("pair")) == 2)
    script.assign("pair", epoch=2, active=pair[0].instance_id)
    wait_for(lambda: works == {0: True, 1: False})
    assert [engine.health()["active"] for engine in pair] == [True, False]
    for value in range(5):
        writer.write("t.feed", value, [NO_WAIT])
    wait_for(lambda: len(read) == 5)
    assert pair[0].write("t.pair.said", "first", [NO_WAIT]) is True
    assert pair[1].write("t.pair.said", "second", [NO_WAIT]) is False
    script.assign("pair", epoch=3, active=pair[1].instance_id)
    wait_for(lambda: works == {0: False, 1: True})
    assert [engine.health()["active"] for engine in pair] == [False, True]
    for value in range(5, 10):
        writer.write("t.feed", value, [NO_WAIT])
    wait_for(lambda: len(read) == 10)
    assert pair[0].write("t.pair.said", "first again", [NO_WAIT]) is False
    assert pair[1].write("t.pair.said", "second again", [NO_WAIT]) is True
    wait_for(lambda: len(said) == 2)
    assert read == [(0, n) for n in range(5)] + [(1, n) for n in range(5, 10)]
    assert said == ["first", "second again"]
    assert pair[0].health()["refused"] == 1


def test_frames_of_an_older_epoch_are_dropped_and_counted(make_engine):
    from due.codec import Frame, encode_frame

    engine = make_engine("fence")
    got: list[Any] = []
    engine.observe("t.fence").subscribe(lambda item: got.append(item.value))
    publisher = engine._session.publisher
    sent = ((4, "old", 0), (5, "new", 0), (4, "old", 1), (5, "new", 1))
    for epoch, instance, before in sent:
        frame = Frame("t.fence", "app", instance, epoch, before + 1, before, [time.time_ns()], None, [epoch])
        publisher.publish("t.fence", encode_frame(frame))
    wait_for(lambda: len(got) == 3)
    assert got == [4, 5, 5]
    assert engine.health()["receiving"]["fenced"] == 1


def test_the_last_heartbeat_says_offline(make_engine, script):
    engine = make_engine("mortal", **FAST)
    script.say["mortal"] = {}
    wait_for(lambda: any(b["app_id"] == "mortal" and b["version"] for b in script.heartbeats))
    engine.close()
    wait_for(lambda: any(b["app_id"] == "mortal" and b["state"] == "offline" for b in script.heartbeats))


def test_control_garbage_is_survived(make_engine, script):
    engine = make_engine("robust", **FAST)
    script.engine.write("due.assignment.robust", {"nonsense": 1}, [PUB_ONLY, NO_WAIT])
    script.engine._session.publisher.publish("due.assignment.robust", b"garbage")
    script.say["robust"] = {}
    engine.observe("t.robust").subscribe(print)
    wait_for(lambda: engine.health()["phase"] == "coordinated")
