"""Decoders with known defects, for the harness to find."""

import json
import os
import signal

from benchmarks.hostile_mutation import mutate_json
from benchmarks.hostile_target import DecoderTarget


def _sound(data: bytes) -> object:
    return json.loads(data)


def _wrong_exception(data: bytes) -> object:
    found = json.loads(data)
    return found["a"] + 1


def _hangs(data: bytes) -> None:
    while data.endswith(b"\xff"):
        pass


def _dies(data: bytes) -> None:
    if data.startswith(b"\xff"):
        os.kill(os.getpid(), signal.SIGSEGV)


_kept: list[bytes] = []


def _hoards(data: bytes) -> None:
    _kept.append(bytes(1 << 19) + data)


_SEED = b'{"a": 1}'
_ERRORS = (ValueError, RecursionError)
TARGETS = (
    DecoderTarget("sound", _sound, _ERRORS, (_SEED,), mutate_json),
    DecoderTarget("wrong exception", _wrong_exception, _ERRORS, (_SEED,), mutate_json),
    DecoderTarget("hang", _hangs, (), (_SEED,)),
    DecoderTarget("hoard", _hoards, (), (_SEED,)),
    DecoderTarget("death", _dies, (), (_SEED,)),
)
