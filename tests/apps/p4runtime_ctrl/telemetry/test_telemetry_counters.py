"""Counters of the counting stages, for those that plan by the rates of a running network."""

import random
import threading
import time
from contextlib import closing

import pytest

from apps.p4runtime_ctrl.errors import Unreachable
from apps.p4runtime_ctrl.telemetry.telemetry_counters import TelemetryCounters
from apps.sonata_adapter.arrivals import counters_in
from due import Item
from p4rt import p4runtime
from sdnator.testing.controller_run import ControllerRun, Heard
from sdnator.testing.oracles import sonata
from sdnator.testing.product_program import program
from sdnator.testing.query_traffic import BASE_US, office
from sdnator.testing.waiting import wait_for


class Reading:
    """A session whose switch answers for one table."""

    def __init__(self, *entries, error=None):
        self.entries, self.error, self.asked = entries, error, 0

    def read_counters(self, _table_id):
        self.asked += 1
        if self.error is not None:
            raise self.error
        return iter(self.entries if self.asked == 1 else ())


def entry(query_map, packets):
    made = p4runtime.TableEntry(counter_data=p4runtime.CounterData(packet_count=packets))
    match = made.match.add(field_id=1)
    match.ternary.value = match.ternary.mask = query_map.to_bytes(32, "big")
    return made


def read(*entries, error=None, wanted=True):
    """(published, errors) of one look."""
    published, failed = [], []
    counters = TelemetryCounters("s1", program(), published.append, failed.append)
    counters.wanted = wanted
    session = Reading(*entries, error=error)
    counters.look(session, time.monotonic())
    for thread in threading.enumerate():
        if thread.name == "telemetry counters s1":
            thread.join(5)
    assert wanted or not session.asked
    return published, failed


def test_packets_come_by_bit():
    ((counters,), failed) = read(entry(1 << 3, 70), entry(1 << 255, 5))
    assert dict(zip(counters["bit"].tolist(), counters["packets"].tolist(), strict=True)) == {3: 70, 255: 5}
    assert not failed


def test_nothing_is_read_while_nobody_wants_it():
    assert read(entry(1, 1), wanted=False) == ([], [])


@pytest.mark.parametrize("query_map", [0, 3, (1 << 256) - 1])
def test_an_entry_of_no_query_is_refused(query_map, caplog):
    """A switch may send anything; the next read may be better."""
    assert read(entry(query_map, 1)) == ([], [])
    assert "not for one query" in caplog.text


def test_a_switch_that_is_away_is_told_and_other_errors_end_the_worker(caplog):
    assert read(error=Unreachable("s1: gone")) == ([], [])
    assert "gone" in caplog.text
    published, failed = read(error=RuntimeError("what nobody expects"))
    assert (published, [str(each) for each in failed]) == ([], ["what nobody expects"])


@pytest.mark.timeout(180)
def test_the_real_program_tells_what_its_entries_have_met(tmp_path):
    """On the real switch: the entry of new_tcp has met every SYN."""
    with ControllerRun(tmp_path) as stage:
        stage.run("apps.sonata_adapter.service", {})
        engine = stage.engine("observer")
        states = Heard(engine, "network.switch.p4runtime_ctrl.s1")
        stage.controller()
        Heard(engine, "network.traffic_query.sonata.new_tcp")
        heard = Heard(engine, "network.telemetry_counters.p4runtime_ctrl.s1")
        wait_for(lambda: any(state["telemetry"] for state in states.values("network.switch")), why=stage.log)
        frames = office(4, random.Random(2))
        syns = sum(sonata.is_syn(sonata.read(*frame)) for frame in frames)
        with closing(stage.feed()) as feed:
            feed.send(
                [f.time_us - BASE_US for f in frames], [f.length for f in frames], [f.data for f in frames]
            )
            wait_for(lambda: syns in met(heard.items), 60, stage.log)


def met(items: list[Item]) -> set[int]:
    return {packets for item in items for packets in counters_in(item).values()}
