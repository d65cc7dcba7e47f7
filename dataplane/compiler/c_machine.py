"""The generated-C back end: c_code's unit behind the interface of machine.Machine."""

import secrets
import struct
import weakref
from collections.abc import Sequence
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataplane.compiler import layout as layouts
from dataplane.compiler import machine as m
from dataplane.compiler.c_build import compiled_library
from dataplane.compiler.c_code import generate
from dataplane.compiler.c_statements import key_places, table_words, words
from dataplane.compiler.machine import BatchResult, Digest, FrameSlices, KeyPlace, Replicas, Rule
from dataplane.compiler.samples import Samples
from dataplane.errors import DataplaneError
from dataplane.v1model.tree import ArraySpec, Node, Program, TableNode, TableSpec

_DECLARATIONS = """
void *dp_new(uint32_t cpu_port);
void dp_free(void *h);
uint64_t dp_run(void *h, uint32_t port, uint32_t count, const char *data, const uint32_t *lengths,
                const uint64_t *times, uint8_t *verdicts);
const uint8_t *dp_output(void *h);
uint64_t dp_marks(void *h, const uint64_t **to);
uint64_t dp_samples(void *h, uint32_t id, uint64_t seed, uint8_t *to, uint64_t *ends, uint64_t *hashes);
void dp_statistics(void *h, uint64_t *to);
void dp_out_of_range(void *h, uint64_t *to);
void dp_ports(void *h, const char *exists);
void dp_session(void *h, uint32_t number, uint32_t count, const uint32_t *pairs, uint32_t length);
void dp_group(void *h, uint32_t number, uint32_t count, const uint32_t *pairs);
void dp_insert(void *h, uint32_t t, uint32_t slot, const char *value, const char *mask,
               uint32_t ranges, const uint64_t *range, uint32_t rank, int64_t action,
               const char *params, uint64_t now);
void dp_replace(void *h, uint32_t t, uint32_t slot, int64_t action, const char *params);
void dp_remove(void *h, uint32_t t, uint32_t slot);
void dp_default(void *h, uint32_t t, int64_t action, const char *params);
void dp_entry(void *h, uint32_t t, uint32_t slot, uint64_t *to);
void dp_set_entry(void *h, uint32_t t, uint32_t slot, uint32_t which, uint64_t a, uint64_t b);
void dp_entry_meter(void *h, uint32_t t, uint32_t slot, const uint64_t *rates);
uint64_t *dp_counter(void *h, uint32_t array, uint32_t index);
void dp_meter(void *h, uint32_t array, uint32_t index, const uint64_t *rates);
uint64_t *dp_register(void *h, uint32_t array, uint64_t limb);
"""
_NONE = 0xFFFFFFFF
_BLOCK = 256
_OUT_PORT, _OUT_CPU, _OUT_DIGEST = 1, 2, 3
_FEW = 32
"""Frames for which columns cost more than they save."""
_RECORD = struct.Struct("<III4x")
_WORD = (1 << 64) - 1
_Rates = tuple[int, int, int, int]


class _Native:
    """The library's handle, shared by the parts of one machine; freed by close() or with the last of them."""

    def __init__(self, text: str, cpu_port: int) -> None:
        self.ffi, self.lib = compiled_library(text, _DECLARATIONS)
        handle = self.lib.dp_new(cpu_port)
        if handle == self.ffi.NULL:
            raise MemoryError("no memory for the switch's state")
        self._handle: Any = handle
        self._free = weakref.finalize(self, self.lib.dp_free, handle)

    @property
    def handle(self) -> Any:
        """Raises DataplaneError once closed: the state behind it is gone."""
        if self._handle is None:
            raise DataplaneError("the switch is closed")
        return self._handle

    def close(self) -> None:
        self._handle = None
        self._free()

    def rates(self, rates: _Rates | None) -> Any:
        return self.ffi.NULL if rates is None else self.ffi.new("uint64_t[4]", rates)


class CTable:
    """See machine.TableStore."""

    def __init__(self, native: _Native, number: int, spec: TableSpec, stride: int) -> None:
        self._ffi, self._lib, self._native = native.ffi, native.lib, native
        self._number = number
        self._words, places = key_places(spec) if spec.keys else (0, ())
        self.place = KeyPlace(places)
        self._stride = stride
        self._no_params = bytes(8 * stride)
        self._sizes: dict[int, tuple[int, ...]] = {-1: ()}
        self._state = self._ffi.new("uint64_t[3]")

    def know_action(self, number: int, counts: tuple[int, ...]) -> None:
        """Words of each parameter of an action."""
        self._sizes[number] = tuple(8 * count for count in counts)

    def _params(self, action: int, params: Sequence[int]) -> bytes:
        if not params:
            return self._no_params
        sizes = self._sizes[action]
        data = b"".join([v.to_bytes(size, "little") for v, size in zip(params, sizes, strict=True)])
        return data.ljust(8 * self._stride, b"\0")

    def insert(self, slot: int, rule: Rule, action: int, params: Sequence[int], now_us: int) -> None:
        value, mask, ranges, rank = rule
        parts = self._ffi.NULL
        if ranges:
            flat = chain.from_iterable(
                (r.shift // 64, r.shift % 64, (1 << r.width) - 1, r.low, r.high) for r in ranges
            )
            parts = self._ffi.new("uint64_t[]", list(flat))
        size = 8 * self._words
        self._lib.dp_insert(
            self._native.handle,
            self._number,
            slot,
            value.to_bytes(size, "little"),
            mask.to_bytes(size, "little"),
            len(ranges),
            parts,
            rank,
            action,
            self._params(action, params),
            now_us,
        )

    def replace(self, slot: int, action: int, params: Sequence[int]) -> None:
        self._lib.dp_replace(self._native.handle, self._number, slot, action, self._params(action, params))

    def remove(self, slot: int) -> None:
        self._lib.dp_remove(self._native.handle, self._number, slot)

    def set_default(self, action: int, params: Sequence[int]) -> None:
        self._lib.dp_default(self._native.handle, self._number, action, self._params(action, params))

    def _entry(self, slot: int) -> tuple[int, int, int]:
        state = self._state
        self._lib.dp_entry(self._native.handle, self._number, slot, state)
        return state[0], state[1], state[2]

    def counter(self, slot: int) -> tuple[int, int]:
        return self._entry(slot)[:2]

    def set_counter(self, slot: int, packets: int, octets: int) -> None:
        self._lib.dp_set_entry(self._native.handle, self._number, slot, 0, packets & _WORD, octets & _WORD)

    def set_meter(self, slot: int, rates: _Rates | None) -> None:
        self._lib.dp_entry_meter(self._native.handle, self._number, slot, self._native.rates(rates))

    def hit_us(self, slot: int) -> int:
        return self._entry(slot)[2]

    def touch(self, slot: int, now_us: int) -> None:
        self._lib.dp_set_entry(self._native.handle, self._number, slot, 1, now_us, 0)


class CCounters:
    """See machine.CounterStore."""

    def __init__(self, native: _Native, number: int) -> None:
        self._native, self._number = native, number

    def _cell(self, index: int) -> Any:
        return self._native.lib.dp_counter(self._native.handle, self._number, index)

    def read(self, index: int) -> tuple[int, int]:
        cell = self._cell(index)
        return cell[0], cell[1]

    def write(self, index: int, packets: int, octets: int) -> None:
        cell = self._cell(index)
        cell[0], cell[1] = packets & _WORD, octets & _WORD


class CMeters:
    """See machine.MeterStore."""

    def __init__(self, native: _Native, number: int) -> None:
        self._native, self._number = native, number

    def configure(self, index: int, rates: _Rates | None) -> None:
        native = self._native
        native.lib.dp_meter(native.handle, self._number, index, native.rates(rates))


class CRegisters:
    """See machine.RegisterStore."""

    def __init__(self, native: _Native, number: int, spec: ArraySpec) -> None:
        self._native, self._number = native, number
        self._words, self._size = words(spec.width), spec.size

    def _cell(self, index: int) -> Any:
        return self._native.lib.dp_register(self._native.handle, self._number, index * self._words)

    def read(self, index: int) -> int:
        cell = self._cell(index)
        return sum(cell[i] << 64 * i for i in range(self._words))

    def write(self, index: int, value: int) -> None:
        cell = self._cell(index)
        for i in range(self._words):
            cell[i] = (value >> 64 * i) & _WORD

    def written(self) -> list[tuple[int, int]]:
        width = 8 * self._words
        memory = self._native.ffi.buffer(self._cell(0), self._size * width)
        found = []
        for first in range(0, self._size, _BLOCK):
            block = memory[first * width : (first + _BLOCK) * width]
            if block.count(0) == len(block):
                continue  # most of a large array, and of a million cells none may be looked at one by one
            for at in range(0, len(block), width):
                value = int.from_bytes(block[at : at + width], "little")
                if value:
                    found.append((first + at // width, value))
        return found


class CMachine:
    """See machine.Machine."""

    def __init__(self, program: Program, cpu_port: int) -> None:
        """Raises CompilerError, Unsupported."""
        self.text = generate(program, layouts.make(program))
        native = self._native = _Native(self.text, cpu_port)
        self.tables = {
            name: CTable(native, i, spec, table_words(program, spec))
            for i, (name, spec) in enumerate(program.tables.items())
        }
        for pipeline in (program.ingress, program.egress):
            for node in pipeline.nodes.values():
                self._know_actions(program, node)
        self.counters = {name: CCounters(native, i) for i, name in enumerate(program.counters)}
        self.meters = {name: CMeters(native, i) for i, name in enumerate(program.meters)}
        self.registers = {
            name: CRegisters(native, i, spec) for i, (name, spec) in enumerate(program.registers.items())
        }
        self._digests = {number: spec.name for number, spec in program.digests.items()}
        self._arrays = m.array_names(program)
        self._seed = secrets.randbits(64)
        """Of hashes, so that nobody can choose samples that meet."""

    def _know_actions(self, program: Program, node: Node) -> None:
        table = self.tables.get(node.name)
        if table is not None and isinstance(node, TableNode):
            for number in node.actions:
                params = program.actions[number].spec.params
                table.know_action(number, tuple(words(p.width) for p in params))

    def run(self, port: int, frames: Sequence[bytes], times_us: Sequence[int]) -> BatchResult:
        count, ffi = len(frames), self._native.ffi
        if count < _FEW:
            lengths = ffi.new("uint32_t[]", [len(f) for f in frames])
            times = ffi.new("uint64_t[]", [t & _WORD for t in times_us])
            data = frames[0] if count == 1 else b"".join(frames)
            return self._collected(*self._run(port, data, lengths, times, count))
        places = self._places(np.fromiter(map(len, frames), "u4", count), np.fromiter(times_us, "i8", count))
        records, verdicts = self._run(port, b"".join(frames), *places, count)
        kinds, slices = self._sorted_out(records)
        reported = slices.of(kinds == _OUT_DIGEST)
        names = [self._digests[number] for number in reported.ports.tolist()]
        return BatchResult(
            outputs=list(slices.of(kinds == _OUT_PORT)),
            packet_ins=slices.of(kinds == _OUT_CPU).frames(),
            digests=list(map(Digest, names, reported.frames())),
            verdicts=verdicts,
        )

    def run_block(
        self, port: int, data: bytes, lengths: NDArray[np.uint32], times_us: NDArray[np.int64]
    ) -> BatchResult:
        sizes, times = np.require(lengths, "u4", "C"), np.require(times_us, "i8", "C")
        if int(sizes.sum(dtype=np.int64)) > len(data) or len(times) != len(sizes):
            raise DataplaneError(f"{len(sizes)} frames do not fit into a block of {len(data)} bytes")
        records, verdicts = self._run(port, data, *self._places(sizes, times), len(sizes))
        if not records:
            return BatchResult(verdicts=verdicts)
        kinds, slices = self._sorted_out(records)
        reported = np.bincount(slices.ports[kinds == _OUT_DIGEST])
        return BatchResult(
            outputs=slices.of(kinds == _OUT_PORT),
            packet_ins=slices.of(kinds == _OUT_CPU).frames(),
            samples={
                self._digests[number]: self._samples(number, int(reported[number]), len(records))
                for number in np.flatnonzero(reported).tolist()
            },
            verdicts=verdicts,
        )

    def _samples(self, number: int, count: int, room: int) -> Samples:
        """The last run's samples of a digest."""
        ffi, data = self._native.ffi, np.empty(room, np.uint8)
        ends, hashes = np.empty(count, np.int64), np.empty(count, np.uint64)
        places = ffi.from_buffer("uint8_t[]", data), *self._words(ends, hashes)
        self._native.lib.dp_samples(self._native.handle, number, self._seed, *places)
        return Samples(data[: int(ends[-1])].data, ends, hashes)

    def _words(self, *arrays: NDArray[Any]) -> list[Any]:
        return [self._native.ffi.from_buffer("uint64_t[]", array) for array in arrays]

    def _places(self, lengths: NDArray[np.uint32], times_us: NDArray[np.int64]) -> tuple[Any, Any]:
        """Both as C sees them; the arrays have to live as long."""
        ffi = self._native.ffi
        return ffi.from_buffer("uint32_t[]", lengths), ffi.from_buffer("uint64_t[]", times_us)

    def _run(self, port: int, data: bytes, lengths: Any, times: Any, count: int) -> tuple[bytes, bytes]:
        """Records and verdicts."""
        ffi, lib = self._native.ffi, self._native.lib
        verdicts = ffi.new("uint8_t[]", count)
        used = lib.dp_run(self._native.handle, port, count, data, lengths, times, verdicts)
        records = bytes(ffi.buffer(lib.dp_output(self._native.handle), used)) if used else b""
        return records, bytes(ffi.buffer(verdicts, count))

    def _sorted_out(self, records: bytes) -> tuple[NDArray[np.uint32], FrameSlices]:
        """The kinds of the last run's records, and where each stands; `ports` are the records' numbers."""
        ffi, to = self._native.ffi, self._native.ffi.new("const uint64_t **")
        count = self._native.lib.dp_marks(self._native.handle, to)
        marks = np.frombuffer(ffi.buffer(to[0], 8 * count), np.uint64) if count else np.empty(0, np.uint64)
        begins = marks.astype(np.int64) + _RECORD.size
        words, at = np.frombuffer(records, "<u4"), begins - _RECORD.size >> 2
        numbers, ends = words[at + 1].astype(np.int64), begins + words[at + 2]
        return words[at], FrameSlices(numbers, begins, ends, records)

    def _collected(self, records: bytes, verdicts: bytes) -> BatchResult:
        batch = BatchResult(verdicts=verdicts)
        at, end = 0, len(records)
        unpack, outputs = _RECORD.unpack_from, list[tuple[int, bytes]]()
        batch.outputs = outputs
        while at < end:
            kind, number, length = unpack(records, at)
            at += 16
            if kind == _OUT_PORT:
                outputs.append((number, records[at : at + length]))
            elif kind == _OUT_CPU:
                batch.packet_ins.append(records[at : at + length])
            else:
                batch.digests.append(Digest(self._digests[number], records[at : at + length]))
            at += (length + 7) & ~7
        return batch

    def set_clone_session(self, session: int, replicas: Replicas | None, packet_length: int) -> None:
        count, pairs = self._pairs(replicas)
        self._native.lib.dp_session(self._native.handle, session, count, pairs, packet_length)

    def set_multicast_group(self, group: int, replicas: Replicas | None) -> None:
        count, pairs = self._pairs(replicas)
        self._native.lib.dp_group(self._native.handle, group, count, pairs)

    def _pairs(self, replicas: Replicas | None) -> tuple[int, Any]:
        if replicas is None:
            return _NONE, self._native.ffi.NULL
        flat = list(chain.from_iterable(replicas))
        return len(replicas), self._native.ffi.new("uint32_t[]", flat or [0])

    def set_ports(self, ports: frozenset[int] | None) -> None:
        exists = bytes(ports is None or port in ports for port in range(512))
        self._native.lib.dp_ports(self._native.handle, exists)

    def statistics(self) -> dict[str, int]:
        counts = self._native.ffi.new("uint64_t[]", len(m.STATISTICS))
        self._native.lib.dp_statistics(self._native.handle, counts)
        return dict(zip(m.STATISTICS, counts, strict=True))

    def out_of_range(self) -> dict[str, int]:
        counts = self._native.ffi.new("uint64_t[]", len(self._arrays) + 1)
        self._native.lib.dp_out_of_range(self._native.handle, counts)
        return {name: count for name, count in zip(self._arrays, counts, strict=False) if count}

    def close(self) -> None:
        self._native.close()
