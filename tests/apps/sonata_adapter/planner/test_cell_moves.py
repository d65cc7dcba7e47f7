"""Queries get the cells that their keys need, and lose no window on the way."""

import msgspec
import numpy as np
import pytest

from apps.sonata_adapter.control import Control
from apps.sonata_adapter.keys import request_of
from apps.sonata_adapter.plan_answer import plan_answer
from apps.sonata_adapter.planner.cell_moves import better_places
from apps.sonata_adapter.planner.placement import SwitchLimits
from apps.sonata_adapter.planner.plan import crowded as crowded_of
from apps.sonata_adapter.planner.plan import plan
from apps.sonata_adapter.planner.rates import MeasuredRates
from apps.sonata_adapter.query.catalogue import CATALOGUE, PAPER
from due import RecordBatch
from sdnator.testing.query_traffic import BASE_US, SYN, TimedFrame, batch_of, tcp
from tests.apps.sonata_adapter.crowded_switch import CrowdedSwitch
from tests.apps.sonata_adapter.planner.test_cell_needs import reports
from tests.apps.sonata_adapter.query.test_catalogue import expect, same

PREFIX = "network.traffic_query.sonata"
VICTIM = "10.0.0.1"


def syns(begins, seconds, hosts, *, net=0, attacked=False, per_s=0):
    """SYNs to many hosts in each second, and ten to one of them, at an uneven pace."""
    frames = []
    for second in range(begins, begins + seconds):
        at = BASE_US + second * 1_000_000
        number = per_s or hosts
        for place in range(number):
            n = (second * number + place) % hosts
            # neighbours share cells less often than chance has it
            host = (n * 40_503 + 17) % 65_536
            to = f"10.{net}.{host >> 8}.{host & 255}"
            frames.append(TimedFrame(at + place * 999_000 // number, 60, tcp("192.0.2.7", to, 4000, 80, SYN)))
        if attacked:
            frames += [
                TimedFrame(at + n * 90_000 + 17, 60, tcp(f"198.51.100.{n}", VICTIM, 4000, 80, SYN))
                for n in range(10)
            ]
    return sorted(frames)


@pytest.fixture
def crowded(request):
    keys, limits = request.param
    found = CrowdedSwitch(keys, SwitchLimits(**limits))
    yield found
    found.close()


ALONE = f"{PREFIX}.new_tcp:threshold=8,window=1s"


@pytest.mark.parametrize("crowded", [([ALONE], {"cells": 1024, "reduce_cells": 64})], indirect=True)
def test_more_keys_than_cells_get_more_cells_at_the_next_plan(crowded):
    """While the attack is reported in each window, once, as the naive evaluator does."""
    frames = syns(0, 9, 100, attacked=True, per_s=260)
    crowded.play(frames[: len(frames) // 9])
    assert crowded.cells(PREFIX) == [64]
    crowded.play(frames[len(frames) // 9 :])
    assert crowded.cells(PREFIX) == [1024]
    assert crowded.control.health()["moved"] == 1
    found = crowded.results(PREFIX)
    same(found, expect("new_tcp", frames, {"threshold": 8, "window": 1000}))
    assert len(found) == 9


FIRST, SECOND = (f"{PREFIX}.new_tcp:dst=10.{net}.0.0/16,threshold=8,window=1s" for net in (0, 1))
QUIET_S = 620
"""After so long it is known that keys are few."""


def competing(run, *, again):
    """Minutes with few keys, then seconds with many of the first query; `again`: of the second, too, each minute."""
    frames = []
    for begin in range(0, QUIET_S - 60, 60):
        minute = syns(begin, 1, 200, net=1, per_s=200 if again else 1)
        run.play(minute)
        run.rest(60, BASE_US + begin * 1_000_000 + 1_000_000)
        frames += minute
    crowd = sorted(
        [
            *syns(QUIET_S, 3, 1000, attacked=True),
            *syns(QUIET_S + 3, 16, 1000, attacked=True, per_s=40),
            *syns(QUIET_S, 19, 9, net=1, per_s=10),
        ]
    )
    run.play(crowd)
    run.written += run.control.finish()
    return [*frames, *crowd]


ONE_STAGE = {"stages": 1, "cells": 4096, "reduce_cells": 2048}


@pytest.mark.parametrize("crowded", [([FIRST, SECOND], ONE_STAGE)], indirect=True)
def test_what_has_more_cells_than_it_needs_gives_them_up(crowded):
    """There is one stage: both go to the host for some windows, and come back to cells by their need."""
    frames = competing(crowded, again=False)
    assert crowded.cells(f"{PREFIX}.new_tcp:dst=10.0.") == [3072]
    assert crowded.cells(f"{PREFIX}.new_tcp:dst=10.1.") == [1024]
    assert crowded.control.health()["moved"] == 4
    check(crowded, frames)


@pytest.mark.parametrize("crowded", [([FIRST, SECOND], ONE_STAGE)], indirect=True)
def test_what_has_its_keys_each_minute_keeps_its_cells(crowded):
    """Though it has few when the other one would like to have more."""
    frames = competing(crowded, again=True)
    assert crowded.cells(PREFIX) == [2048, 2048]
    assert crowded.control.health()["moved"] == 0
    check(crowded, frames)


def check(run, frames):
    """Each of both has the naive evaluator's results, each window once."""
    for net, attacked in ((0, True), (1, False)):
        found = run.results(f"{PREFIX}.new_tcp:dst=10.{net}.")
        values = {"threshold": 8, "window": 1000, "dst": f"10.{net}.0.0/16"}
        same(found, expect("new_tcp", frames, values))
        assert (len({each.window for each in found if ("dst", VICTIM) in each.fields}) == 19) == attacked


def test_all_of_the_papers_queries_stay_in_the_switch_whoever_is_crowded():
    """Each count has more keys than cells: those that can have more get more, and none leaves for it."""
    wanted = [request_of(f"{PREFIX}.{name}", CATALOGUE) for name in PAPER]
    before, rates = plan(wanted), MeasuredRates()
    for second in range(0, 12, 3):
        rates.cells.look(before.entries, {"s1": second * 1_000_000})
        for bit in before.entries:
            batch = reports(range(9_000), second * 1_000_000)
            rates.cells.reported("s1", bit, batch, before.entries, 0)
    assert sum(len(crowded_of(one, rates.cells, SwitchLimits())) for one in before.queries) > 5
    after = plan(wanted, rates=rates)
    assert all(one.in_switch for one in after.queries)
    counts = {one.identity: one for one in wanted}
    sides = better_places(wanted, SwitchLimits(), before, rates)
    twins = [msgspec.structs.replace(counts[name], identity=f"{name} twin") for name in sides]
    moved = plan([*wanted, *twins], before=before, rates=rates)
    assert all(one.in_switch for one in moved.queries) == ("host" not in sides.values())


def test_explain_says_how_many_keys_were_seen():
    """Beside the cells, for each operator and each entry."""
    key = f"{PREFIX}.new_tcp:threshold=10,window=3s"
    control = Control(CATALOGUE)
    control.switch("s1", BASE_US)
    control.want([key])
    for second in range(0, 15, 3):
        batch = batch_of(syns(second, 1, 246))
        flags = {"overflow": np.full(len(batch), second > 0), "crossed": np.zeros(len(batch), dtype=bool)}
        control.digests("s1", "q0", RecordBatch({**batch, **flags}))
        control.weigh(float(second))
    told = plan_answer(key, control, CATALOGUE)
    assert "8,192 cells, 2,100 keys seen" in told["text"]
    assert any("8,192 cells, 2,100 keys seen" in each["why"] for each in told["operators"])
    assert list(control.health()["cells"].values()) == ["8,192 cells, 2,100 keys seen"]
