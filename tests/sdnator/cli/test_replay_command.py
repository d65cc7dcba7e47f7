"""The options of a replay as typed, and its summary for people; no process is started."""

from pathlib import Path

import pytest

from sdnator.cli import replay_command
from sdnator.cli.replay_command import ReplayRequest, check_switch, options_of, show
from sdnator.errors import BadInput
from sdnator.replay.loop import ReplayOptions

FOUND = {
    "packets_in": 76_000,
    "seconds": 2.0,
    "packets_per_second": 38_000.0,
    "packets_scored": 75_000,
    "training_packets": 55_001,
    "packets_dropped": 900,
    "passed_in_flight": 36,
    "packets_not_copied": 100,
    "packets_lost": 0,
    "alerts": 7,
    "auc": None,
    "blocks": [],
    "incidents": [{}, {}],
    "incidents_mitigated": 1,
    "guards": [],
    "limits": [],
    "packets_limited": 0,
    "packets_would_be_limited": 0,
}


def request(**changes):
    given = {
        "capture": Path("day.pcap"), "labels": None, "switch": "embedded", "inject": None, "mitigate": True,
        "train": 11_000, "fm_grace": None, "ad_grace": None, "pace": "max", "window": 128, "report": None,
        "keep": None, "as_json": False,
    }  # fmt: skip
    return ReplayRequest(**{**given, **changes})


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fm_grace": 100}, "--fm-grace and --ad-grace go together: give both, or --train N"),
        ({"ad_grace": 100}, "--fm-grace and --ad-grace go together"),
        ({"pace": "fast"}, "--pace fast: give max, or a multiple of real time"),
        ({"pace": "0x"}, "--pace 0x: give max"),
        ({"pace": "nan"}, "--pace nan: give max"),
        ({"reaction": 0.0}, "--reaction 0: give 0.001 to 60 capture seconds"),
        ({"reaction": 61.0}, "--reaction 61: give 0.001 to 60 capture seconds"),
        ({"reaction": float("nan")}, "--reaction nan: give 0.001 to 60 capture seconds"),
        ({"reproducible": True, "window": 15}, "--window 15: with --reproducible give at least 16"),
        ({"telemetry": "netflow"}, "--telemetry netflow: give packet-in or digest"),
        ({"switch": "somewhere"}, "--switch somewhere: give embedded, bmv2, HOST:PORT or unix:/PATH"),
        ({"switch": ":9559"}, "--switch :9559: give embedded, bmv2, HOST:PORT or unix:/PATH"),
        (
            {"switch": "127.0.0.1:9"},
            "--switch 127.0.0.1:9: add --inject IFACE, the interface through which frames enter it",
        ),
    ],
)
def test_wrong_option_is_named_with_the_way_out(changes, words):
    with pytest.raises(BadInput) as caught:
        options_of(request(**changes))
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("installed", "user", "words"),
    [(None, 0, "install BMv2, or use --switch embedded"), ("/bin/true", 1000, "run as root, or use")],
)
def test_bmv2_is_refused_where_it_cannot_run(monkeypatch, installed, user, words):
    monkeypatch.setattr(replay_command.shutil, "which", lambda _: installed)
    monkeypatch.setattr(replay_command.os, "geteuid", lambda: user)
    with pytest.raises(BadInput, match=f"--switch bmv2: .*{words}"):
        check_switch("bmv2", None)


def test_any_p4runtime_switch_will_do_with_a_way_into_it():
    options = options_of(request(switch="192.0.2.1:9559", insecure=True, inject="veth0", pace="10x"))
    assert (options.switch, options.inject, options.pace) == ("192.0.2.1:9559", "veth0", 10.0)


def test_reaction_time_is_capture_time():
    options = options_of(request(reaction=1.5, reproducible=True, window=16))
    assert (options.reaction_ns, options.reproducible) == (1_500_000_000, True)
    assert options_of(request()).reaction_ns == ReplayOptions.reaction_ns


def test_training_is_shared_between_both_phases_unless_both_are_given():
    """One in eleven packets shows which features belong together, the rest is learnt."""
    shared = options_of(request(train=11_000))
    assert (shared.fm_grace, shared.ad_grace, shared.pace) == (1_000, 10_000, None)
    given = options_of(request(fm_grace=2_000, ad_grace=3_000))
    assert (given.fm_grace, given.ad_grace) == (2_000, 3_000)


def test_summary_says_what_is_known_and_no_more(capsys):
    """Without labels there is nothing about attacks, without a whole first pass no quality."""
    show(FOUND)
    plain = capsys.readouterr().out
    assert "76,000 in 2.0 s (38,000/s)" in plain
    assert not [word for word in ("time to block", "attack stopped", "ROC AUC", "report") if word in plain]


def test_summary_of_a_labelled_replay_with_its_blocks(capsys):
    block = {"address": "02:00:00:00:00:01", "packet": 56_000, "handle": "block[s1]", "reason": "score 9.1"}
    labelled = {
        "auc": 0.98765, "time_to_block_s": {"capture": 1.25}, "attack_dropped": 900,
        "attack_after_first_block": 950, "benign_dropped": 0, "collateral_dropped": 3,
        "benign_limited": 0,
        "blocks": [block], "report": "out/index.html",
    }  # fmt: skip
    show({**FOUND, **labelled})
    told = " ".join(capsys.readouterr().out.split())
    assert "1.2 s of capture time after the first attack packet" in told
    assert "900 of 950 attack packets after the first block" in told
    assert "36 of blocked senders, before their block took effect" in told
    assert "0.9877 (Kitsune alone)" in told
    assert "blocked 02:00:00:00:00:01 at packet 56,000 (block[s1]) score 9.1" in told
    assert told.endswith("report: out/index.html")


def test_summary_of_a_flood_that_was_limited(capsys):
    limit = {
        "address": "10.0.0.1", "packets": "UDP from port 53", "rate": 20, "packet": 900, "effect": "limited",
        "packets_dropped": 800, "packets_would_be_dropped": 0, "reason": "evidence of 20 nats",
    }  # fmt: skip
    labelled = {
        "limits": [limit], "packets_limited": 800, "attack_packets": 1_000, "attack_dropped": 790,
        "attack_after_first_block": 0, "benign_dropped": 0, "collateral_dropped": 0, "benign_limited": 10,
    }  # fmt: skip
    show({**FOUND, **labelled})
    told = " ".join(capsys.readouterr().out.split())
    assert "limited UDP from port 53 towards 10.0.0.1 to 20/s from packet 900 on: 800 over it" in told
    assert "790 of 1,000 attack packets" in told
    assert "benign over limits 10" in told


def test_demo_names_a_folder_that_cannot_be(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(BadInput, match=r"--folder .*give another folder"):
        replay_command.run_demo(tmp_path / "file", 7, as_json=False)
