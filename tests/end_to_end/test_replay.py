"""The main job, whole: capture, switch, controller, Kitsune, firewall, as separate processes."""

import csv
import json
import subprocess
import sys
from contextlib import ExitStack, chdir
from itertools import islice

import numpy as np
import pytest

from due.drivers.sqlite import SqliteArchive
from sdnator.capture.captures import Capture, CaptureWriter
from sdnator.capture.interfaces import VethPair
from sdnator.datasets.mirai_like import MiraiLikeOptions, make
from sdnator.datasets.rebuild import rebuild
from tests.end_to_end.command import figures, sdnator
from tests.requirements import optional_program, require_netns, shared_data

REAL_PACKETS = 38_363
CAMERA = "34:c3:d2:e0:fc:c9"
INTRUDER = "00:0c:29:5e:71:b4"


@pytest.fixture(scope="module")
def real_capture(tmp_path_factory):
    """The first 38,363 packets of the real Mirai capture, as frames."""
    path = tmp_path_factory.mktemp("real") / "mirai38k.pcap"
    rebuild(shared_data("kitsune/mirai_38k.tsv.gz"), path)
    return path


@pytest.fixture(scope="module")
def attacked_capture(real_capture):
    """The real benign packets with a generated attack behind them, and its labels."""
    attack = real_capture.with_name("attack.pcap")
    done = sdnator(
        "dataset", "make", "mirai-like", attack, "--no-background", "--seed", "5", "--attack-seconds", "120"
    )
    assert done.returncode == 0, done.stderr
    spliced = real_capture.with_name("attacked.pcap")
    done = sdnator("dataset", "splice", real_capture, attack, spliced)
    assert done.returncode == 0, done.stderr
    return spliced, spliced.with_name("attacked.labels.csv")


@pytest.fixture(scope="module")
def short_capture(tmp_path_factory):
    """Four minutes of benign traffic, half a one of an attack."""
    path = tmp_path_factory.mktemp("short") / "short.pcap"
    make(MiraiLikeOptions(seed=4, benign_seconds=240, attack_seconds=30), path)
    return path


def scores_csv(folder):
    with (folder / "scores.csv").open() as file:
        rows = list(csv.DictReader(file))
    score = np.array([float(row["score"] or "nan") for row in rows])
    return score, [row["state"] for row in rows]


@pytest.mark.parametrize(
    ("telemetry", "blocking"),
    [("packet-in", ("--no-mitigate",)), ("digest", ())],
    ids=["packet-in", "digest"],
)
def test_scores_of_the_real_packets_are_the_published_detectors(real_capture, tmp_path, telemetry, blocking):
    """Through switch, gRPC, Redis and back, every score is that of Kitsune-py, and nothing is lost.

    33 packets of the gateway score above the threshold; they raise alerts, and nobody is blocked.
    """
    report = tmp_path / "report"
    how = ("--fm-grace", "2000", "--ad-grace", "10000", "--telemetry", telemetry)
    found = figures("replay", real_capture, *how, *blocking, "--report", report)
    assert (found["packets_in"], found["packets_lost"], found["packets_dropped"]) == (REAL_PACKETS, 0, 0)
    assert found["training_packets"] == 12_001
    assert (found["blocks"], found["alerts"]) == ([], 3)
    score, state = scores_csv(report)
    reference = np.load(shared_data("kitsune/scores.npz"))["fm2000_ad10000_m10"]
    scored = np.array([each == "scored" for each in state])
    assert int(scored.sum()) == REAL_PACKETS - 12_001
    np.testing.assert_allclose(score[scored], reference[scored], rtol=1e-6)


@pytest.fixture(scope="module")
def attacked_replay(attacked_capture):
    """Figures, report and kept folder of one replay with labels; folders are given relative to the current one."""
    capture, labels = attacked_capture
    training = ("--fm-grace", "2000", "--ad-grace", "10000")
    with chdir(capture.parent):
        found = figures(
            "replay", capture, "--labels", labels, *training, "--report", "report", "--keep", "keep"
        )
    return found, capture.with_name("report"), capture.with_name("keep")


def test_attackers_are_blocked_and_nobody_else(attacked_replay):
    """The infected camera is stopped, with the report to prove it, and no benign device loses a packet."""
    found, report, _ = attacked_replay
    assert found["packets_lost"] == 0
    assert found["packets_in"] == (
        found["packets_scored"] + found["packets_dropped"] + found["packets_not_copied"]
    )
    blocked = {block["address"] for block in found["blocks"]}
    assert CAMERA in blocked
    assert blocked <= {CAMERA, INTRUDER}
    assert found["benign_dropped"] == 0
    assert found["attack_dropped"] >= 0.95 * found["attack_after_first_block"] > 0
    assert found["first_attack_packet"] <= found["first_alert_packet"] < found["first_block_packet"] or (
        found["first_alert_packet"] < REAL_PACKETS  # the gateway's own alerts come before the attack
    )
    assert 0.9 < found["auc"] < 1.0
    for name in ("index.html", "scores.png", "scores.csv", "decisions.csv", "eve.json"):
        assert (report / name).stat().st_size > 0
    events = [json.loads(line) for line in (report / "eve.json").read_text().splitlines()]
    assert {"alert", "drop"} <= {event["event_type"] for event in events}
    acted = {action["decision"]: one for one in found["incidents"] for action in one["actions"]}
    assert {block["id"] for block in found["blocks"]} <= acted.keys()
    assert all(one["packets_stopped"] for one in acted.values())
    assert found["incidents_mitigated"] == sum(one["mitigated"] for one in found["incidents"])


@pytest.fixture(scope="module")
def flood_capture(tmp_path_factory):
    """The first four seconds of the real SYN flood."""
    path = tmp_path_factory.mktemp("flood") / "flood.pcap"
    with Capture(shared_data("captures/synflood_spoofed.pcap")) as frames, CaptureWriter(path) as short:
        for frame in islice(frames, 6_000):
            short.write(frame.time_ns, frame.data, frame.length)
    return path


def test_flood_from_forged_sources_ends_with_a_guard_at_any_speed(flood_capture):
    """What the queries tell is decided at a capture time; nobody in a capture can be challenged, and none is lost."""
    fast = figures("replay", flood_capture, "--train", "500")
    (guard,) = fast["guards"]
    assert (guard["address"], guard["port"], guard["effect"]) == ("10.10.10.10", 25565, "would challenge")
    assert guard["packet"] < 1_000
    assert fast["packets_would_be_challenged"] == 6_000 - guard["packet"]
    assert (fast["blocks"], fast["packets_dropped"], fast["packets_lost"]) == ([], 0, 0)
    assert fast["packets_scored"] == fast["packets_in"] == 6_000
    slow = figures("replay", flood_capture, "--train", "500", "--pace", "1x")
    assert slow["guards"] == fast["guards"]


def test_kitsune_alone_knows_of_no_flood(flood_capture):
    found = figures("replay", flood_capture, "--train", "500", "--no-queries")
    assert (found["guards"], found["packets_scored"], found["packets_lost"]) == ([], 6_000, 0)


def test_flood_answered_by_its_victim_blocks_the_flooder_only(tmp_path):
    """SYN-ACKs and RSTs of a victim are charged to whoever began; bursts of SSDP block nobody."""
    capture = tmp_path / "answered.pcap"
    options = ("--answer-all", "--benign-seconds", "900", "--attack-seconds", "120", "--seed", "3")
    done = sdnator("dataset", "make", "mirai-like", capture, *options)
    assert done.returncode == 0, done.stderr
    labels = tmp_path / "answered.labels.csv"
    found = figures("replay", capture, "--labels", labels, "--train", "15000")
    assert found["benign_dropped"] == 0
    assert CAMERA in {block["address"] for block in found["blocks"]}
    assert found["packets_lost"] == 0


def test_everything_decided_is_in_the_archive(attacked_replay):
    """Alerts, scores, decisions and confirmations are found again."""
    found, _, keep = attacked_replay
    archive = SqliteArchive(f"sqlite:///{keep / 'with-blocking' / 'archive.db'}")
    try:
        assert len(archive.find({"dataKey": "network.anomaly.kitsune.alert"})) == found["alerts"]
        scores = archive.find({"dataKey": "network.anomaly.kitsune.score"})
        assert sum(item.value["count"] for item in scores) == found["packets_scored"]
        decided = {item.value["id"] for item in archive.find({"dataKey": "network.block.firewall.*"})}
        assert {block["id"] for block in found["blocks"]} <= decided
        reported = {item.value["id"] for item in archive.find({"dataKey": "network.incident.firewall.*"})}
        assert reported >= {one["id"] for one in found["incidents"]} != set()
        answers = archive.find({"dataKey": "network.confirmation.p4runtime_ctrl.*"})
        installed = [item.value["id"] for item in answers if item.value["state"] == "installed"]
        assert sorted(decided.intersection(installed)) == sorted(block["id"] for block in found["blocks"])
    finally:
        archive.close()


def decided(folder):
    with (folder / "decisions.csv").open(newline="") as file:
        return [(row["time"], row["id"], row["action"], row["address"]) for row in csv.DictReader(file)]


def test_same_scores_and_decisions_on_bmv2(short_capture, tmp_path):
    """Real packets on veth pairs, scored at the capture's times: nothing is lost, and all is as on the embedded switch."""
    optional_program("simple_switch_grpc")
    require_netns()
    for switch in ("bmv2", "embedded"):
        how = ("--train", "1100", "--switch", switch, "--no-mitigate", "--report", tmp_path / switch)
        found = figures("replay", short_capture, *how)
        assert (found["packets_lost"], found["packets_dropped"]) == (0, 0)
        assert found["packets_scored"] == found["packets_in"]
    scores, states = scores_csv(tmp_path / "bmv2")
    expected, expected_states = scores_csv(tmp_path / "embedded")
    assert states == expected_states
    np.testing.assert_allclose(scores, expected, rtol=1e-9)
    assert decided(tmp_path / "bmv2") == decided(tmp_path / "embedded") != []


def test_same_loop_on_a_switch_that_runs_already(short_capture):
    """Any P4Runtime switch will do: frames go into an interface that leads to one of its ports."""
    require_netns()
    with ExitStack() as stack:
        wire = VethPair.make(stack, "test")
        ports = ("--port", f"1=veth:{wire.far}", "--port", "2=null")
        command = [sys.executable, "-m", "dataplane", "--grpc", "127.0.0.1:0", "--insecure", *ports]
        switch = stack.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE))
        stack.callback(switch.terminate)
        assert switch.stdout is not None
        address = json.loads(switch.stdout.readline())["grpc"]
        where = ("--switch", address, "--insecure", "--inject", wire.near)
        found = figures("replay", short_capture, "--train", "1100", *where, "--no-mitigate")
    assert (found["packets_lost"], found["packets_dropped"]) == (0, 0)
    assert found["packets_scored"] == found["packets_in"]
