"""A connection becomes primary, writes, reads, hands packet-ins over in order, and comes back by itself."""

import threading
import time

import pytest

from apps.messages import TableUpdate
from apps.p4runtime_ctrl.errors import NotPrimary, Unreachable
from apps.p4runtime_ctrl.southbound.connection import Connection
from apps.p4runtime_ctrl.southbound.session import Address
from apps.p4runtime_ctrl.state.desired_state import INSERT, Change
from p4rt import INSECURE, p4runtime
from sdnator.testing.product_program import packet_in, pipeline, program
from tests.apps.p4runtime_ctrl.fake_switch import FakeSwitch


class Listener:
    """Records what it hears; `until` waits for it."""

    def __init__(self):
        self.changed = threading.Condition()
        self.sessions, self.lost_causes, self.lists, self.others = [], [], [], []
        self.digest_lists = []
        self.backups = 0
        self.gate = threading.Event()
        self.gate.set()

    def _note(self, change):
        with self.changed:
            change()
            self.changed.notify_all()

    def became_primary(self, session):
        self._note(lambda: self.sessions.append(session))

    def became_backup(self):
        self._note(lambda: setattr(self, "backups", self.backups + 1))

    def lost(self, cause):
        self._note(lambda: self.lost_causes.append(cause))

    def packets(self, messages):
        self.gate.wait(60)
        self._note(lambda: self.lists.append(messages))

    def digests(self, lists):
        self._note(lambda: self.digest_lists.append(lists))

    def other(self, message):
        self._note(lambda: self.others.append(message))

    def until(self, condition, seconds=60):
        with self.changed:
            assert self.changed.wait_for(condition, seconds), (self.lost_causes, len(self.lists))


@pytest.fixture
def switch():
    with FakeSwitch() as fake:
        yield fake


@pytest.fixture
def connect(switch):
    opened = []

    def make(**options):
        listener = Listener()
        rank = options.pop("rank", 1)
        connection = Connection(
            Address(switch.address, 1, rank, security=INSECURE), pipeline(), listener, **options
        )
        connection.open()
        opened.append(connection)
        return connection, listener

    yield make
    for connection in opened:
        connection.close()


def block(number):
    match = {"is_ipv4": 1, "src": number}
    update = TableUpdate(kind="insert", table="block_src", match=match, action="drop_src")
    return Change(INSERT, program().entry(update))


def test_primary_loads_the_program_once(switch, connect):
    _, listener = connect()
    listener.until(lambda: listener.sessions)
    session = listener.sessions[0]
    assert session.ensure_program()
    assert not session.ensure_program()
    session.ensure_copies()
    session.ensure_copies()
    assert switch.programs == 1
    assert [(r.egress_port, r.instance) for r in switch.copies[1].replicas] == [(510, 1)]


def test_outcomes_are_those_of_single_updates(switch, connect):
    _, listener = connect()
    listener.until(lambda: listener.sessions)
    session = listener.sessions[0]
    session.ensure_program()
    assert [outcome.code for outcome in session.write([block(1), block(2)])] == [0, 0]
    assert [outcome.code for outcome in session.write([block(3), block(2), block(4)])] == [0, 6, 0]
    assert len(list(session.read_entries())) == 4
    assert [e.counter_data.packet_count for e in session.read_counters(program().table("block_src").id)] == [
        7
    ] * 4


def test_outcomes_are_found_where_the_switch_hides_them(switch, connect):
    _, listener = connect()
    listener.until(lambda: listener.sessions)
    session = listener.sessions[0]
    session.ensure_program()
    switch.hide_details = True
    switch.full_tables = {program().table("block_mac").id}
    match = {"ingress_port": 1, "eth_src": "02:00:00:00:00:01"}
    mac = TableUpdate(kind="insert", table="block_mac", match=match, action="drop_mac")
    outcomes = session.write([block(1), block(2), Change(INSERT, program().entry(mac)), block(3)])
    assert [outcome.code for outcome in outcomes] == [0, 0, 8, 0]


def test_packets_come_in_order_in_lists(switch, connect):
    _, listener = connect(batch=64)
    listener.until(lambda: listener.sessions)
    switch.send_packets([packet_in(number) for number in range(1, 1001)])
    listener.until(lambda: sum(map(len, listener.lists)) == 1000)
    assert max(map(len, listener.lists)) <= 64
    frames = [m.metadata[4].value for messages in listener.lists for m in messages]
    assert [int.from_bytes(value, "big") for value in frames] == list(range(1, 1001))


def test_digests_between_packets_do_not_cut_them_into_many_lists():
    listener = Listener()
    digests = [p4runtime.DigestList(list_id=number) for number in range(4)]
    packets = [packet_in(number) for number in range(4)]
    connection = Connection(Address("nowhere", 1, 1, security=INSECURE), pipeline(), listener)
    connection._tell([message for pair in zip(digests, packets, strict=True) for message in pair])
    assert (listener.digest_lists, listener.lists) == ([digests], [packets])


def test_a_busy_listener_holds_the_stream(switch, connect):
    connection, listener = connect(batch=10)
    listener.until(lambda: listener.sessions)
    listener.gate.clear()
    switch.send_packets([packet_in(number) for number in range(1, 501)])
    time.sleep(0.5)
    assert len(connection._gathered) <= 4 * 10
    listener.gate.set()
    listener.until(lambda: sum(map(len, listener.lists)) == 500)


def test_it_comes_back_after_a_restart(switch, connect):
    _, listener = connect()
    listener.until(lambda: len(listener.sessions) == 1)
    switch.restart()
    listener.until(lambda: len(listener.sessions) == 2)
    assert listener.lost_causes


def test_the_backup_takes_over(switch, connect):
    first, active = connect(rank=2)
    active.until(lambda: active.sessions)
    _, standby = connect(rank=1)
    standby.until(lambda: standby.backups)
    first.close()
    standby.until(lambda: standby.sessions)
    assert standby.sessions[0].ensure_program()


def test_a_stream_that_the_switch_still_holds_does_not_lock_its_successor_out(switch, connect):
    _, old = connect(rank=1)
    old.until(lambda: old.sessions)
    _, new = connect(rank=1)
    new.until(lambda: new.sessions)
    old.until(lambda: old.backups)
    with pytest.raises(NotPrimary):
        old.sessions[0].write([block(1)])


def test_no_switch_is_said_once_and_waited_for(connect, switch):
    """Calls that fail at once would find a switch that is back two seconds late."""
    switch.stop()
    _, listener = connect()
    listener.until(lambda: listener.lost_causes)
    assert switch.address in listener.lost_causes[0]
    time.sleep(1)
    switch.start()
    listener.until(lambda: listener.sessions)
    assert len(listener.lost_causes) == 1


def test_who_waits_for_a_switch_can_be_closed(connect, switch):
    switch.stop()
    connection, listener = connect()
    listener.until(lambda: listener.lost_causes)
    time.sleep(0.2)
    connection.close()
    assert not any(thread.is_alive() for thread in connection._threads)


def test_calls_to_a_dead_switch_are_unreachable(switch, connect):
    _, listener = connect()
    listener.until(lambda: listener.sessions)
    session = listener.sessions[0]
    switch.stop()
    with pytest.raises(Unreachable):
        session.alive()
    switch.start()


def test_a_new_stream_wins_though_the_wall_clock_was_set_back(monkeypatch):
    """Its election id is higher than that of the stream before."""
    connection = Connection(Address("nowhere", 1, 1, security=INSECURE), pipeline(), Listener())
    before = connection._usual_id()
    past = time.time_ns() - 3600 * 10**9
    monkeypatch.setattr("apps.p4runtime_ctrl.southbound.connection.time.time_ns", lambda: past)
    assert connection._usual_id() > before


@pytest.mark.parametrize("remembers", [True, False])
def test_digests_of_frames_are_numbered_and_need_not_be_remembered(switch, remembers):
    """Others may repeat: the switch keeps those back until they are acknowledged."""
    listener = Listener()
    address = Address(switch.address, 1, 1, security=INSECURE, remembers=remembers)
    connection = Connection(address, pipeline(), listener)
    connection.open()
    listener.until(lambda: listener.sessions)
    listener.sessions[0].ensure_digests()
    connection.close()
    digests = pipeline().p4info.digests
    forgotten = [
        each.preamble.name for each in digests if not switch.digests[each.preamble.id].config.ack_timeout_ns
    ]
    assert forgotten == ([] if remembers else ["frame_digest_t"])
