"""The state's benchmark feeds what it is told to, and says how memory went on."""

import json
import sys
import time

import pytest

from benchmarks import soak_state, soak_state_firewall
from benchmarks.soak_state_recording import Recorded, played
from benchmarks.soak_state_stage import START_NS
from due.codec import decode_value


def test_a_short_run_gives_every_figure(tmp_path, monkeypatch):
    sizes = iter(range(100, 10_000))
    monkeypatch.setattr(soak_state, "_feed", lambda packets: range(0, packets, packets // 120))
    monkeypatch.setattr(soak_state, "_anonymous_mib", lambda: float(min(next(sizes), 140)))
    file = tmp_path / "f.json"
    assert soak_state.main(["--part", "kitsune", "--packets", "1200000", "--json", str(file)]) == 0
    found = json.loads(file.read_text())
    assert (found["packets"], found["later_mib_per_hour"], found["growing"]) == (1_200_000, 0.0, False)
    assert found["mib"][0] < found["mib"][-1] == 140.0


def test_memory_that_grows_to_the_end_ends_with_1(tmp_path, monkeypatch):
    sizes = iter(range(100, 10_000))
    monkeypatch.setattr(soak_state, "_feed", lambda packets: range(0, packets, packets // 120))
    monkeypatch.setattr(soak_state, "_anonymous_mib", lambda: float(next(sizes)))
    assert (
        soak_state.main(["--part", "kitsune", "--packets", "1200000", "--json", str(tmp_path / "f.json")])
        == 1
    )


def test_the_detector_is_really_fed():
    assert next(soak_state._feed(1)) > 1


@pytest.fixture
def clocks(monkeypatch):
    """Parts set the clocks of these modules for good: their processes end with them."""
    for name in (
        "apps.firewall.evidence.archive",
        "apps.firewall.service",
        "apps.sonata_adapter.service",
        "coordinator.checkpoint",
        "coordinator.service",
    ):
        monkeypatch.setattr(sys.modules[name], "time", time)


@pytest.mark.parametrize(
    ("part", "scale"),
    [("coordinator", "0.01"), ("firewall", "0.008"), ("p4runtime_ctrl", "0.02"), ("sonata_adapter", "0.006")],
)
@pytest.mark.usefixtures("clocks")
def test_a_part_lives_through_its_minutes(part, scale, tmp_path, monkeypatch):
    """What a service hears and says in them is in its health."""
    monkeypatch.setattr(soak_state_firewall, "PACKETS", 150_000)
    file = tmp_path / "f.json"
    assert soak_state.main(["--part", part, "--scale", scale, "--objects", "--json", str(file)]) in (0, 1)
    found = json.loads(file.read_text())
    assert len(found["mib"]) == 60
    assert {"later_mib_per_hour", "noise", "growing", "more_objects"} <= found.keys()
    told = found["health"]["end"]
    heard = {
        "coordinator": "heartbeats",
        "firewall": "evidence",
        "p4runtime_ctrl": "confirmed",
        "sonata_adapter": "results",
    }[part]
    assert told[heard] > found["health"]["later"][heard] > 0
    if part == "firewall":
        assert told["handshakes"] > 0
        assert told["blocks"] == 12, "an operator's, each for two minutes, every ten seconds"
    elif part == "p4runtime_ctrl":
        assert told["blocks"] == 12
        assert told["known_sources"] > 100
    elif part == "coordinator":
        assert told["pruned"] > 0


@pytest.mark.parametrize(("grows", "code"), [(False, 0), (True, 1)])
def test_all_parts_say_which_of_them_grow(grows, code, tmp_path, monkeypatch):
    part = {"hours": 1.0, "mib": [1.0, 2.0], "later_mib_per_hour": 1.0, "noise": 0.5}
    found = {"kitsune": {**part, "growing": False}, "firewall": {**part, "growing": grows}}
    monkeypatch.setattr(soak_state, "run_all", lambda _options: found)
    file = tmp_path / "f.json"
    assert soak_state.main(["--json", str(file)]) == code
    assert json.loads(file.read_text())["growing"] == (["firewall"] if grows else [])


def test_a_recorded_message_comes_later_each_time_and_of_other_strangers():
    """Hosts of the office stay who they are."""
    text = b'{"id":"e","event_time":5000,"since":3000,"number":9,"address":"8.8.8.8","text":"8.8.8.8 to 10.1.1.2"}'
    one = Recorded(1_000_000, "network.evidence.kitsune.scores", "kitsune", text, b"")
    first, again = (decode_value(played(one, turn, START_NS // 1000 + turn * 10**9, turn)) for turn in (0, 1))
    assert first["address"] == "8.8.8.8"
    assert again["address"] not in ("8.8.8.8", "10.1.1.2")
    assert again["text"] == f"{again['address']} to 10.1.1.2"
    assert again["event_time"] - first["event_time"] == 10**12
    assert (again["event_time"] - again["since"], again["number"]) == (2_000, 0)
    assert first["id"] != again["id"]
