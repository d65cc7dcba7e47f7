"""What people read about the model: how far training is, since when it is done, whether scores have drifted."""

import pytest

from sdnator.model_words import headline, model_lines, model_of

TRAINING = {"done": False, "packets": 23_650, "wanted": 55_000, "seconds_left": 185.0}


def test_training_says_how_far_it_is_how_long_it_takes_and_where_packets_come_from():
    ports = [{"name": "s1 port 1", "packets": 20_000}, {"name": "s1 port 2", "packets": 3_650}]
    lines = list(model_lines({**TRAINING, "ports": ports}))
    assert lines[0] == "training 43 %, about 3 min left"
    assert "23,650 of 55,000 packets" in lines[1]
    assert lines[2:] == ["  s1 port 1: 20,000 packets of training", "  s1 port 2: 3,650 packets of training"]


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"seconds_left": 20.0}, "43 %, about 20 s left"),
        ({"seconds_left": 20_000.0}, "43 %, about 6 h left"),
        ({"seconds_left": 1e6}, "43 %, about 12 days left"),
        ({"seconds_left": None}, "43 %, time left unknown"),
        ({"seconds_left": None, "packets": 0}, "0 %, waiting for packets"),
        ({"packets": 54_999}, "99 %"),
    ],
)
def test_the_time_left_in_words(changes, text):
    assert text in headline(TRAINING | changes)


def test_drift_stands_in_the_first_line_and_says_what_to_do():
    model = {"done": True, "trained_at_us": 1_700_000_000_000_000, "trained_s": 3_600, "senders": 12}
    assert headline(model) == "trained until 2023-11-14 22:13 UTC"
    lines = list(
        model_lines(model | {"drifted": True, "drift_share": 0.2, "drift_limit": 0.05, "drift_blocks": 40})
    )
    assert "SCORES HAVE DRIFTED" in lines[0]
    assert any("20.0% of benign packets" in line for line in lines)
    assert "sdnator model retrain" in lines[-1]


def test_a_coordinator_that_knows_nothing_of_kitsune_is_no_fault():
    assert model_of({}) is None
    assert model_of({"apps": {"kitsune": {"health": {"app": {"model": TRAINING}}}}}) == TRAINING
