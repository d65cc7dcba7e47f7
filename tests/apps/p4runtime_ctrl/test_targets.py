"""The controller's switch logic does the same on the embedded switch and on BMv2."""

import threading

import pytest
from msgspec import structs

from apps.messages import Decision, RateLimit, TableCommand, TableUpdate
from apps.messages import Target as Sender
from apps.p4runtime_ctrl.southbound.connection import Connection
from apps.p4runtime_ctrl.southbound.session import Address, CompiledProgram
from apps.p4runtime_ctrl.state.desired_state import INSERT, Change
from apps.p4runtime_ctrl.state.desired_switch import DesiredSwitch
from apps.p4runtime_ctrl.telemetry.classifier import TelemetryRequest
from p4rt import INSECURE
from sdnator.testing.p4runtime_client import P4RuntimeClient
from sdnator.testing.product_program import PROGRAM, program
from sdnator.testing.switch_target import KINDS, SwitchTarget
from sdnator.testing.waiting import wait_for
from tests.requirements import optional_program


class Attached:
    """A connection that brings its switch up whenever it becomes primary, in the stream's thread."""

    def __init__(self, address, switch, rank=1, **options):
        self.switch = switch
        self.changed = threading.Condition()
        self.reports, self.session, self.error = [], None, None
        pipeline = CompiledProgram(PROGRAM.read_bytes(), program().message)
        self.backups = 0
        place = Address(address, 1, rank, security=INSECURE)
        self.connection = Connection(place, pipeline, self, **options)
        self.connection.open()

    def became_primary(self, session):
        try:
            report = self.switch.bring_up(session)
        except Exception as error:  # noqa: BLE001 - shown by the waiting test
            self.error = error
        with self.changed:
            self.session = session
            self.reports.append(None if self.error else report)
            self.changed.notify_all()

    def became_backup(self):
        self.backups += 1

    def lost(self, cause):
        pass

    def packets(self, messages):
        pass

    def digests(self, lists):
        pass

    def other(self, message):
        pass

    def until_up(self, times=1):
        with self.changed:
            assert self.changed.wait_for(lambda: len(self.reports) >= times, 60)
        if self.error:
            raise self.error
        return self.reports[-1]


@pytest.fixture(params=KINDS)
def target(request, tmp_path):
    if request.param == "bmv2":
        optional_program("simple_switch_grpc")
    made = SwitchTarget(request.param, tmp_path)
    made.start()
    yield made
    made.stop()


@pytest.fixture
def attach(target):
    attached = []

    def make(switch, **options):
        attached.append(Attached(target.address, switch, **options))
        return attached[-1]

    yield make
    for each in attached:
        each.connection.close()


def make(**options):
    return DesiredSwitch("s1", program(), lambda: (0, 0), **options)


def decision(number, action, sender, limit=None):
    return Decision(
        id=f"d{number}", action=action, switch="s1", target=sender, reason="", event_time=1, expires=0,
        limit=limit,
    )  # fmt: skip


SENDERS = (
    Sender(kind="ip", address="10.0.0.1"),
    Sender(kind="ip", address="2001:db8::1"),
    Sender(kind="mac", address="02:00:00:00:00:01", port=1),
    Sender(kind="mac", address="02:00:00:00:00:02"),
)
REQUESTS = (
    TelemetryRequest(name="packets", bit=255),
    TelemetryRequest(name="web", bit=0, conditions={"dst": "10.0.0.0/8", "dport": [80, 90], "protocol": 6}),
    TelemetryRequest(name="scan", bit=1, conditions={"tcp_flags": [2, 0x17], "dport": [85, 1023], "vid": 7}),
    TelemetryRequest(name="six", bit=2, conditions={"src": "2001:db8::/32", "ingress_port": 1}, copy=False),
)


def test_everything_survives_a_reconnection_and_a_restart(target, attach):
    switch = make(forward={1: 2, 2: 1})
    switch.want(REQUESTS, None)
    attached = attach(switch)
    assert attached.until_up().program_loaded
    answers = switch.decide([decision(n, "block", s) for n, s in enumerate(SENDERS)], attached.session)
    answers += switch.decide(
        [decision(9, "protect", Sender(kind="ip", address="10.0.0.80", port=80))], attached.session
    )
    answers += switch.command(
        TableCommand(
            id="c1",
            updates=(
                TableUpdate(kind="insert", table="allow", match={"src": "10.0.0.7"}, action="allow_frame", priority=3),
                TableUpdate(
                    kind="insert", table="known_sources", match={"is_ipv4": 1, "src": "10.0.0.5"}, action="known"
                ),
            ),
        ),
        attached.session,
    )  # fmt: skip
    switch.change_secret(11, 12, attached.session)
    assert {answer.state for answer in answers} == {"installed"}, answers
    attached.connection.break_off()
    assert str(attached.until_up(2)) == "nothing to change"
    target.kill()
    target.start()
    report = attached.until_up(3)
    assert report.program_loaded
    assert not report.failed
    assert report.inserted >= 4 + 2 + 2 + 2
    attached.connection.break_off()
    assert str(attached.until_up(4)) == "nothing to change"


def test_exists_removed_and_failed_are_told_apart(target, attach):
    switch = make()
    attached = attach(switch)
    attached.until_up()
    for action, states in (("block", ["installed", "exists"]), ("unblock", ["removed", "removed"])):
        for state in states:
            answers = switch.decide([decision(1, action, sender) for sender in SENDERS], attached.session)
            assert [answer.state for answer in answers] == [state] * len(SENDERS)
    assert switch.counted_tables == []


def test_a_large_batch_says_which_of_its_updates_failed(target, attach):
    attached = attach(make())
    attached.until_up()

    def block(number):
        match = {"is_ipv4": 1, "src": number}
        update = TableUpdate(kind="insert", table="block_src", match=match, action="drop_src")
        return Change(INSERT, program().entry(update))

    assert {o.code for o in attached.session.write([block(n) for n in range(1, 300)])} == {0}
    outcomes = attached.session.write([block(n) for n in range(1, 2000)])
    assert [o.code == 0 for o in outcomes] == [n >= 300 for n in range(1, 2000)]
    assert len(list(attached.session.read_counters(program().table("block_src").id))) == 1999
    assert str(attached.switch.bring_up(attached.session)) == "1999 removed"


def test_telemetry_comes_and_goes(target, attach):
    switch = make()
    attached = attach(switch)
    attached.until_up()
    for wanted in (REQUESTS[:1], REQUESTS[:3], REQUESTS[1:], (), REQUESTS):
        assert switch.want(wanted, attached.session) == []
        assert str(switch.bring_up(attached.session)) == "nothing to change"


def test_a_backup_takes_over(target, attach):
    active = attach(make(forward={1: 2}), rank=2)
    active.until_up()
    standby = attach(make(forward={1: 2}), rank=1)
    assert not standby.reports
    active.connection.close()
    assert str(standby.until_up()) == "nothing to change"


def test_a_standby_that_found_the_switch_new_does_not_give_way_to_one_that_comes_later(target, attach):
    """A watchdog, for one, which would close the switch."""
    first = attach(make(), active=False, steps_up=True)
    first.until_up()
    watchdog = attach(make(), active=False)
    wait_for(lambda: watchdog.backups)
    assert (len(first.reports), first.backups) == (1, 0)
    assert not watchdog.reports


def test_of_two_active_controllers_the_one_that_insists_becomes_primary(target, attach):
    """Where the clock of the machine to which a switch is given is behind the other one's."""
    first = attach(make(), rank=1)
    first.until_up()
    second = attach(make(), rank=1)
    second.until_up()
    wait_for(lambda: (first.connection.outbid(), len(first.reports) == 2)[1])
    with P4RuntimeClient(target.address, election_id=(2 << 64)) as stronger:
        stronger.arbitrate()
        first.connection.outbid()
        assert len(first.reports) == 2, "a higher rank is respected"


LIMIT = RateLimit(kind="udp_from", port=53, rate=40, spared=("192.0.2.53", "192.0.2.54"), spared_rate=60)
LIMITED = Sender(kind="ip", address="10.0.0.80")


def test_a_rate_limit_is_set_read_back_and_lifted(target, attach):
    """Meters and their rates are in the switch: a controller that comes again finds nothing to change."""
    switch = make()
    attached = attach(switch)
    attached.until_up()
    (said,) = switch.decide([decision(1, "meter", LIMITED, LIMIT)], attached.session)
    assert (said.state, said.id) == ("installed", "d1")
    assert said.handle.startswith("ingress.limit[is_ipv4=1,dst=10.0.0.80,protocol=17,sport=53]"), said.handle
    entries = [entry for table in switch.counted_tables for entry in attached.session.read_counters(table)]
    (reading,) = switch.readings(entries)
    assert (reading["id"], reading["packets"], reading["seen"]) == ("d1", 0, 0)
    attached.connection.break_off()
    assert str(attached.until_up(2)) == "nothing to change"
    (other,) = switch.decide(
        [decision(2, "meter", LIMITED, structs.replace(LIMIT, port=123))], attached.session
    )
    assert other.state == "installed"
    lifted = switch.decide([decision(1, "unmeter", LIMITED, LIMIT)], attached.session)
    assert [(each.id, each.state) for each in lifted] == [("d1", "removed")]
    attached.connection.break_off()
    assert str(attached.until_up(3)) == "nothing to change"
    switch.decide([decision(2, "unmeter", LIMITED, structs.replace(LIMIT, port=123))], attached.session)
    left = [entry for entry in attached.session.read_entries() if "limit" in program().describe(entry)]
    assert not left
    assert switch.blocks == 0


def test_a_rate_limit_of_the_archive_is_written_by_a_controller_that_is_started_again(target, attach):
    """What a controller before it had set and nobody wants any more goes; another rate is put right."""
    switch = make()
    attached = attach(switch)
    attached.until_up()
    switch.decide([decision(1, "meter", LIMITED, LIMIT)], attached.session)
    attached.connection.close()
    again = make()
    faster = structs.replace(LIMIT, rate=400, spared=LIMIT.spared[:1])
    assert not again.restore([decision(3, "meter", LIMITED, faster)])
    report = attach(again, rank=2).until_up()
    assert not report.failed
    assert (report.modified, report.removed) == (2, 1)
