"""Random expressions in both languages against an evaluator on unbounded integers."""

from random import Random

import pytest

from dataplane.compiler.c_code import generate
from dataplane.compiler.layout import make
from dataplane.compiler.simplify import bounds, simplify
from dataplane.errors import Unsupported
from dataplane.v1model.switch import Switch
from dataplane.v1model.tree import Binary, Const, Expression, FieldRef, Unary
from tests.dataplane.compiler.expressions import (
    INPUTS,
    SIGNED,
    WIDTHS,
    layout,
    pack,
    program,
    random_expression,
)
from tests.dataplane.loading import MAKERS
from tests.naive.expressions import evaluate, stored

_EXPRESSIONS = 60
_INPUTS = 40


def random_values(random: Random) -> dict[str, int]:
    values = {}
    for f in INPUTS:
        raw = random.choice([0, 1, (1 << f.width) - 1, 1 << (f.width - 1), random.getrandbits(f.width)])
        values[f.name] = raw - (1 << f.width) if f.signed and raw >> (f.width - 1) else raw
    return values


@pytest.mark.parametrize("seed", range(6))
def test_bounds_hold_and_simplification_changes_nothing(seed):
    random = Random(seed)
    for _ in range(300):
        e = random_expression(random, 4)
        try:
            limit, simple = bounds(e), simplify(e)
        except Unsupported:
            continue
        for _ in range(5):
            values = random_values(random)
            try:
                value = evaluate(e, values)
            except (OverflowError, MemoryError):
                continue
            if max(abs(limit.low), abs(limit.high)).bit_length() <= 512:
                assert limit.low <= value <= limit.high
            assert evaluate(simple, values) == value


@pytest.mark.parametrize("seed", range(4))
def test_both_languages_compute_what_the_evaluator_does(seed):
    random = Random(seed)
    chosen: list[tuple[tuple[int, bool, bool], Expression]] = []
    while len(chosen) < _EXPRESSIONS:
        e = random_expression(random, 3)
        size = (random.choice(WIDTHS), False, random.random() < 0.1)
        if random.random() < 0.25:
            size = (random.choice(SIGNED), True, random.random() < 0.3)
        if size[2] and size[0] > 64:
            continue
        if _accepted(e, size):
            chosen.append((size, e))
    fields = layout([size for size, _ in chosen], "r")
    targets = [(f, chosen[i][1] if i < len(chosen) else None) for i, f in enumerate(fields)]
    switches = [Switch(program(targets), maker=maker) for maker in MAKERS]
    for _ in range(_INPUTS):
        values = random_values(random)
        expected = {f.name: stored(evaluate(e, values), f) for f, e in targets if e is not None}
        for maker, switch in zip(MAKERS, switches, strict=True):
            result = switch.process(1, pack(INPUTS, values), 0)
            assert result.outputs == [(1, pack(fields, expected))], maker
    for switch in switches:
        switch.close()


def _accepted(e: Expression, size: tuple[int, bool, bool]) -> bool:
    """Neither too wide for the C back end nor for the evaluator's patience."""
    fields = layout([size], "r")
    made = program([(f, e if i == 0 else None) for i, f in enumerate(fields)])
    try:
        generate(made, make(made))
    except Unsupported:
        return False
    return True


def test_masks_that_do_nothing_are_dropped():
    f = FieldRef("given", INPUTS[4])
    assert simplify(Binary("&", f, Const(0xFFFF))) == f
    assert simplify(Binary("&", Binary("&", f, Const(0xFF)), Const(0xFFFF))) == Binary("&", f, Const(0xFF))
    assert simplify(Binary("|", f, Const(0))) == f
    assert simplify(Unary("b2d", Binary("==", f, f))) == Binary("==", f, f)
    assert simplify(Binary("&", Const(0xABC), Const(0xF0))) == Const(0xB0)


def test_what_needs_more_than_512_bits_is_refused():
    wide = FieldRef("given", next(f for f in INPUTS if f.width == 512))
    comparison = Binary("<", Binary("+", wide, wide), wide)
    assert not _accepted(comparison, (1, False, False))
    assert _accepted(Binary("+", wide, wide), (512, False, False)), "modulo 2^512 is enough here"
