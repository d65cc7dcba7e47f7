"""The generated-Python back end: runs python_code's module with the flow of the v1model switch.

Queues, clones and recirculation happen in the order in which BMv2 enqueues them, one packet at a time.
"""

from collections import deque
from collections.abc import Callable, Sequence
from random import randint
from types import CodeType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataplane.compiler import layout as layouts
from dataplane.compiler import machine as m
from dataplane.compiler.machine import BatchResult, Replicas
from dataplane.v1model.tree import Program
from tests.naive.p4.hashes import HASHES
from tests.naive.p4.python_code import generate
from tests.naive.p4.python_statements import NO_TRUNCATION, Slots
from tests.naive.p4.python_tables import (
    PythonCounters,
    PythonMeters,
    PythonRegisters,
    PythonTable,
)
from tests.naive.p4.sample_encoding import encode_sample

_Packet = list[Any]
INSTANCE_INGRESS_CLONE, INSTANCE_EGRESS_CLONE = 1, 2
INSTANCE_RECIRCULATED, INSTANCE_REPLICATED, INSTANCE_RESUBMITTED = 4, 5, 6
DROP_PORT = 511
MAX_PASSES = 1024
"""Passes through ingress or egress that one frame may cause; BMv2 would loop for ever."""
MAX_FRAME = 65_535
COPIED, FORWARDED = 1, 2


def look(packet: bytes, offset: int, skip: int, width: int) -> int:
    """Bits ahead of the parser's cursor; 0 beyond the end (the generated code has checked)."""
    first, last = offset + skip // 8, offset + (skip + width + 7) // 8
    window = packet[first:last].ljust(last - first, b"\0")
    end = 8 * (last - first) - skip % 8 - width
    return (int.from_bytes(window, "big") >> end) & ((1 << width) - 1)


def two_comp_mod(value: int, width: int) -> int:
    half = 1 << (width - 1)
    return ((value + half) & ((1 << width) - 1)) - half


def usat_cast(value: int, width: int) -> int:
    return min(max(value, 0), (1 << width) - 1)


def sat_cast(value: int, width: int) -> int:
    half = 1 << (width - 1)
    return min(max(value, -half), half - 1)


def _names() -> dict[str, Any]:
    names: dict[str, Any] = {"from_bytes": int.from_bytes, "randint": randint, "look": look}
    names |= {"Digest": m.Digest, "sample": encode_sample}
    names |= {"two_comp_mod": two_comp_mod, "usat_cast": usat_cast, "sat_cast": sat_cast}
    return names | {f"hash_{name}": function for name, function in HASHES.items()}


class PythonMachine:
    """See machine.Machine."""

    def __init__(self, program: Program, cpu_port: int) -> None:
        self.program = program
        self.cpu_port = cpu_port
        text, self.slots = generate(program, layouts.make(program))
        self.text = text
        self.tables = {name: PythonTable(spec) for name, spec in program.tables.items()}
        for spec in program.meters.values():
            if spec.table:
                self.tables[spec.table].meter_unit(spec.unit)
        self.counters = {name: PythonCounters(spec.size) for name, spec in program.counters.items()}
        self.meters = {name: PythonMeters(spec) for name, spec in program.meters.items()}
        self.registers = {name: PythonRegisters(spec.size) for name, spec in program.registers.items()}
        self._arrays = m.array_names(program)
        self._out_of_range = [0] * len(self._arrays)
        code: CodeType = compile(text, "<switch program>", "exec")
        space = _names() | self._state()
        exec(code, space)  # noqa: S102 - our own generated text: of the program only numbers
        self._parse: Callable[[_Packet], int] = space["parse"]
        self._ingress: Callable[[_Packet], None] = space["ingress"]
        self._egress: Callable[[_Packet], None] = space["egress"]
        self._deparse: Callable[[_Packet], bytes] = space["deparse"]
        self._digest: Callable[[_Packet], m.Digest | None] = space["digest"]
        self._at = _Places(self.slots)
        self._sessions: dict[int, tuple[Replicas, int]] = {}
        self._groups: dict[int, Replicas] = {}
        self._ports: frozenset[int] | None = None
        self._counts = dict.fromkeys(m.STATISTICS, 0)
        self._batch = BatchResult()
        self._verdict = 0
        self._budget = 0
        # (to ingress, packet, port): what a pass sends round again waits here, as in BMv2's queues
        self._pending: deque[tuple[bool, _Packet, int]] = deque()

    def _state(self) -> dict[str, Any]:
        """The state's parts under the names that the generated code uses."""
        names: dict[str, Any] = {f"T{i}": t for i, t in enumerate(self.tables.values())}
        names |= {f"C{i}": c for i, c in enumerate(self.counters.values())}
        names |= {f"M{i}": x.meters for i, x in enumerate(self.meters.values())}
        names |= {f"R{i}": r.values for i, r in enumerate(self.registers.values())}
        names |= {f"D{number}": spec.name for number, spec in self.program.digests.items()}
        return names | {"OUT_OF_RANGE": self._out_of_range}

    # -- packets ------------------------------------------------------------------------------------

    def run(self, port: int, frames: Sequence[bytes], times_us: Sequence[int]) -> BatchResult:
        batch = self._batch = BatchResult()
        self._outputs: list[tuple[int, bytes]] = []
        batch.outputs = self._outputs
        verdicts = bytearray()
        for frame, now in zip(frames, times_us, strict=True):
            self._verdict = 0
            self._budget = MAX_PASSES
            self._counts["frames"] += 1
            if len(frame) > MAX_FRAME:
                self._counts["oversized"] += 1
            else:
                self._arrive(port, frame, now & 0xFFFFFFFFFFFF)
            if not self._verdict:
                self._counts["dropped"] += 1
            verdicts.append(self._verdict)
        batch.verdicts = bytes(verdicts)
        return batch

    def run_block(
        self, port: int, data: bytes, lengths: NDArray[np.uint32], times_us: NDArray[np.int64]
    ) -> BatchResult:
        ends = np.cumsum(lengths, dtype=np.int64).tolist()
        frames = [data[start:end] for start, end in zip([0, *ends], ends, strict=False)]
        return self.run(port, frames, times_us.tolist())

    def _arrive(self, port: int, frame: bytes, now: int) -> None:
        p = self._fresh(frame, now, len(frame), len(frame))
        at = self._at
        p[at.ingress_port] = port
        p[at.packet_length] = len(frame)
        if at.ingress_global_timestamp:
            p[at.ingress_global_timestamp] = now
        self._ingress_pass(p, port)
        while self._pending:
            again, copy, place = self._pending.popleft()
            if again:
                self._ingress_pass(copy, place)
            else:
                self._egress_pass(copy, place)

    def _fresh(self, frame: bytes, now: int, arrived: int, length: int) -> _Packet:
        p = self.slots.initial.copy()
        at = self._at
        p[at.PACKET], p[at.NOW], p[at.ARRIVED], p[at.LENGTH] = frame, now, arrived, length
        return p

    def _spend(self) -> bool:
        self._budget -= 1
        if self._budget < 0:
            self._counts["loop_drops"] += 1
            return False
        return True

    def _ingress_pass(self, p: _Packet, port: int) -> None:
        if not self._spend():
            return
        at = self._at
        length = p[at.LENGTH]
        if self._parse(p):
            self._counts["parser_errors"] += 1
        self._ingress(p)
        p[at.EXIT] = 0
        if p[at.CLONE]:
            self._clone_ingress(p, port, length)
        if p[at.DIGEST]:
            digest = self._digest(p)
            if digest is not None:
                self._batch.digests.append(digest)
        if p[at.RESUBMIT]:
            self._resubmit(p, port, length)
        elif at.mcast_grp and p[at.mcast_grp]:
            p[at.instance_type] = INSTANCE_REPLICATED
            self._replicate(p, self._groups.get(p[at.mcast_grp], ()))
        elif p[at.egress_spec] != DROP_PORT:
            p[at.instance_type] = 0
            self._egress_pass(p, p[at.egress_spec])

    def _clone_ingress(self, p: _Packet, port: int, length: int) -> None:
        at = self._at
        session = self._sessions.get(p[at.CLONE] & 0x7FFF)
        p[at.CLONE] = 0
        if session is None:
            return
        copy = self._fresh(p[at.PACKET], p[at.NOW], p[at.ARRIVED], length)
        copy[at.ingress_port] = port
        self._parse(copy)
        self._keep(p, copy, p[at.CLONE_LIST], INSTANCE_INGRESS_CLONE)
        self._replicate(copy, session[0], session[1])

    def _keep(self, p: _Packet, copy: _Packet, field_list: int, instance: int) -> None:
        """Metadata of a copy: zero, but for a field list of the original."""
        for slot in self.slots.metadata:
            copy[slot] = 0
        for ref in self.program.field_lists.get(field_list, ()):
            copy[self.slots.field(ref)] = p[self.slots.field(ref)]
        copy[self._at.instance_type] = instance

    def _replicate(
        self, p: _Packet, replicas: Replicas, packet_length: int = 0, *, later: bool = False
    ) -> None:
        at = self._at
        for port, instance in replicas:
            copy = p.copy()
            copy[at.CLONE] = copy[at.DIGEST] = copy[at.RESUBMIT] = copy[at.RECIRCULATE] = 0
            copy[at.TRUNCATE] = packet_length or NO_TRUNCATION
            if at.egress_rid:
                copy[at.egress_rid] = instance
            if later:
                self._pending.append((False, copy, port))
            else:
                self._egress_pass(copy, port)

    def _resubmit(self, p: _Packet, port: int, length: int) -> None:
        at = self._at
        again = self._fresh(p[at.PACKET], p[at.NOW], p[at.ARRIVED], length)
        self._keep(p, again, p[at.RESUBMIT], INSTANCE_RESUBMITTED)
        again[at.packet_length] = length
        self._pending.append((True, again, port))

    def _egress_pass(self, p: _Packet, port: int) -> None:
        if not self._spend():
            return
        at = self._at
        if at.egress_global_timestamp:
            p[at.egress_global_timestamp] = p[at.NOW]
        if at.enq_timestamp:
            p[at.enq_timestamp] = p[at.NOW] & 0xFFFFFFFF
        p[at.egress_port] = port
        p[at.egress_spec] = 0
        p[at.packet_length] = p[at.LENGTH]
        self._egress(p)
        copy = self._clone_egress(p) if p[at.CLONE] else None
        if p[at.egress_spec] != DROP_PORT:
            frame = self._deparse(p)
            if p[at.RECIRCULATE]:
                self._recirculate(p, frame)
            else:
                self._send(port, frame)
        if copy is not None:
            self._replicate(*copy, later=True)

    def _clone_egress(self, p: _Packet) -> tuple[_Packet, Replicas, int] | None:
        at = self._at
        session = self._sessions.get(p[at.CLONE] & 0x7FFF)
        p[at.CLONE] = 0
        if session is None:
            return None
        copy = p.copy()
        copy[at.EXIT] = 0
        self._keep(p, copy, p[at.CLONE_LIST], INSTANCE_EGRESS_CLONE)
        return copy, session[0], session[1]

    def _recirculate(self, p: _Packet, frame: bytes) -> None:
        at = self._at
        again = self._fresh(frame, p[at.NOW], len(frame), len(frame))
        self._keep(p, again, p[at.RECIRCULATE], INSTANCE_RECIRCULATED)
        again[at.packet_length] = len(frame)
        self._pending.append((True, again, again[at.ingress_port]))

    def _send(self, port: int, frame: bytes) -> None:
        if port == self.cpu_port:
            self._batch.packet_ins.append(frame)
            self._verdict |= COPIED
        elif self._ports is None or port in self._ports:
            self._outputs.append((port, frame))
            self._verdict |= FORWARDED
        else:
            self._counts["no_such_port"] += 1

    # -- control ------------------------------------------------------------------------------------

    def set_clone_session(self, session: int, replicas: Replicas | None, packet_length: int) -> None:
        if replicas is None:
            self._sessions.pop(session, None)
        else:
            self._sessions[session] = (replicas, packet_length)

    def set_multicast_group(self, group: int, replicas: Replicas | None) -> None:
        if replicas is None:
            self._groups.pop(group, None)
        else:
            self._groups[group] = replicas

    def set_ports(self, ports: frozenset[int] | None) -> None:
        self._ports = ports

    def statistics(self) -> dict[str, int]:
        return dict(self._counts)

    def out_of_range(self) -> dict[str, int]:
        return {name: n for name, n in zip(self._arrays, self._out_of_range, strict=True) if n}

    def close(self) -> None:
        """Nothing to free."""


class _Places:
    """Slots that the flow itself touches; 0 (the frame's own) = the program has no such field."""

    def __init__(self, slots: Slots) -> None:
        def standard(name: str) -> int:
            return slots.index.get((layouts.STANDARD, name), 0)

        self.PACKET = slots.engine("PACKET")
        self.NOW = slots.engine("NOW")
        self.ARRIVED = slots.engine("ARRIVED")
        self.LENGTH = slots.engine("LENGTH")
        self.TRUNCATE = slots.engine("TRUNCATE")
        self.CLONE = slots.engine("CLONE")
        self.CLONE_LIST = slots.engine("CLONE_LIST")
        self.DIGEST = slots.engine("DIGEST")
        self.RESUBMIT = slots.engine("RESUBMIT")
        self.RECIRCULATE = slots.engine("RECIRCULATE")
        self.EXIT = slots.engine("EXIT")
        self.ingress_port = standard("ingress_port")
        self.egress_spec = standard("egress_spec")
        self.egress_port = standard("egress_port")
        self.instance_type = standard("instance_type")
        self.packet_length = standard("packet_length")
        self.enq_timestamp = standard("enq_timestamp")
        self.ingress_global_timestamp = standard("ingress_global_timestamp")
        self.egress_global_timestamp = standard("egress_global_timestamp")
        self.mcast_grp = standard("mcast_grp")
        self.egress_rid = standard("egress_rid")
