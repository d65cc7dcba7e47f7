"""A switch that learns sends frames where their station is, follows one that moves, and forgets silent ones."""

import socket
from contextlib import ExitStack, contextmanager

import msgspec
import pytest

from apps.p4runtime_ctrl.errors import P4InfoError
from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
from apps.p4runtime_ctrl.southbound.values import canonical
from apps.p4runtime_ctrl.state.desired_state import DELETE, INSERT, MODIFY
from apps.p4runtime_ctrl.state.desired_switch import DesiredSwitch
from apps.p4runtime_ctrl.state.mac_learning import DIGEST, LearnSettings, MacLearning
from p4rt import p4runtime
from sdnator.capture.interfaces import VethPair
from sdnator.testing.product_program import program
from sdnator.testing.switch_target import KINDS, SwitchTarget
from sdnator.testing.waiting import wait_for
from tests.apps.p4runtime_ctrl.fake_switch import FakeSwitch
from tests.apps.p4runtime_ctrl.test_targets import Attached
from tests.requirements import optional_program, require_netns, shared_data

LEARN = LearnSettings(ports=(1, 2, 3), age_s=60)
_EVERY = 3  # ETH_P_ALL
BROADCAST = (1 << 48) - 1


def report(*rows):
    """A digest list of (MAC, port) or (MAC, port, VLAN)."""
    found = p4runtime.DigestList(digest_id=program().digest_id(DIGEST))
    for mac, port, *vid in rows:
        given = {"mac": mac, "port": port, "vid": vid[0] if vid else 0}
        members = found.data.add().struct.members
        for name, _ in program().digest(DIGEST):
            members.add(bitstring=canonical(given.get(name, 0)))
    return found


def shown(changes):
    kinds = {INSERT: "+", MODIFY: "~", DELETE: "-"}
    return [
        kinds[change.kind] + program().describe(change.entry).removeprefix("ingress.") for change in changes
    ]


def test_stations_come_move_and_go():
    learning = MacLearning(program(), LEARN)
    first = learning.learn([report((0xA, 1), (0xB, 2, 7)), report((0xA, 1))])
    assert shown(first) == [
        "+dmac[vid=0,eth_dst=00:00:00:00:00:0a]",
        "+smac[vid=0,eth_src=00:00:00:00:00:0a]",
        "+dmac[vid=7,eth_dst=00:00:00:00:00:0b]",
        "+smac[vid=7,eth_src=00:00:00:00:00:0b]",
    ]
    assert first[1].entry.idle_timeout_ns == 60_000_000_000
    assert not learning.learn([report((0xA, 1))])
    assert [text[:5] for text in shown(learning.learn([report((0xA, 3))]))] == ["~dmac", "~smac"]
    assert (len(learning), learning.moved) == (2, 1)
    assert not learning.forget(first[0].entry.__class__(table_id=1))
    assert [text[:5] for text in shown(learning.forget(first[1].entry))] == ["-dmac", "-smac"]
    assert len(learning) == 1


def test_the_number_of_stations_is_bounded_and_other_ports_are_ignored():
    learning = MacLearning(program(), msgspec.structs.replace(LEARN, limit=2))
    learning.learn([report((1, 1), (2, 9), (3, 2), (4, 3), (5, 1))])
    assert (len(learning), learning.refused) == (2, 2)


def test_a_program_without_learning():
    small = ProgramInfo.from_text(shared_data("p4/small.p4info.txtpb").read_text())
    with pytest.raises(P4InfoError):
        MacLearning(small, LEARN)


class Learning(Attached):
    """Enters what its switch reports."""

    known = (0, 0)
    """Stations and moves that the switch has been told."""

    def digests(self, lists):
        self.switch.learn(lists, self.session)
        self.known = (len(self.switch.mac_learning), self.switch.mac_learning.moved)


def test_stations_outlive_switch_and_controller():
    with FakeSwitch() as fake:
        held = Learning(fake.address, DesiredSwitch("s1", program(), lambda: (0, 0), learn=LEARN))
        held.until_up()
        assert [replica.egress_port for replica in fake.groups[1].replicas] == [1, 2, 3]
        held.digests([report((0xA, 1), (0xB, 2))])
        before = dict(fake.entries)
        assert len(before) == 4
        fake.restart()
        held.until_up(2)
        assert fake.entries == before
        held.connection.close()
        heir = Learning(fake.address, DesiredSwitch("s1", program(), lambda: (0, 0), learn=LEARN))
        assert str(heir.until_up()) == "nothing to change"
        assert len(heir.switch.mac_learning) == 2
        silent = [entry for entry in fake.entries.values() if entry.idle_timeout_ns]
        assert heir.switch.expire(silent, heir.session) == []
        assert (len(fake.entries), len(heir.switch.mac_learning)) == (0, 0)
        heir.connection.close()


@contextmanager
def cables(count):
    """Names of our ends' sockets and of the switch's ends."""
    require_netns()
    with ExitStack() as stack:
        sockets, far_ends = [], []
        for number in range(count):
            cable = VethPair.make(stack, f"l{'abcdefgh'[number]}")
            # protocol 0 until it is bound, or frames of all interfaces would wait in it
            wire = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
            stack.callback(wire.close)
            wire.bind((cable.near, _EVERY))
            wire.setblocking(False)
            sockets.append(wire)
            far_ends.append(cable.far)
        yield sockets, far_ends


def test_who_does_not_learn_ends_the_flooding_of_who_did():
    with FakeSwitch() as fake:
        held = Learning(fake.address, DesiredSwitch("s1", program(), lambda: (0, 0), learn=LEARN))
        held.until_up()
        held.digests([report((0xA, 1))])
        held.connection.close()
        heir = Attached(fake.address, DesiredSwitch("s1", program(), lambda: (0, 0)))
        heir.until_up()
        heir.connection.close()
        table = program().table("dmac")
        drop = next(action for action in table.actions if action.name == "ingress.drop_unknown")
        assert fake.defaults[table.id].action.action.action_id == drop.id
        assert not fake.entries


def test_new_senders_are_reported_only_to_who_learns():
    """Else every frame to a station of a static entry would make a digest that nobody reads."""
    table = program().table("smac")
    with FakeSwitch() as fake:
        for learn, name in ((None, "ignore"), (LEARN, "learn"), (None, "ignore")):
            held = Attached(fake.address, DesiredSwitch("s1", program(), lambda: (0, 0), learn=learn))
            held.until_up()
            held.connection.close()
            action = next(action for action in table.actions if action.name == f"ingress.{name}")
            assert fake.defaults[table.id].action.action.action_id == action.id


class Hosts:
    """Frames out of and into the far ends of the switch's ports."""

    def __init__(self, wires):
        self.wires = wires
        self.got = [[] for _ in wires]
        self.number = 0

    def send(self, port, source, destination):
        """Send one frame; returns the mark that tells it from others."""
        self.number += 1
        mark = self.number.to_bytes(4, "big")
        frame = destination.to_bytes(6, "big") + source.to_bytes(6, "big") + b"\x88\xb5" + mark * 12
        self.wires[port - 1].send(frame)
        return mark

    def receivers(self, mark):
        """Ports whose hosts have got the frame so far."""
        for wire, got in zip(self.wires, self.got, strict=True):
            while True:
                try:
                    data, address = wire.recvfrom(2000)
                except BlockingIOError:
                    break
                if address[2] != socket.PACKET_OUTGOING:
                    got.append(data[14:18])
        return [port for port, got in enumerate(self.got, start=1) if mark in got]


@pytest.mark.parametrize("kind", KINDS)
def test_frames_go_where_their_station_is(kind, tmp_path):
    if kind == "bmv2":
        optional_program("simple_switch_grpc")
    a, b = 0x02000000000A, 0x02000000000B
    with cables(3) as (wires, ends):
        target = SwitchTarget(
            kind, tmp_path, ports=tuple(f"{n}=veth:{end}" for n, end in enumerate(ends, start=1))
        )
        target.start()
        held = Learning(target.address, DesiredSwitch("s1", program(), lambda: (0, 0), learn=LEARN))
        try:
            held.until_up()
            hosts = Hosts(wires)
            mark = hosts.send(1, a, b)
            wait_for(lambda: hosts.receivers(mark) == [2, 3], 90)
            wait_for(lambda: held.known == (1, 0), 90)
            mark = hosts.send(2, b, a)
            wait_for(lambda: hosts.receivers(mark), 90)
            wait_for(lambda: held.known == (2, 0), 90)
            last = hosts.send(1, a, b)
            wait_for(lambda: hosts.receivers(last), 90)
            assert (hosts.receivers(mark), hosts.receivers(last)) == ([1], [2])
            hosts.send(3, a, BROADCAST)
            wait_for(lambda: held.known == (2, 1), 90)
            mark = hosts.send(2, b, a)
            wait_for(lambda: hosts.receivers(mark), 90)
            assert hosts.receivers(mark) == [3]
        finally:
            held.connection.close()
            target.stop()
