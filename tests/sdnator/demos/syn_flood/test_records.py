"""Reports of the demo's hosts, read while they are written, and what is made of them."""

import json

import pytest

from apps.messages import Confirmation, Target
from sdnator.demos.syn_flood.records import Attempt, Records, Tail, success
from sdnator.demos.syn_flood.trial import Trial, mitigation


def test_tail_leaves_half_a_line(tmp_path):
    """Its writer is in the middle of it."""
    path = tmp_path / "lines"
    tail = Tail(path)
    assert list(tail.lines()) == []
    path.write_bytes(b'{"a": 1}\n{"a"')
    assert list(tail.lines()) == [{"a": 1}]
    with path.open("ab") as file:
        file.write(b": 2}\n")
    assert list(tail.lines()) == [{"a": 2}]


@pytest.fixture
def records(tmp_path) -> Records:
    lines = {
        "client": [
            {"number": 0, "at": 1.0, "kind": "known", "to": "v"},
            {"number": 1, "at": 2.0, "kind": "new", "to": "w"},
            {"number": 0, "ok": True, "ms": 500.0},
        ],
        "victim": [{"at": 1.0, "half_open": {"v": 3}}, {"at": 2.0, "half_open": {"v": 9}}],
        "flood": [{"to": "v", "first": 1.5}, {"to": "v", "first": 1.5, "sent": 10}],
        "counters": [
            {"at": 1.0, "challenged": 4, "entries": {"known_sources": 2, "block": 1}},
            {"at": 2.0, "challenged": 4},
            {"at": 3.0, "challenged": 5},
        ],
    }
    tails = {}
    for name, said in lines.items():
        path = tmp_path / name
        path.write_text("".join(json.dumps(line) + "\n" for line in said))
        tails[name] = Tail(path)
    found = Records(**tails)
    found.update()
    return found


def test_records_say_what_was(records):
    """Attempts by service, with their end where they have one; peaks, entries, counters."""
    (attempt,) = records.towards("v")
    assert attempt.connected_by(1.5)
    assert not attempt.connected_by(1.4)
    assert records.towards("w")[0].ok is None
    assert records.half_open_at("v", 0.5, 1.5) == 3
    assert records.half_open_at("v", 0.5, 2.5) == 9
    assert records.half_open_at("x", 0.5, 2.5) == 0
    assert records.floods["v"]["sent"] == 10
    assert records.entries() == [{"known_sources": 2, "block": 1}]
    assert records.counter("challenged") == 5


def test_rise_of_a_counter(records):
    """From what it was before, not from zero."""
    assert records.first_rise(("challenged", "absent"), 1.5) == 3.0
    assert records.first_rise(("challenged",), 3.0) is None


def test_success_counts_until_an_end():
    """What lasts longer has failed; nothing tried is no share."""
    attempts = [
        Attempt(1.0, "new", "v", True, 100.0),
        Attempt(1.0, "new", "v", True, 900.0),
        Attempt(1.0, "new", "v"),
    ]
    assert success(attempts, 1.5) == pytest.approx(1 / 3, abs=1e-3)
    assert success([], 1.5) is None


def said(action, address, state="installed") -> Confirmation:
    target = Target(kind="ip", address=address, port=80 if action == "protect" else None)
    return Confirmation(id="x", switch="s1", state=state, action=action, target=target, event_time=1)


def test_mitigated_when_all_sources_are_blocked():
    """One by one or by prefix; not by a part of them, a failure, or what was there before."""
    trial = Trial(sources="hundred", service=7, seconds=1.0, protection="found")
    blocks = [(2.0 + number / 100, said("block", f"10.2.7.{10 + number}")) for number in range(100)]
    assert mitigation(blocks, trial, 1.0) == pytest.approx(2.99)
    assert mitigation(blocks[1:], trial, 1.0) is None
    assert mitigation(blocks, trial, 2.5) is None
    assert mitigation([(2.0, said("block", "10.2.7.0/24"))], trial, 1.0) == 2.0
    assert mitigation([(2.0, said("block", "10.2.7.0/24", "failed"))], trial, 1.0) is None


def test_mitigated_when_the_service_is_guarded():
    """This service, not another one."""
    trial = Trial(sources="spoofed", service=7, seconds=1.0, protection="found")
    assert mitigation([(2.0, said("protect", "10.3.0.8"))], trial, 1.0) is None
    assert mitigation([(2.0, said("protect", "10.3.0.7"))], trial, 1.0) == 2.0
