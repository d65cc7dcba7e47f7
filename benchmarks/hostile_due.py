"""What of DUE faces bytes from outside, as targets of a fuzzer: the call, what it may raise, and where to begin.

Anything else that comes out of a target is a finding.
"""

import datetime as dt
from collections.abc import Callable

import msgspec
import numpy as np

from benchmarks.hostile_target import DecoderTarget
from due.codec import Frame, decode_frame, decode_value, encode_frame, encode_single, encode_value, unpack
from due.errors import DecodeError, InvalidKey, RefusedFrame
from due.keys import Key
from due.membership import Assignments, Heartbeat, Incompatible, Registration, ShardGrant
from due.messages import Assignment, Capability, Interest, RecordBatch
from due.routes import Routes
from due.tracker import Tracker

KILLER = bytes.fromhex("4455450199ab6e6574776f726b2e782e79a3617070a4696e73740001009101c091c70603010000000080")
"""An array whose head is an empty map: decoding it once ended the thread in which callbacks run."""


def _head(count: int = 1) -> Frame:
    return Frame("a.b.app", "app", "i", 1, 1, 0, [5] * count, None, [])


def _single(value: object) -> bytes:
    return encode_single(_head(), value)


def _many(*values: object) -> bytes:
    frame = _head(len(values))
    frame.values = list(values)
    return encode_frame(frame)


FRAMES = (
    KILLER,
    _many(1, "x", b"y", None, 2.5),
    _many(msgspec.Raw(encode_value({"a": [1, {"b": dt.datetime(2026, 1, 1, tzinfo=dt.UTC)}]}))),
    _single(RecordBatch({"a": np.arange(20), "b": np.zeros(20, "S3"), "t": np.zeros(20, "M8[ns]")})),
    _single(np.zeros(3, [("port", "u2"), ("at", "<f8", (2,)), ("in", [("x", "u1"), ("y", "U2")])])),
    _single(
        [
            np.arange(6).reshape(2, 3),
            {"deep": np.datetime64(5, "ns")},
            dt.datetime.fromisoformat("2026-01-01"),
        ]
    ),
)
_REGISTRATION = Registration(
    app_id="app",
    instance_id="i",
    revision=1,
    heartbeat=0.5,
    started=1,
    capabilities=(Capability("a.b.app.**", frequency=(1.0, 10.0), delivery="reliable"),),
    interests=(Interest("a.*:x=1|2"),),
)
_ASSIGNMENTS = Assignments(
    app_id="app",
    coordinator="c",
    version=1,
    epoch=1,
    active="i",
    revisions={"i": 1},
    shards={"a.b": ShardGrant("i", 7)},
    assignments=(Assignment("a.b.app.**", 2.5),),
    incompatible=(Incompatible(key="a.b", reason="too fast"),),
)
_HEARTBEAT = Heartbeat(
    app_id="app", instance_id="i", revision=1, written=3, offered=("a.b", "a.c"), held={"a.b": 7}
)


def _received(data: bytes) -> bool:
    """What the dispatcher does with a frame before anybody's code sees it."""
    frame, tracker = decode_frame(data), Tracker(shared=False)
    Routes().find(frame.key, frame.app_id, frame.key.partition(":")[0])
    return all(tracker.admit(frame, reliable=True) for _ in range(2))


def _message(kind: type[Registration | Heartbeat | Assignments]) -> Callable[[bytes], object]:
    return lambda data: kind.from_value(decode_value(data))


TARGETS = (
    DecoderTarget("due frame", decode_frame, (DecodeError,), FRAMES),
    DecoderTarget("due items", unpack, (DecodeError,), FRAMES),
    DecoderTarget("due value", decode_value, (DecodeError,), tuple(frame[4:] for frame in FRAMES)),
    DecoderTarget("due reception", _received, (DecodeError, RefusedFrame), FRAMES),
    DecoderTarget(
        "due key",
        lambda data: Key(data.decode("utf-8", "surrogateescape")).concrete,
        (InvalidKey,),
        (b"a.b-c.*", b"a.b:x=1|%2C,y=*", b"a.**"),
    ),
    *(
        DecoderTarget(
            f"due {type(seed).__name__.lower()}",
            _message(type(seed)),
            (DecodeError, msgspec.ValidationError),
            (encode_value(seed.to_value()),),
        )
        for seed in (_REGISTRATION, _HEARTBEAT, _ASSIGNMENTS)
    ),
)
