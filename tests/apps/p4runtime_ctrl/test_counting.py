"""When the counters of blocks are read."""

from apps.p4runtime_ctrl import agent
from apps.p4runtime_ctrl.settings import Settings
from tests.apps.p4runtime_ctrl.programs import program
from tests.apps.p4runtime_ctrl.stage import wait_for
from tests.apps.p4runtime_ctrl.test_agent import MINE, Connected, Written
from tests.apps.p4runtime_ctrl.test_switch import Held, decision


class Read(Held):
    """A switch that counts how often its counters were read."""

    broken = False
    readings = 0

    def alive(self):
        return ""

    def read_counters(self, table_id):
        self.readings += 1
        return super().read_counters(table_id)


def test_decisions_that_follow_each_other_are_counted_together(monkeypatch):
    monkeypatch.setattr(agent, "_CALM_S", 3600.0)
    engine, switch = Written(), Read()
    settings = Settings(switches=(MINE,), program="", p4info="", restore=False)
    one = agent.Agent(engine, settings, MINE, program(), Connected)
    one._counted_at = float("-inf")  # as long after boot
    one.start(chief=True)
    one.became_primary(switch)
    one.decide(decision(1))
    wait_for(lambda: set(engine.counted()) == {"d1"}, 60)
    for number in range(2, 6):
        one.decide(decision(number, address=f"10.0.0.{number}"))
    wait_for(lambda: ("d5", "installed") in engine.confirmed(), 60)
    assert switch.readings == 1
    monkeypatch.setattr(agent, "_CALM_S", 0.0)
    everything = {f"d{number}" for number in range(1, 6)}
    wait_for(lambda: one.tick() or set(engine.counted()) == everything, 60)
    one.stop()
