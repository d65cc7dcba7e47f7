"""A report is whole or absent, replaces only reports, and its files agree with each other."""

import csv
import json
from typing import Any

import numpy as np
import pytest

from apps.firewall.incidents.incident_book import IncidentBook
from apps.incidents import Incident
from apps.messages import Alert, Confirmation, Decision, Exhibit, Sender, Target
from sdnator.replay.packet_accounting import PacketState
from sdnator.report import report_files
from sdnator.report.writer import FILES, PassData, ReportData, ReportError, check_folder, write_report

T0 = 1_709_625_600_000_000_000
MAC = "34:c3:d2:e0:fc:c9"
BLOCKED_AT = 300


def decision(**changes: Any) -> Decision:
    fields: dict[str, Any] = {
        "id": "d1",
        "action": "block",
        "switch": "s1",
        "target": Target(kind="mac", address=MAC, port=1),
        "reason": "5 anomalous seconds of 10",
        "evidence": (Exhibit(key="network.anomaly.kitsune.alert", timestamp=7, summary="hot"),),
        "event_time": T0 + BLOCKED_AT * 10**9,
        "expires": T0 + 900 * 10**9,
    }
    return Decision(**(fields | changes))


def confirmation(**changes: Any) -> Confirmation:
    fields: dict[str, Any] = {
        "id": "d1",
        "switch": "s1",
        "state": "installed",
        "action": "block",
        "handle": f"ingress.block_mac[{MAC}]",
        "event_time": T0 + BLOCKED_AT * 10**9,
        "arrival": BLOCKED_AT,
    }
    return Confirmation(**(fields | changes))


def alert() -> Alert:
    return Alert(
        id="a1",
        sender=Sender(switch="s1", port=1, mac=MAC, ip="192.168.2.113"),
        event_time=T0 + 295 * 10**9,
        first_packet=294,
        packets=9,
        over=8,
        peak_score=31.5,
        anomalous_seconds=1,
        rate=9.0,
        training_rate=2.0,
        mac_addresses=1,
        reason="8 of 9 packets over 1.0",
    )


def incidents() -> list[Incident]:
    """What the firewall reports of the alert, the decision and its confirmation."""
    book = IncidentBook()
    told = book.hear_alert(alert()) + book.decided(decision()) + book.confirmed(confirmation())
    return told + book.count("d1", 100, T0 + 399 * 10**9)


def data(**changes: Any) -> ReportData:
    """400 packets, one a second: 100 for training, blocked from 300 on."""
    state = np.full(400, PacketState.SCORED, np.uint8)
    state[:100] = PacketState.TRAIN
    score = np.where(state == PacketState.SCORED, 0.01, np.nan)
    dropped = state.copy()
    dropped[BLOCKED_AT:] = PacketState.DROPPED
    fields: dict[str, Any] = {
        "title": "mirai <script>.pcap",
        "time_ns": T0 + np.arange(400) * 10**9 + 5,
        "passes": [
            PassData("Kitsune alone", score, state),
            PassData(
                "with blocking",
                np.where(dropped == PacketState.SCORED, score, np.nan),
                dropped,
                [decision()],
                [confirmation()],
                incidents(),
                incidents()[-1:],
            ),
        ],
        "summary": {
            "mitigation": True,
            "alerts": 1,
            "packets_in": 400,
            "attack_dropped": 99,
            "attack_after_first_block": 100,
        },
        "attack": np.arange(400) >= 290,
        "eth_src": np.full(400, 0x34C3D2E0FCC9, np.uint64),
        "ipv4_src": np.full(400, 0xC0A80271, np.uint32),
    }
    return ReportData(**(fields | changes))


def test_all_files_are_there_and_agree(tmp_path):
    index = write_report(data(), tmp_path / "report")
    assert index == tmp_path / "report" / "index.html"
    assert sorted(path.name for path in index.parent.iterdir()) == sorted(FILES)
    assert [path.name for path in tmp_path.iterdir()] == ["report"]
    rows = list(csv.DictReader((index.parent / "scores.csv").open()))
    assert list(rows[0]) == ["index", "time", "score", "state"]
    assert [row["state"] for row in rows] == ["train"] * 100 + ["scored"] * 200 + ["dropped"] * 100
    assert rows[150] == {"index": "150", "time": "1709625750.000000005", "score": "0.01", "state": "scored"}
    assert rows[399]["score"] == rows[0]["score"] == ""
    (decided,) = csv.DictReader((index.parent / "decisions.csv").open())
    assert (decided["address"], decided["state"], decided["packet"]) == (MAC, "installed", "300")
    events = [json.loads(line) for line in (index.parent / "eve.json").read_text().splitlines()]
    assert [event["event_type"] for event in events] == ["alert"] * 3 + ["drop"] * 100
    assert [event["alert"]["action"] for event in events[:3]] == ["allowed", "allowed", "blocked"]
    assert len({event["flow_id"] for event in events[:3]}) == 1


def test_the_page_is_self_contained_and_escapes(tmp_path):
    page = write_report(data(), tmp_path / "r").read_text()
    assert "<script>" not in page
    assert "mirai &lt;script&gt;.pcap" in page
    assert "data:image/png;base64," in page
    assert "http://" not in page
    assert "https://" not in page
    assert "<td>192.168.2.113</td>" in page
    assert f"<td>blocked {MAC} port 1</td><td>100</td>" in page
    assert "1 sender blocked; 99.0 % of the attack stopped from then on" in page


def test_a_former_report_is_replaced_as_a_whole(tmp_path):
    write_report(data(), tmp_path / "r")
    (tmp_path / "r" / "eve.json").write_text("old")
    write_report(data(title="later"), tmp_path / "r")
    assert "old" not in (tmp_path / "r" / "eve.json").read_text()
    assert [path.name for path in tmp_path.iterdir()] == ["r"]
    (tmp_path / "empty").mkdir()
    write_report(data(), tmp_path / "empty")


def test_a_folder_in_use_is_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(ReportError, match=r"holds other things \(thesis.tex\)"):
        write_report(data(), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    with pytest.raises(ReportError, match="is a file"):
        check_folder(tmp_path / "thesis.tex")
    with pytest.raises(ReportError, match="not writable"):
        check_folder(tmp_path / "thesis.tex" / "r")


def test_an_unwritable_folder_is_found_before_the_work():
    """Tried, not asked of the system: /proc refuses root as well."""
    with pytest.raises(ReportError, match="not writable"):
        check_folder("/proc/report")


def test_half_a_report_never_shows(tmp_path, monkeypatch):
    """A full disk or Ctrl-C while writing leaves the former report, or nothing."""
    write_report(data(), tmp_path / "r")

    def full_disk(*_args, **_kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(report_files, "write_eve", full_disk)
    with pytest.raises(ReportError, match="No space left"):
        write_report(data(title="later"), tmp_path / "r")
    assert "later" not in (tmp_path / "r" / "index.html").read_text()
    assert [path.name for path in tmp_path.iterdir()] == ["r"]

    def interrupted(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(report_files, "write_eve", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_report(data(), tmp_path / "new")
    assert [path.name for path in tmp_path.iterdir()] == ["r"]


def test_one_pass_without_labels(tmp_path):
    """The least there can be: one pass, no labels, no senders, no blocks."""
    lone = data(
        passes=data().passes[:1],
        attack=None,
        eth_src=None,
        ipv4_src=None,
        summary={"mitigation": False, "alerts": 0},
    )
    page = write_report(lone, tmp_path / "r").read_text()
    assert "Kitsune alone, nothing blocked: 0 alerts" in page
    assert (tmp_path / "r" / "eve.json").read_text() == ""


def test_no_packets_at_all(tmp_path):
    nothing = PassData("empty", np.zeros(0), np.zeros(0, np.uint8))
    write_report(
        data(time_ns=np.zeros(0, np.int64), passes=[nothing], attack=None, eth_src=None), tmp_path / "r"
    )
