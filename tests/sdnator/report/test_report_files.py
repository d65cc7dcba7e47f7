"""Files for programs: exact numbers, and events as Suricata writes them."""

import csv
import json

import numpy as np
from msgspec import structs

from apps.messages import Target
from sdnator.replay.packet_accounting import PacketState
from sdnator.report import report_files
from tests.sdnator.report.test_writer import BLOCKED_AT, T0, confirmation, decision, incidents


def test_scores_are_exact(tmp_path):
    """Every score reads back as the same float64; every state has its name."""
    score = np.array([np.nan, 0.1, 1e16, 5e-324, np.nan])
    state = np.array([PacketState.TRAIN, 2, 2, 2, PacketState.DROPPED], np.uint8)
    report_files.write_scores(tmp_path / "s.csv", T0 + np.arange(5), score, state)
    rows = list(csv.DictReader((tmp_path / "s.csv").open()))
    assert [float(row["score"]) for row in rows[1:4]] == score[1:4].tolist()
    assert [row["state"] for row in rows] == ["train", "scored", "scored", "scored", "dropped"]
    assert rows[4]["time"] == "1709625600.000000004"
    states = np.array([0, PacketState.NOT_COPIED], np.uint8)
    report_files.write_scores(tmp_path / "s.csv", T0 + np.arange(2), score[:2], states)
    assert [row["state"] for row in csv.DictReader((tmp_path / "s.csv").open())] == ["lost", "not copied"]


def test_decisions_and_their_answers(tmp_path):
    """One row an answer; a decision without one is not hidden; only installed blocks count as blocks."""
    decisions = [
        decision(),
        decision(id="d2", expires=0, target=Target(kind="ip", address="10.0.0.9"), event_time=T0),
        decision(id="d3", action="unblock"),
        decision(id="d4", reason='a "quoted", split\nreason'),
    ]
    answers = [
        confirmation(),
        confirmation(state="expired"),
        confirmation(id="d3", action="unblock"),
        confirmation(id="d4"),
    ]
    report_files.write_decisions(tmp_path / "d.csv", decisions, answers)
    rows = list(csv.DictReader((tmp_path / "d.csv").open(newline="")))
    assert [(row["id"], row["state"]) for row in rows] == [
        *(
            ("d1", "installed"),
            ("d1", "expired"),
            ("d2", "no answer"),
            ("d3", "installed"),
            ("d4", "installed"),
        ),
    ]
    assert rows[0]["evidence"] == "network.anomaly.kitsune.alert@7"
    assert (rows[2]["expires"], rows[2]["port"], rows[0]["port"]) == ("never", "", "1")
    assert rows[4]["reason"] == 'a "quoted", split\nreason'
    assert [row["id"] for row in report_files.block_rows(decisions, answers)] == ["d1", "d4"]


def test_answers_of_an_extended_block_stand_in_their_own_rows(tmp_path):
    """Block, extension and lifting share an id: each has the switch's answer to itself, and it is one block."""
    ends = [T0 + (BLOCKED_AT + 600 * number) * 10**9 for number in range(3)]
    decisions = [
        decision(event_time=ends[0]),
        decision(id="other"),
        decision(event_time=ends[1], reason="still going on"),
        decision(event_time=ends[2], action="unblock"),
    ]
    answers = [
        confirmation(event_time=ends[0] + 1),
        confirmation(event_time=ends[1] + 1, state="exists"),
        confirmation(event_time=ends[2] + 1, state="removed", action="unblock"),
    ]
    rows = report_files.decision_rows(decisions, answers)
    assert [(row["id"], row["state"]) for row in rows] == [
        ("d1", "installed"),
        ("other", "no answer"),
        ("d1", "exists"),
        ("d1", "removed"),
    ]
    again = confirmation(event_time=ends[1] + 2)
    assert [row["reason"] for row in report_files.block_rows(decisions, [*answers, again])] == [
        "5 anomalous seconds of 10"
    ]


def test_events_are_those_of_the_firewalls_own_file():
    """Reports of incidents without mere updates, and decisions that belong to none: blocked once that is confirmed."""
    by_hand = decision(id="d9", target=Target(kind="ip", address="10.0.0.9"))
    *told, last = incidents()
    update = structs.replace(last, change="more")
    answers = [confirmation(), confirmation(id="d9")]
    events = report_files.incident_events([*told, update], [decision(), by_hand], answers)
    signatures = [event["alert"]["signature"] for event in events]
    assert signatures == ["SDNATOR traffic unlike training"] * 3 + ["SDNATOR block"] * 2
    assert [(each["src_ip"], each["alert"]["action"]) for each in events[-2:]] == [
        ("10.0.0.9", "allowed"),
        ("10.0.0.9", "blocked"),
    ]


def test_drops_are_counted_by_second_and_sender():
    """Five dropped packets of two senders in two seconds: three events."""
    time = T0 + np.array([0, 1, 2, 3, 1_000_000_000, 5]) * 1
    state = np.array([PacketState.DROPPED] * 5 + [PacketState.SCORED], np.uint8)
    mac = np.array([1, 1, 2, 1, 1, 1], np.uint64)
    ip = np.array([9, 9, 0, 9, 9, 9], np.uint32)
    events = report_files.drop_events(time, state, mac, ip)
    assert [(e["ether"]["src_mac"][-2:], e.get("src_ip"), e["flow"]["pkts_toserver"]) for e in events] == [
        ("01", "0.0.0.9", 3),
        ("02", None, 1),
        ("01", "0.0.0.9", 1),
    ]
    assert report_files.drop_events(time, np.zeros(6, np.uint8), mac, ip) == []


def test_one_object_a_line(tmp_path):
    report_files.write_eve(tmp_path / "eve.json", [{"a": "line\nbreak"}, {"b": "ü"}])
    assert [json.loads(line) for line in (tmp_path / "eve.json").read_text().splitlines()] == [
        {"a": "line\nbreak"},
        {"b": "ü"},
    ]


def test_time_text():
    assert report_files.time_text(T0 + 123_456_789) == "2024-03-05T08:00:00.123456+0000"
