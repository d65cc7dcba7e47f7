"""When the counters of blocks are read."""

from apps.p4runtime_ctrl import counter_reads, worker
from apps.p4runtime_ctrl.settings import Settings
from sdnator.testing.product_program import program
from sdnator.testing.waiting import wait_for
from tests.apps.p4runtime_ctrl.state.test_desired_switch import Held, decision
from tests.apps.p4runtime_ctrl.test_worker import MINE, Connected, Written


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
    monkeypatch.setattr(counter_reads, "_CALM_S", 3600.0)
    engine, switch = Written(), Read()
    settings = Settings(switches=(MINE,), program="", p4info="", restore=False)
    one = worker.SwitchWorker(engine, settings, MINE, program(), Connected)
    one._counters._counted_at = float("-inf")  # as long after boot
    one.start(active=True)
    one.became_primary(switch)
    wait_for(one.settled.is_set)
    one.decide(decision(1), 1)
    wait_for(lambda: set(engine.counted()) == {"d1"}, 60)
    for number in range(2, 6):
        one.decide(decision(number, address=f"10.0.0.{number}"), number)
    wait_for(lambda: ("d5", "installed") in engine.confirmed(), 60)
    assert switch.readings == 1
    monkeypatch.setattr(counter_reads, "_CALM_S", 0.0)
    everything = {f"d{number}" for number in range(1, 6)}
    wait_for(lambda: one.tick() or set(engine.counted()) == everything, 60)
    one.stop()
