"""The state's benchmark feeds what it is told to, and says how memory went on."""

import json

from benchmarks import soak_state


def test_a_short_run_gives_every_figure(tmp_path, monkeypatch):
    sizes = iter(range(100, 10_000))
    monkeypatch.setattr(soak_state, "_feed", lambda packets: range(0, packets, packets // 120))
    monkeypatch.setattr(soak_state, "_anonymous_mib", lambda: float(min(next(sizes), 140)))
    file = tmp_path / "f.json"
    assert soak_state.main(["--packets", "1200000", "--json", str(file)]) == 0
    found = json.loads(file.read_text())
    assert (found["packets"], found["later_mib_per_hour"], found["growing"]) == (1_200_000, 0.0, False)
    assert found["mib"][0] < found["mib"][-1] == 140.0


def test_memory_that_grows_to_the_end_ends_with_1(tmp_path, monkeypatch):
    sizes = iter(range(100, 10_000))
    monkeypatch.setattr(soak_state, "_feed", lambda packets: range(0, packets, packets // 120))
    monkeypatch.setattr(soak_state, "_anonymous_mib", lambda: float(next(sizes)))
    assert soak_state.main(["--packets", "1200000", "--json", str(tmp_path / "f.json")]) == 1


def test_the_detector_is_really_fed():
    assert next(soak_state._feed(1)) > 1
