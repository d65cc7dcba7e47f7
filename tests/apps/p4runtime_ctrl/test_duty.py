"""What the switches are asked to send follows the assignments, unless nobody knows who is active."""

import pytest

from apps.p4runtime_ctrl.service import CAPABILITIES, P4RuntimeCtrlService
from apps.p4runtime_ctrl.settings import Settings, SwitchSettings
from due import Assignment, Key
from sdnator.testing.controller_run import PACKETS
from sdnator.testing.product_program import P4INFO, PROGRAM

SETTINGS = Settings(
    switches=(SwitchSettings(name="s1", address="127.0.0.1:1", insecure=True),),
    program=str(PROGRAM),
    p4info=str(P4INFO),
)
WANTED = (Assignment(key=PACKETS, capability=CAPABILITIES[0].key, frequency=None),)


class Member:
    """What the service asks of its engine."""

    def __init__(self):
        self.active, self.wants = True, WANTED

    def assignments(self):
        return self.wants if self.active else ()

    def wanted(self, key):
        return any(Key(key).offers(Key.parse(each.key)) for each in self.assignments())

    def health(self):
        return {"active": self.active}


class Asked:
    """An agent that notes what its switch is to send."""

    def __init__(self):
        self.demands = []

    def want(self, demand):
        self.demands.append([each.name for each in demand.requests])

    def say_again(self):
        pass


@pytest.fixture
def member():
    return Member()


@pytest.fixture
def service(member):
    made = P4RuntimeCtrlService(member, SETTINGS)
    made._agents = {"s1": Asked()}
    return made


def hear(service, member):
    """Be told what is wanted now; returns all that the switch was asked for."""
    service._on_assignments(member.assignments())
    return service._agents["s1"].demands


def test_telemetry_comes_and_goes_with_who_wants_it(service, member):
    assert hear(service, member) == [["packets"]]
    member.wants = ()
    assert hear(service, member) == [["packets"], []]


def test_an_instance_that_asks_who_is_active_leaves_telemetry_as_it_is(service, member):
    """Stopped for a moment: the frames that pass meanwhile are wanted all the same."""
    hear(service, member)
    member.active = False
    assert hear(service, member) == [["packets"]]
    member.active = True
    assert hear(service, member) == [["packets"]]
