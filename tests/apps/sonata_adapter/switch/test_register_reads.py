"""Counts of several sources, read from the switch when a window is over."""

import pytest

from apps.sonata_adapter.control import Control
from apps.sonata_adapter.query.catalogue import Template
from apps.sonata_adapter.query.expressions import ACK, SYN, SYN_ACK
from apps.sonata_adapter.query.language import Query, count, field, ip
from apps.sonata_adapter.query.language import tcp as segment
from apps.sonata_adapter.query.parameters import window
from apps.sonata_adapter.results import QueryResult
from sdnator.testing.query_traffic import BASE_US, TimedFrame, batch_of, batches, tcp
from tests.apps.sonata_adapter.switch_model import SwitchModel


def _half_open(values):
    """syn_flood, with a second number in its results: it does not go into one cell."""
    packets = Query("half_open", int(values["window"]))
    syns = packets.filter(segment.flags == SYN).map(dst=ip.dst).reduce("dst", syns=count())
    answers = packets.filter(segment.flags == SYN_ACK).map(dst=ip.src).reduce("dst", syn_acks=count())
    acks = packets.filter(segment.flags == ACK).map(dst=ip.dst).reduce("dst", acks=count())
    joined = syns.join(answers, "dst", kind="outer").join(acks, "dst", kind="left")
    found = joined.map("dst", "syns", count=field("syns") + field("syn_acks") - field("acks"))
    return found.filter(field("count") >= 3)


OWN = {
    "half_open": Template(
        name="half_open",
        meaning="half-open connections",
        result="dst; syns; count",
        parameters=(window(3_000),),
        build=_half_open,
    )
}
HALF_OPEN = "network.traffic_query.sonata.half_open"


def test_a_window_is_over_when_the_switch_has_been_silent_for_one():
    """No clock of the switch: this machine's has to do, and the results say so."""
    control, switch = Control(OWN), SwitchModel()
    control.switch("s1", 0)
    switch.change(control.want([HALF_OPEN]))
    flood = [*syns(0.5, 9), *syns(8.5, 9)]
    for (_, name), sent in switch.process(batch_of(flood)).items():
        control.digests("s1", name, sent)
    moments = (0.0, 3.9, 12.9, 13.1)
    asked = [control.reads(now).get("s1", []) for now in moments]
    written = [
        one
        for reads in asked
        for one in control.cells("s1", [r.id for r in reads], [switch.read(r) for r in reads])
    ]
    assert asked[0], "windows that are over"
    assert asked[1], "the last one, early: the switch may forget it before it is heard of again"
    assert not asked[2]
    assert "this machine's clock" in written[-1].output.error


def ask_and_answer(control, switch, now, *, answer=True):
    reads = control.reads(now).get("s1", [])
    if not answer:
        return reads, []
    return reads, control.cells("s1", [r.id for r in reads], [switch.read(r) for r in reads])


def report(control, switch, frames, only=lambda _name: True):
    held = []
    for (_, name), sent in switch.process(batch_of(frames)).items():
        if only(name):
            control.digests("s1", name, sent)
        else:
            held.append((name, sent))
    return held


def syns(second, number, target="10.1.1.1"):
    return [
        TimedFrame(BASE_US + round(second * 1e6) + n, 60, tcp("10.0.0.9", target, 1000 + n, 80, 2))
        for n in range(number)
    ]


@pytest.fixture
def flooded():
    control, switch = Control(OWN), SwitchModel(base_us=BASE_US)
    control.switch("s1", BASE_US)
    switch.change(control.want([HALF_OPEN]))
    return control, switch


def test_a_gap_in_the_traffic_costs_no_counts(flooded):
    """Cells are asked for while the switch is silent, before the next frame overwrites them."""
    control, switch = flooded
    report(control, switch, syns(0.5, 4))
    report(control, switch, syns(2.5, 3))
    assert not ask_and_answer(control, switch, 0.0)[0], "the window is not over"
    assert ask_and_answer(control, switch, 1.6)[0]
    report(control, switch, syns(6.5, 1))
    _, written = ask_and_answer(control, switch, 4.0)
    (only,) = [one.output for one in written]
    assert (only.fields["count"], only.exact) == (7, True)


def test_what_is_read_too_late_is_reported_as_an_estimate(flooded):
    """A burst over several windows overwrites cells: what is known is said, and that it is not all."""
    control, switch = flooded
    report(control, switch, [*syns(0.5, 9), *syns(6.5, 9)])
    _, written = ask_and_answer(control, switch, 0.0)
    (only,) = [one.output for one in written]
    assert only.fields["count"] == 2, "as many as the switch has reported"
    assert not only.exact
    assert "too low" in only.error
    assert control.health()["late_reads"]


def test_a_report_that_comes_behind_the_clock_is_not_lost(flooded):
    """Reports and the clock travel apart: a key that is reported when answers are awaited is asked for, too."""
    control, switch = flooded
    early = report(control, switch, syns(0.5, 4, "10.1.1.1"))
    late = report(control, switch, [*syns(1.0, 5, "10.1.1.2"), *syns(3.1, 1)], lambda name: name == "q0")
    assert not early
    assert late
    reads, _ = ask_and_answer(control, switch, 0.0, answer=False)
    for name, sent in late:
        control.digests("s1", name, sent)
    more, written = ask_and_answer(control, switch, 0.1)
    assert more
    written += control.cells("s1", [r.id for r in reads], [switch.read(r) for r in reads])
    assert {(w.output.fields["dst"], w.output.fields["count"]) for w in written} == {
        ("10.1.1.1", 4),
        ("10.1.1.2", 5),
    }


@pytest.mark.parametrize("ends", [False, True])
def test_silence_makes_no_results_of_what_is_none(ends, flooded):
    """Nothing overwrites cells while nothing comes: a busy server stays one, however late it is asked for."""
    control, switch = flooded
    answered = [TimedFrame(f.time_us + 900, 60, tcp("10.0.0.9", "10.1.1.1", 9, 80, 16)) for f in syns(0.5, 4)]
    report(control, switch, [*syns(0.5, 4), *answered])
    _, written = ask_and_answer(control, switch, 0.0)
    reads = control.last_reads(20.0) if ends else control.reads(20.0)
    written += control.cells("s1", [r.id for r in reads["s1"]], [switch.read(r) for r in reads["s1"]])
    assert not written
    assert not control.finish()


def test_at_the_end_nothing_that_waits_is_lost(flooded):
    """Windows whose cells nobody tells any more are reported with what is known."""
    control, switch = flooded
    report(control, switch, syns(0.5, 4))
    control.last_reads(0.0)
    (only,) = [one.output for one in control.finish()]
    assert (only.fields["dst"], only.exact) == ("10.1.1.1", False)
    assert "could not be read" in only.error


def test_missing_answers_make_estimates():
    """A controller that does not answer: what is known is reported as an estimate, or not at all."""
    control, switch = Control(OWN), SwitchModel()
    control.switch("s1", 0)
    switch.change(control.want([HALF_OPEN]))
    written = []
    for now, batch in enumerate(batches(syns(0.5, 9) + syns(9.5, 9), 64)):
        for (_, name), sent in switch.process(batch).items():
            written += control.digests("s1", name, sent)
        control.reads(now)
        written += control.tick(now)
    written += control.tick(now + 20)
    for one in written:
        assert isinstance(one.output, QueryResult)
        assert "could not be read" in one.output.error
