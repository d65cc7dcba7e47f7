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


@pytest.fixture
def passes(monkeypatch):
    """Titles of the passes that were made, and whether each knew a dry run."""
    made = []

    class Pass:
        def __init__(self, survey, _options, *, mitigate, watch, dry_run):
            del watch
            self.result = PassResult(PacketAccounting(survey.packets), mitigate)
            self.knows = dry_run is not None

        def run(self, title):
            made.append((title, self.knows))
            return self.result

    monkeypatch.setattr(run, "ReplayPass", Pass)
    return made


def replayed(time_ns, *, mitigate=True, both=False, **options):
    nothing = np.zeros(len(time_ns), np.uint32)
    surveyed = Survey(
        Path("some.pcap"), time_ns, nothing.astype(np.uint64), nothing, 0, None, nothing, nothing, plain=True
    )
    chosen = ReplayOptions(fm_grace=10, ad_grace=90, **options)
    return run.run(surveyed, None, chosen, mitigate=mitigate, both=both, progress=lambda title: title)


def test_long_capture_gets_a_dry_run_first_which_the_other_pass_knows(passes):
    """Whether it is wanted for labels and report or not; the figures are those of the pass with blocking."""
    for both in (True, False):
        outcome = replayed(HOUR, both=both)
        assert passes == [("dry run", False), ("with blocking", True)]
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


def test_dry_run_alone_is_all_of_a_replay_that_blocks_nothing(passes):
    assert replayed(HOUR, mitigate=False).reported.mitigate is False
    assert passes == [("dry run", False)]
