"""The picture of a flood shows attempts, SYNs, half-open connections and rules; the figures lie beside it."""

import io
import json

import numpy as np
import pytest
from PIL import Image

from apps.messages import Confirmation, Target
from sdnator.demos.syn_flood.records import Attempt, Records, Tail
from sdnator.demos.syn_flood.report import (
    CONNECTED,
    FAILED,
    HALF_OPEN,
    SENT,
    UNDECIDED,
    Panel,
    panel,
    picture,
    write_report,
)
from sdnator.demos.syn_flood.trial import Trial, TrialOutcome
from sdnator.errors import BadInput

EMPTY = Panel("nothing", 2.0, [], [], [], [], [], [])
FULL = Panel(
    "all",
    2.0,
    [0.1, 0.2, 1.1],
    [0.3],
    [1.9],
    [(0.5, 5000.0), (1.5, 4900.0)],
    [(0.0, 0), (0.1, 97), (2.0, 32)],
    [(0.4, "protect 10.3.0.3")],
)


def has(png: bytes, colour: str) -> bool:
    pixels = np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)
    wanted = np.array(list(bytes.fromhex(colour[1:])))
    return int((np.abs(pixels - wanted).max(axis=2) < 6).sum()) > 20


def test_everything_has_its_colour():
    """Also beside a flood of which nothing was seen."""
    png = picture([EMPTY, FULL])
    assert all(has(png, colour) for colour in (CONNECTED, FAILED, UNDECIDED, SENT, HALF_OPEN))


def test_panel_of_records(tmp_path):
    """Times count from the first SYN; rules of that flood only, many blocks as one mark."""
    trial = Trial(sources="hundred", service=3, seconds=2.0, protection="found")
    names = ("trial", "first", "end", "sent", "latest_ms", "known_success", "new_success", "connect_ms")
    values = (trial, 10.0, 12.0, 10, 0.0, 1.0, 1.0, [])
    outcome = TrialOutcome(
        **dict(zip(names, values, strict=True)),
        half_open_peak=9,
        challenged_ms=None,
        mitigated_ms=1.0,
        tried=3,
    )
    records = Records(*(Tail(tmp_path / "none") for _ in range(4)))
    records.attempts = {
        0: Attempt(10.5, "known", trial.address, True, 1.0),
        1: Attempt(10.1, "new", trial.address, False, 500.0),
        2: Attempt(11.9, "new", trial.address),
        3: Attempt(10.5, "new", "10.3.0.4", False, 1.0),
    }
    records.half_open = [(9.0, {}), (10.5, {trial.address: 9})]
    records.floods[trial.address] = {"first": 10.0, "tally": [(11.0, 500), (12.0, 400)]}
    confirmed = [
        (
            at,
            Confirmation(id="x", switch="s1", state="installed", action="block", target=target, event_time=1),
        )
        for at, target in (
            (9.0, Target(kind="ip", address="10.9.9.9")),
            (10.4, Target(kind="ip", address="10.2.3.10")),
            (10.5, Target(kind="ip", address="10.2.3.11")),
        )
    ]
    seen = panel("all", outcome, records, confirmed)
    assert (seen.connected, seen.failed, seen.undecided) == (
        [0.5],
        [pytest.approx(0.1)],
        [pytest.approx(1.9)],
    )
    assert seen.sent == [(0.5, 500.0), (1.5, 400.0)]
    assert seen.half_open == [(0.5, 9)]
    ((at, text),) = seen.rules
    assert at == pytest.approx(0.4)
    assert text == "block 10.2.3.10 and 1 more"


def test_report_is_written(tmp_path):
    """Picture and figures, in a folder that need not exist."""
    path = write_report(tmp_path / "new" / "report", {"void": ""}, [FULL])
    assert path.read_bytes().startswith(b"\x89PNG")
    assert json.loads((path.parent / "syn_flood.json").read_text()) == {"void": ""}


def test_report_that_cannot_be_written_is_named(tmp_path):
    """One line for the user."""
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match="--report"):
        write_report(tmp_path / "file" / "report", {}, [FULL])
