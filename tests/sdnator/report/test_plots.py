"""The picture shows what it should, at any size of input, without a display."""

import io

import numpy as np
import pytest
from PIL import Image

from sdnator.replay.packet_accounting import PacketState
from sdnator.report.plots import ATTACK, BENIGN, BLOCK, DROPPED, Curve, draw


def _curve(packets: int = 3_000, **changes) -> Curve:
    time = np.linspace(0, 100, packets)
    state = np.full(packets, PacketState.SCORED, np.uint8)
    state[: packets // 3] = PacketState.TRAIN
    score = np.where(state == PacketState.SCORED, 0.01, np.nan)
    fields = {"title": "a pass", "time_s": time, "score": score, "state": state, "attack": None} | changes
    return Curve(**fields)


def _has(png: bytes, colour: str) -> bool:
    pixels = np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)
    wanted = np.array(list(bytes.fromhex(colour[1:])))
    return bool((np.abs(pixels - wanted).max(axis=2) < 12).any())


def test_colours_of_what_happened():
    """Benign, attack, dropped and blocks each have their colour; what is absent has none."""
    attack = np.arange(3_000) > 2_000
    plain = draw([_curve()])
    assert _has(plain, BENIGN)
    assert not _has(plain, ATTACK)
    assert not _has(plain, DROPPED)
    state = _curve().state.copy()
    state[2_500:] = PacketState.DROPPED
    score = np.where(attack, 9.0, 0.01)
    full = draw([_curve(attack=attack, state=state, score=score, blocks=((80.0, "10.0.0.9"),))])
    assert all(_has(full, colour) for colour in (BENIGN, ATTACK, DROPPED, BLOCK))


def test_two_plots_are_taller_than_one():
    one, two = (Image.open(io.BytesIO(draw([_curve()] * number))) for number in (1, 2))
    assert one.width == two.width
    assert two.height > 1.5 * one.height


def test_same_input_same_picture():
    assert draw([_curve()]) == draw([_curve()])


@pytest.mark.parametrize("value", [0.0, 1e16, np.nan, np.inf, 1e-300])
def test_scores_of_any_size(value):
    """Rounding noise and 1e16 are drawn at the edge, NaN not at all; none of them warns."""
    draw([_curve(score=np.full(3_000, value))])


@pytest.mark.parametrize("packets", [0, 1, 3])
def test_few_packets(packets):
    draw([_curve(packets)])


def test_training_only_and_many_blocks():
    draw([_curve(state=np.full(3_000, PacketState.TRAIN, np.uint8))])
    draw([_curve(blocks=tuple((float(n), f"10.0.0.{n}") for n in range(60)))])
