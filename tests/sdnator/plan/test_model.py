"""From costs to cores, bytes and the bottleneck: figures that can be worked out by hand."""

import math

import msgspec
import pytest

from apps.firewall.policy.rules import Rules
from apps.firewall.service import MOST_SWITCHES as FIREWALL_SWITCHES
from apps.kitsune.service import _MOST_SWITCHES as KITSUNE_SWITCHES
from due.drivers.kafka_names import KafkaAddress
from sdnator.config.up_settings import UpSettings
from sdnator.errors import BadInput
from sdnator.plan import model
from sdnator.plan.costs import Costs, ProcessCost
from sdnator.plan.demand import PipelineDemand
from sdnator.plan.model import ARCHIVE, at_rate, in_long_lists, plan

SWITCH = ProcessCost(
    per_switch=True, idle_cores=0.01, us_per_packet=(100.0, 50.0), mib=60.0, us_per_query=1.0
)
DETECTOR = ProcessCost(
    idle_cores=0.02, switch_cores=0.001, us_per_packet=(200.0, 100.0), mib=150.0, switch_mib=2.0
)
SERVER = ProcessCost(us_per_packet=(20.0, 10.0), us_per_consumer=5.0, mib=40.0)
COSTS = Costs(
    machine="some processor",
    cores=2,
    measured="2026-11-25",
    rates=(100.0, 1000.0),
    processes={"switch": SWITCH, "kitsune": DETECTOR, "updates": SERVER},
    updates_in=(1000.0, 500.0),
    updates_out=(3000.0, 1500.0),
    archive=(600.0, 400.0),
    archive_idle=10.0,
    query_archive=100.0,
    query_updates_in=50.0,
    query_updates_out=60.0,
    consumer_updates_out=20.0,
    keys=30,
    switch_keys=7,
    topics=(20, 5),
)


def row(found, name):
    return next(each for each in found.rows if each.name == name)


def test_one_switch_takes_what_was_measured():
    """At a measured rate the costs themselves come out."""
    found = plan(PipelineDemand(pps=1000), COSTS)
    assert row(found, "switch").cores == pytest.approx(0.01 + 0.05)
    assert row(found, "kitsune").cores == pytest.approx(0.02 + 0.1)
    assert found.cores == pytest.approx(0.06 + 0.12 + 0.01)
    assert found.mib == 250
    assert (found.processes, found.keys, found.partitions) == (3, 30, 85)
    assert found.updates_in == pytest.approx(500_000)
    assert found.updates_out == pytest.approx(1_500_000)
    assert found.archive_gb_per_day == pytest.approx((400 * 1000 + 10) * 86_400 / 1e9)


def test_many_switches_multiply_what_one_of_them_brings():
    """Processes of a switch become more; those of the pipeline have more to do, at the rate of one switch."""
    found = plan(PipelineDemand(switches=10, pps=1000), COSTS)
    switch, detector = row(found, "switch"), row(found, "kitsune")
    assert (switch.processes, switch.mib) == (10, 600)
    assert switch.each == pytest.approx(0.01 + 100 * 100e-6)
    assert switch.cores == pytest.approx(10 * switch.each)
    assert (detector.processes, detector.mib) == (1, 150 + 9 * 2)
    # a packet more is 80,000 us / 900; the rest of 0.02 is for batches, while 0.96 of the time was left for them
    packets = 100 * 0.08 / 900
    least, batches = 0.029 + 10 * packets, 10 * (0.02 - packets) / 0.96
    assert detector.cores == pytest.approx((least + batches) / (1 + batches))
    assert found.keys == 30 + 9 * 7
    assert found.partitions == 85


def test_queries_and_consumers_add_to_each_packet():
    alone = plan(PipelineDemand(pps=1000, archive_days=3), COSTS)
    found = plan(PipelineDemand(pps=1000, queries=4, consumers=2, archive_days=3), COSTS)
    # a little less, since a busier process meets fewer batches
    assert row(found, "switch").cores - row(alone, "switch").cores == pytest.approx(1000 * 4e-6, rel=0.01)
    assert row(found, "updates").cores - row(alone, "updates").cores == pytest.approx(1000 * 10e-6, rel=0.01)
    assert row(found, "kitsune").cores == row(alone, "kitsune").cores
    assert found.updates_in - alone.updates_in == pytest.approx(1000 * 4 * 50)
    assert found.updates_out - alone.updates_out == pytest.approx(1000 * (4 * 60 + 2 * 20))
    more = found.archive_gb_per_day - alone.archive_gb_per_day
    assert more == pytest.approx(1000 * 4 * 100 * 86_400 / 1e9)
    assert found.archive_gb == pytest.approx(3 * found.archive_gb_per_day)
    assert row(found, "switch").grows_with == ("switches", "packets", "queries")
    assert row(found, "updates").grows_with == ("packets", "consumers")


@pytest.mark.parametrize(
    ("rate", "wanted"),
    [
        (0.0, 0.0),
        (50.0, 5000.0),
        (100.0, 10_000.0),
        (550.0, 30_000.0),
        (1000.0, 50_000.0),
        (4000.0, 200_000.0),
    ],
)
def test_between_rates_cores_are_interpolated(rate, wanted):
    """Beyond the highest rate a packet costs what it costs there."""
    assert at_rate((100.0, 1000.0), (100.0, 50.0), rate) == pytest.approx(wanted)
    assert at_rate((100.0, 1000.0), (), rate) == 0


@pytest.mark.parametrize(
    ("per_packet", "wanted"),
    [
        ((), 0.0),
        ((70.0,), 70.0),
        ((200.0, 110.0), 100.0),
        # what noise makes of it is no less than nothing, and no more than was ever measured
        ((200.0, 10.0), 0.0),
        ((100.0, 200.0), 100.0),
    ],
)
def test_two_rates_tell_packets_from_batches(per_packet, wanted):
    """A process with 10,000 us a second for batches, and 100 us for each packet."""
    assert in_long_lists((100.0, 1000.0), per_packet) == pytest.approx(wanted)


def test_bottleneck_is_the_process_that_needs_most_of_a_core():
    """And the rate at which it is full is the one at which it needs a whole one."""
    found = plan(PipelineDemand(pps=5000), COSTS).bottleneck
    assert (found.name, found.share) == ("kitsune", pytest.approx(0.52))
    assert found.pps == pytest.approx(9800, rel=1e-6)
    full = plan(PipelineDemand(pps=found.pps), COSTS)
    assert row(full, "kitsune").each == pytest.approx(1)
    over = plan(PipelineDemand(pps=50_000), COSTS).bottleneck
    assert (over.share, over.pps) == (pytest.approx(5.02), pytest.approx(9800, rel=1e-6))


def test_a_busy_process_takes_what_waits_together():
    """It is full where packets alone fill it, however small the batches of each switch are."""
    demand = PipelineDemand(switches=100, pps=5000)
    found = plan(demand, COSTS)
    detector = row(found, "kitsune").each
    linear = 0.02 + 99 * 0.001 + 5000 * 200e-6
    assert 0.02 + 99 * 0.001 + 5000 * 100e-6 < detector < 1 < linear
    assert found.bottleneck.pps == pytest.approx((1 - 0.02 - 99 * 0.001) / (0.08 / 900), rel=1e-6)


def test_switches_alone_can_be_too_many():
    """Then no rate is low enough."""
    found = plan(PipelineDemand(switches=2000, pps=1), COSTS).bottleneck
    assert (found.name, found.pps) == ("kitsune", math.inf)


def test_what_costs_nothing_is_never_full():
    costs = msgspec.structs.replace(COSTS, processes={"idle": ProcessCost(idle_cores=0.1)})
    found = plan(PipelineDemand(pps=1000), costs)
    assert found.bottleneck.pps == math.inf
    assert row(found, "idle").grows_with == ()


def test_the_archive_can_be_the_bottleneck():
    costs = msgspec.structs.replace(COSTS, sqlite_bytes_per_s=200_010.0)
    found = plan(PipelineDemand(pps=1000), costs).bottleneck
    assert (found.name, found.share) == (ARCHIVE, pytest.approx(400_010 / 200_010))
    # 60,000 bytes a second at 100 packets a second, 400,000 at 1,000
    assert found.pps == pytest.approx(100 + 900 * 140 / 340)


@pytest.mark.parametrize(
    ("demand", "word"),
    [
        (PipelineDemand(pps=10), "less than was measured"),
        (PipelineDemand(pps=2000), "more than was measured"),
        (PipelineDemand(pps=20_000), "a machine with 2 cores"),
        (PipelineDemand(switches=300, pps=30_000), "256 switches at most"),
        (PipelineDemand(pps=1000, queries=300), "256 requests"),
        (PipelineDemand(switches=4, pps=400, blocks=100), "400 table entries"),
        (PipelineDemand(pps=1000, blocks=5000), "4,096 blocks at most"),
        (PipelineDemand(pps=1000), "keeps 7.5 hours"),
        (PipelineDemand(pps=100, archive_days=30), "keeps 2.1 days"),
    ],
)
def test_what_the_figures_do_not_say_is_noted(demand, word):
    assert any(word in note for note in plan(demand, COSTS).notes)


@pytest.mark.parametrize(
    ("demand", "word"),
    [
        (PipelineDemand(pps=500, queries=1), "further query"),
        (PipelineDemand(pps=500, consumers=1), "further consumer"),
        (PipelineDemand(switches=2, pps=500), "further switch"),
    ],
)
def test_what_was_not_measured_is_said(demand, word):
    """It would look as if it cost nothing."""
    costs = msgspec.structs.replace(COSTS, processes={"x": ProcessCost(us_per_packet=(2.0, 1.0))})
    assert any(word in note and "not measured" in note for note in plan(demand, costs).notes)
    assert not any("further" in note for note in plan(demand, COSTS).notes)


def test_a_demand_within_all_limits_has_no_notes():
    assert plan(PipelineDemand(pps=500, archive_days=0.1), COSTS).notes == ()


def test_limits_are_those_of_the_product():
    assert {model.MOST_SWITCHES} == {KITSUNE_SWITCHES, FIREWALL_SWITCHES}
    assert Rules().max_blocks == model.MOST_BLOCKS
    assert UpSettings().quota * (1 << 30) / 1e9 == pytest.approx(model.QUOTA_GB)
    assert KafkaAddress(servers="localhost:9092").partitions == model.PARTITIONS


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"switches": 0}, "--switches 0"),
        ({"switches": 1_000_001}, "--switches"),
        ({"pps": 0.0}, "--pps 0"),
        ({"pps": -5.0}, "--pps -5"),
        ({"pps": math.inf}, "--pps inf"),
        ({"pps": math.nan}, "--pps nan"),
        ({"pps": 1e300}, "--pps 1e"),
        ({"queries": -1}, "--queries -1"),
        ({"consumers": -1}, "--consumers -1"),
        ({"blocks": -1}, "--blocks -1"),
        ({"archive_days": 0.0}, "--archive-days 0"),
        ({"archive_days": math.inf}, "--archive-days inf"),
    ],
)
def test_impossible_demands_are_named(options, word):
    with pytest.raises(BadInput, match=word):
        PipelineDemand(**{"pps": 100.0, **options})
