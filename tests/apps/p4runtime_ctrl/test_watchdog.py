"""The watchdog closes a switch that nobody controls, and leaves one alone that somebody does."""

import pytest

from apps.p4runtime_ctrl import watchdog
from apps.p4runtime_ctrl.settings import Settings, SwitchSettings
from apps.p4runtime_ctrl.state.desired_switch import DesiredSwitch
from apps.p4runtime_ctrl.state.port_forwarding import wires_of
from sdnator.testing.ports import free_port
from sdnator.testing.product_program import P4INFO, PROGRAM, program
from tests.apps.p4runtime_ctrl.fake_switch import FakeSwitch
from tests.apps.p4runtime_ctrl.test_targets import Attached

WIRES = {"1": 2, "2": 1}


@pytest.fixture
def switch():
    with FakeSwitch() as made:
        yield made


def settings(address, fail="closed"):
    one = SwitchSettings(name="s1", address=address, forward=WIRES, fail=fail, insecure=True)
    return Settings(switches=(one,), program=str(PROGRAM), p4info=str(P4INFO))


def attached(switch):
    made = Attached(switch.address, DesiredSwitch("s1", program(), lambda: (0, 0), forward={1: 2, 2: 1}))
    made.until_up()
    return made


def wires(switch):
    ids = {entry.table_id for entry in wires_of(program(), WIRES)}
    return sum(entry.table_id in ids for entry in switch.entries.values())


def test_a_switch_without_controller_is_closed(switch):
    attached(switch).connection.close()
    assert wires(switch) == 2
    assert watchdog.close_all(settings(switch.address), program(), give_up_s=60)
    assert wires(switch) == 0


def test_a_switch_with_another_controller_is_left_alone(switch, monkeypatch):
    monkeypatch.setattr(watchdog, "_UNDER_CONTROL_S", 0.1)
    other = attached(switch)
    assert watchdog.close_all(settings(switch.address), program(), give_up_s=60)
    assert wires(switch) == 2
    other.connection.close()


def test_it_gives_up_where_the_switch_is_gone():
    assert not watchdog.close_all(settings(f"127.0.0.1:{free_port()}"), program(), give_up_s=0.3)


@pytest.mark.parametrize("fail", ["open", "closed"])
def test_a_controller_that_ends_by_itself_dismisses_it(switch, fail):
    other = attached(switch)
    mine = watchdog.FailClosedWatchdog(settings(switch.address, fail))
    mine.start()
    mine.keep()
    assert mine.watches == (fail == "closed")
    mine.dismiss()
    assert wires(switch) == 2
    other.connection.close()
