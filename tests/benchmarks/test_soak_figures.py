"""A leak is found, noise is none, and what was lost is counted."""

import numpy as np
import pytest

from benchmarks.soak_figures import figures, lost_in
from benchmarks.soak_slope import medians, slope

MINUTES = np.arange(90) / 60


def noise(seed: int) -> np.ndarray:
    """Memory that goes up and down over minutes, kB."""
    steps = np.random.default_rng(seed).normal(0, 50, len(MINUTES))
    return np.convolve(steps, np.ones(6), "same")


@pytest.mark.parametrize("seed", range(8))
def test_a_slope_is_found_in_noise_with_an_interval_that_holds_it(seed):
    found = slope(list(MINUTES), list(50_000 + 2_000 * MINUTES + noise(seed)))
    assert found.low < 2_000 < found.high
    assert found.grows
    assert found.noise < 1_000


def test_noise_alone_seldom_grows():
    """One series in two hundred may lie above the interval of 99 %; series of neighbours that agree, some more."""
    grown = [slope(list(MINUTES), list(50_000 + noise(seed))).grows for seed in range(100, 140)]
    assert sum(grown) <= 3


def test_outliers_do_not_move_a_slope():
    """A process that was sampled while it forked."""
    values = 50_000 + noise(1)
    values[::9] += 40_000
    assert abs(slope(list(MINUTES), list(values)).value) < 500


def test_a_slope_of_a_few_values_is_refused():
    with pytest.raises(ValueError, match="8 values"):
        slope([1.0, 2.0], [1.0, 2.0])


def test_medians_leave_the_unfinished_span_out():
    assert medians([0, 20, 40, 60, 80, 120], [1, 9, 2, 5, 7, 99], 60) == ([30.0, 90.0], [2.0, 6.0])


def sample(seconds: float, **processes: float) -> dict:
    return {
        "seconds": seconds,
        "processes": {
            name: {"anonymous_kb": kb, "pss_kb": kb, "rss_kb": kb, "files": 5 + (kb > 60_000), "threads": 2}
            for name, kb in processes.items()
        },
        "bytes": {"archive": 1000 * seconds, "logs": 10, "state": 10},
        "restarts": 0,
        "sent": 300 * seconds,
        "came": 300 * seconds - 2,
        "stopped": 0,
        "lost": {"frames": 2, "gaps": 1},
        "client": {},
    }


def test_a_leaking_process_is_named_and_a_steady_one_is_not():
    """Also one that fills a cache while the run is warming up; one that came a minute ago is not judged."""
    steady = noise(3)
    samples = [
        sample(
            float(at),
            leaking=50_000 + 5 * at,
            steady=50_000 + steady[at // 60] / 10,
            filling=50_000 + 10 * min(at, 600) + steady[at // 60] / 10,
            **({"young": 1_000.0} if at > 5_200 else {}),
        )
        for at in range(0, 5_400, 5)
    ]
    found = figures(samples, 900)
    assert found["growing"] == ["leaking"]
    assert found["slope_kb_per_hour"]["leaking"] == pytest.approx(18_000)
    assert found["not_judged"] == ["young"]
    assert found["more_files"] == ["leaking"]
    assert not found["more_threads"]
    assert found["lost"] == 3
    assert found["pps"] == pytest.approx(300)
    assert found["bytes"]["archive"]["per_hour"] == pytest.approx(3_600_000)


def test_figures_of_nothing_are_refused():
    with pytest.raises(ValueError, match="no samples"):
        figures([], 900)


def test_losses_of_all_apps_are_summed():
    """From what the Coordinator's /health has of them; the page's count of switches is no list."""
    health = {
        "apps": {
            "dashboard": {"health": {"app": {"switches": 27}, "engine": {"receiving": {"gaps": 2}}}},
            "kitsune": {"health": {"engine": {"receiving": {"gaps": 1}, "archive": {"lost": 4}}}},
            "p4runtime_ctrl": {"health": {"app": {"switches": [{"switch": "s1", "lost": 3}]}}},
        }
    }
    found = lost_in(health)
    assert (found["gaps"], found["archive"], found["packet_ins"]) == (3, 4, 3)
    assert lost_in({})["gaps"] == 0
