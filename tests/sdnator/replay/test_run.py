"""Which passes a replay makes, and what each knows of the one before; no process is started."""

from pathlib import Path

import numpy as np
import pytest

from sdnator.replay import run
from sdnator.replay.loop import PassResult, ReplayOptions
from sdnator.replay.packet_accounting import PacketAccounting
from sdnator.replay.survey import Survey

SECOND = 1_000_000_000
HOUR = np.arange(3_600) * SECOND
"""A packet a second."""
OVERTAKEN = 11
"""A replay with so much training meets a decision where the dry run foretold none, behind the first block ..."""
OVERTAKEN_EARLY = 12
"""... or before it."""


@pytest.fixture
def passes(monkeypatch):
    """Titles of the passes that were made, and whether each knew a dry run, and trusted it behind the first block."""
    made = []

    class Pass:
        def __init__(self, survey, options, *, mitigate, watch, dry_run, foresees, gives_up):
            del watch
            assert gives_up == (mitigate and dry_run is not None)
            self.result = PassResult(PacketAccounting(survey.packets), mitigate)
            late = {OVERTAKEN: foresees, OVERTAKEN_EARLY: dry_run is not None}
            self.result.overtaken = int(mitigate and late.get(options.fm_grace, False))
            self.knows = dry_run is not None
            self.foresees = foresees

        def run(self, title):
            made.append((title, self.knows, self.foresees) if self.foresees else (title, self.knows))
            return self.result

    monkeypatch.setattr(run, "ReplayPass", Pass)
    return made


def replayed(time_ns, *, mitigate=True, both=False, **options):
    nothing = np.zeros(len(time_ns), np.uint32)
    surveyed = Survey(
        Path("some.pcap"), time_ns, nothing.astype(np.uint64), nothing, 0, None, nothing, nothing, plain=True
    )
    chosen = ReplayOptions(**{"fm_grace": 10, "ad_grace": 90, **options})
    return run.run(surveyed, None, chosen, mitigate=mitigate, both=both, progress=lambda title: title)


def test_long_capture_gets_a_dry_run_first_which_the_other_pass_knows(passes):
    """Whether it is wanted for labels and report or not; the figures are those of the pass with blocking."""
    for both in (True, False):
        outcome = replayed(HOUR, both=both)
        assert passes == [("dry run", False), ("with blocking", True, True)]
        assert (outcome.dry_run.mitigate, outcome.reported.mitigate) == (False, True)
        passes.clear()


@pytest.mark.parametrize(
    ("time_ns", "options"),
    [
        (HOUR // 1_000, {}),  # over after a few rounds through the loop
        (HOUR, {"pace": 10.0}),
        (HOUR, {"window": 64}),
        (HOUR, {"switch": "bmv2"}),
    ],
)
def test_no_dry_run_where_it_would_take_longer_than_it_saves(passes, time_ns, options):
    replayed(time_ns, **options)
    assert passes == [("with blocking", False)]


def test_a_pass_that_ran_past_a_decision_is_made_again_with_less_trust(passes):
    """First in what is foretold behind the first block, then in all of the dry run."""
    outcome = replayed(HOUR, fm_grace=OVERTAKEN)
    assert passes == [("dry run", False), ("with blocking", True, True), ("again, 2", True)]
    assert [each.overtaken for each in outcome.passes] == [0, 1, 0]
    assert outcome.reported is outcome.passes[-1]
    assert sum("the dry run was wrong" in note for note in outcome.notes) == 1
    passes.clear()
    outcome = replayed(HOUR, fm_grace=OVERTAKEN_EARLY)
    assert passes[1:] == [("with blocking", True, True), ("again, 2", True), ("again, 3", False)]
    assert [each.overtaken for each in outcome.passes] == [0, 1, 1, 0]


def test_reproducible_replay_trusts_no_dry_run_behind_the_first_block(passes):
    replayed(HOUR, reproducible=True)
    assert passes == [("dry run", False), ("with blocking", True)]


def test_dry_run_alone_is_all_of_a_replay_that_blocks_nothing(passes):
    assert replayed(HOUR, mitigate=False).reported.mitigate is False
    assert passes == [("dry run", False)]
