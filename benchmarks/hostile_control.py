"""What a switch sends to the controller: its program, packet-ins, digests, entries, errors."""

import random
from collections.abc import Sequence
from functools import cache
from typing import Any

import grpc
from google.protobuf.message import DecodeError

from apps.p4runtime_ctrl.errors import ControllerError, Malformed, P4InfoError
from apps.p4runtime_ctrl.southbound import session
from apps.p4runtime_ctrl.southbound.counts_in import CountReader
from apps.p4runtime_ctrl.southbound.digest_in import DigestReader
from apps.p4runtime_ctrl.southbound.loss_tracker import LossTracker
from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
from apps.p4runtime_ctrl.southbound.packet_in import PacketReader
from apps.p4runtime_ctrl.state.desired_state import check_entry
from apps.p4runtime_ctrl.state.mac_learning import LearnSettings, MacLearning
from apps.packets import PACKET_COLUMNS, read_columns, read_frames
from benchmarks.hostile_messages import frames
from benchmarks.hostile_mutation import mutate_protobuf, mutate_text
from benchmarks.hostile_target import DecoderTarget
from p4rt import p4runtime, status
from sdnator.p4_program import find
from sdnator.testing.product_program import packet_in

_BASE_US = 1_700_000_000_000_000


@cache
def _text() -> str:
    return find().p4info.read_text(encoding="utf-8")


@cache
def _program() -> ProgramInfo:
    return ProgramInfo.from_text(_text())


def _p4info(data: bytes) -> None:
    """A program of one's own: read, then used by every reader."""
    program = ProgramInfo.from_text(data.decode("utf-8", "replace"))
    for make in (PacketReader, DigestReader, CountReader):
        make(program, _BASE_US, LossTracker())
    MacLearning(program, LearnSettings(ports=(1, 2)))


def _packets(data: bytes) -> None:
    """A packet-in before a genuine one."""
    message = p4runtime.StreamMessageResponse.FromString(data)
    progress = LossTracker()
    found = PacketReader(_program(), _BASE_US, progress).read(
        [message.packet, packet_in(1, frame=frames(1)[0])]
    )
    batch = read_columns(found.batch(read_frames), PACKET_COLUMNS, "packets")
    cells = 0 if found.cells is None else len(found.cells)
    assert len(batch) >= 1
    assert len(batch) + cells + progress.malformed >= 1


def _digests(data: bytes) -> None:
    lists = [p4runtime.StreamMessageResponse.FromString(data).digest]
    reports = DigestReader(_program(), _BASE_US, LossTracker()).read(lists)
    read_columns(reports.counted(1), PACKET_COLUMNS, "digests")
    counts = CountReader(_program(), _BASE_US, LossTracker()).read(lists)
    counts.of(1)
    MacLearning(_program(), LearnSettings(ports=(1, 2), limit=16)).learn(lists)


def _entry(data: bytes) -> None:
    entry = check_entry(p4runtime.TableEntry.FromString(data))
    _program().describe(entry)
    learning = MacLearning(_program(), LearnSettings(ports=(1, 2), limit=16))
    learning.adopt([entry])
    learning.forget(entry)


class _Refusal(Exception):
    """As grpc raises it."""

    def __init__(self, packed: bytes) -> None:
        super().__init__()
        self._packed = packed

    def trailing_metadata(self) -> Any:
        return (("grpc-status-details-bin", self._packed),)

    def code(self) -> grpc.StatusCode:
        return grpc.StatusCode.UNKNOWN

    def details(self) -> str:
        return repr(self._packed)


def _error(data: bytes) -> None:
    session._details(_Refusal(data))
    session.translated(_Refusal(data), "s1")


def _digest_lists() -> tuple[bytes, ...]:
    made = []
    for digest in _program().message.digests:
        response = p4runtime.StreamMessageResponse()
        response.digest.digest_id = digest.preamble.id
        for _ in range(2):
            row = response.digest.data.add().struct
            for _, width in _program().digest(digest.preamble.name):
                row.members.add(bitstring=b"\1" if width < 64 else b"\1" * 6)
        made.append(response.SerializeToString())
    return tuple(made)


def _entries() -> tuple[bytes, ...]:
    smac, block = _program().table("ingress.smac"), _program().table("ingress.block_src")
    made = []
    for table in (smac, block):
        entry = p4runtime.TableEntry(table_id=table.id, idle_timeout_ns=5)
        for field in table.fields:
            entry.match.add(field_id=field.id).exact.value = b"\1"
        entry.action.action.action_id = next(iter(table.actions)).id if table.actions else 1
        entry.action.action.params.add(param_id=1, value=b"\3")
        made.append(entry.SerializeToString())
    return tuple(made)


def _packet_ins() -> tuple[bytes, ...]:
    found = [packet_in(number, frame=frame) for number, frame in enumerate(frames(12), 1)]
    found.append(packet_in(1, reason=1, frame=bytes(52)))
    return tuple(p4runtime.StreamMessageResponse(packet=one).SerializeToString() for one in found)


def _errors() -> tuple[bytes, ...]:
    whole = status.Status(code=2, message="Write: 1 of 2 failed")
    for code in (0, 6):
        whole.details.add().Pack(p4runtime.Error(canonical_code=code, message="there"))
    return (whole.SerializeToString(),)


def _mutate_p4info(chance: random.Random, seeds: Sequence[bytes]) -> bytes:
    """The text; most of it is lines, of which single ones matter."""
    return mutate_text(chance, seeds)


TARGETS = (
    DecoderTarget(
        "controller p4info", _p4info, (P4InfoError, ControllerError), (_text().encode(),), _mutate_p4info
    ),
    DecoderTarget("controller packet-in", _packets, (DecodeError,), _packet_ins(), mutate_protobuf),
    DecoderTarget("controller digest", _digests, (DecodeError,), _digest_lists(), mutate_protobuf),
    DecoderTarget("controller standing entry", _entry, (DecodeError, Malformed), _entries(), mutate_protobuf),
    DecoderTarget("controller write error", _error, (), _errors(), mutate_protobuf),
)
