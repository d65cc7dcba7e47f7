"""The embedded switch against the real simple_switch_grpc: the same entries, frames and packet-outs go to
both, and all that comes out is compared.  Left out: clocks, meters, and programs that multiply for ever.  Meters with a burst and
no rate need no clock: tests/contract/test_rate_limits.py has both switches drop the same packets.

SDNATOR_SAMENESS_FRAMES sets the frames per program and seed (default 120); of the hostile case also the
packet-outs.  SDNATOR_SAMENESS_SEEDS=FIRST:LAST tries the seeds from FIRST on, before LAST (default 0:2).
"""

import itertools
import os
import queue
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import pytest

from dataplane.bmv2 import PROGRAM
from dataplane.compiler.machine import BatchResult
from dataplane.p4runtime.schema import Schema, bind
from dataplane.p4runtime.table_codec import TableCodec
from dataplane.v1model.switch import Replica, Switch
from dataplane.v1model.tables import Exact, TableEntry, TableError
from dataplane.v1model.tree import MatchKind, Program
from p4rt import p4runtime
from sdnator.testing import counting_traffic, hostile_traffic
from sdnator.testing.p4runtime_client import P4RuntimeClient, delete, insert, modify, program_config
from sdnator.testing.switch_traffic import Chooser, Maker, feature_frame, network_frame
from tests.contract.targets import Bmv2Target
from tests.dataplane.loading import MAKERS, features, sdnator, shared
from tests.requirements import optional_program, shared_data

_HERE = Path(__file__).resolve().parent
_FRAMES = int(os.environ.get("SDNATOR_SAMENESS_FRAMES", "120"))
_SEEDS = range(*map(int, os.environ.get("SDNATOR_SAMENESS_SEEDS", "0:2").split(":")))
_BURST = 12  # BMv2 drops where 64 frames wait for one port
_UPDATES = 40
_WAIT_S = 60.0
_SETTLE_S = 1.0
_WINDOW_US = 3_600_000_000  # clocks differ: frames of both are in the first window, sweeps say when they are
_HOSTILE_WINDOWS = (0, hostile_traffic.reciprocal(_WINDOW_US))
_PORTS = (1, 2, 3)
_ids = itertools.count(10)
_SESSIONS = {1: [Replica(510, 1)], 5: [Replica(4, 7), Replica(510, 1)], 6: [Replica(4, 7), Replica(510, 1)]}
_SESSIONS |= {98: [Replica(510, 1)], 99: [Replica(510, 1)]}
_GROUPS = {1: [Replica(1, 1), Replica(2, 2), Replica(3, 3)], 2: [Replica(1, 1)]}


def _no_clock(data: bytes) -> bytes:
    """packet_in of sketch and sdnator: bits 16 to 63 are a time."""
    return data[:2] + bytes(6) + data[8:]


def _endless_timed_or_fatal(data: bytes) -> bool:
    """features.p4: 15 shows the clock; 18 goes round as often as the next byte says, flooding each time; 21 goes
    beyond arrays, of which a BMv2 built for release dies."""
    return data[12:14] == b"\x88\xb5" and (
        data[14:15] in (b"\x0f", b"\x15") or (data[14:15] == b"\x12" and data[15:16] > b"\2")
    )


class Case:
    """One program: where it is and what of it cannot be compared."""

    def __init__(
        self,
        path: Callable[[], Path],
        program: Callable[[], Program],
        maker: Maker,
        *,
        mask: Callable[[bytes], bytes] = bytes,
        skip: Callable[[bytes], bool] = lambda _: False,
        layer_2: bool = False,
        counting: bool = False,
        hostile: bool = False,
    ) -> None:
        self.path, self.program, self.maker, self.mask, self.skip = path, program, maker, mask, skip
        self.layer_2 = layer_2
        """Nothing but stations and floods: random entries seldom let a frame come so far."""
        self.counting = counting
        """Nothing but counting stages, whose cells are used, and packet-outs that read or sweep them."""
        self.hostile = hostile
        """Counting stages with cells anywhere, and as many packet-outs as frames."""


CASES = {
    "features": Case(
        lambda: _HERE / "programs" / "features", features, feature_frame, skip=_endless_timed_or_fatal
    ),
    "small": Case(lambda: shared_data("p4/small.json"), lambda: shared("small"), network_frame),
    "sketch": Case(
        lambda: shared_data("p4/sketch.json"), lambda: shared("sketch"), network_frame, mask=_no_clock
    ),
    "sdnator": Case(lambda: _HERE.parents[1] / "p4" / "sdnator", sdnator, network_frame, mask=_no_clock),
    "layer 2": Case(
        lambda: _HERE.parents[1] / "p4" / "sdnator", sdnator, network_frame, mask=_no_clock, layer_2=True
    ),
    "counting": Case(
        lambda: _HERE.parents[1] / "p4" / "sdnator", sdnator, network_frame, mask=_no_clock, counting=True
    ),
    "hostile": Case(
        lambda: _HERE.parents[1] / "p4" / "sdnator", sdnator, network_frame, mask=_no_clock, hostile=True
    ),
}


@pytest.fixture
def bmv2():
    """One for each case: a frame that goes round for ever in BMv2 would leave it under the next program."""
    optional_program(PROGRAM)
    target = Bmv2Target()
    yield target
    target.close()


class Pair:
    """Both switches with the same program, entries, sessions and groups."""

    def __init__(self, target: Bmv2Target, case: Case, seed: int) -> None:
        self.target, self.case = target, case
        self.chooser = Chooser(seed)
        self.controller = P4RuntimeClient(target.address, election_id=next(_ids))
        self.controller.arbitrate()
        config = program_config(case.path())
        self._forget_replicas()
        self.controller.set_pipeline(config)
        program = case.program()
        self.schema: Schema = bind(config.p4info, program)
        self.switch = Switch(program, maker=MAKERS[seed % 2])
        updates = [*self._own_tables(), *self._replicas(), *self._digests(config)]
        for first in range(0, len(updates), _UPDATES):
            self.controller.write(*updates[first : first + _UPDATES])
        self._digest_names = {d.preamble.id: d.preamble.name for d in config.p4info.digests}
        self._clocks = _clock_members(config.p4info)
        self.digests: set[tuple[str, tuple[int, ...]]] = set()
        self.windows = 0
        for port in (*_PORTS, 4):
            self.exchange(port, [b"\0"])  # BMv2 knows a port once something came from it

    def _forget_replicas(self) -> None:
        """BMv2 keeps sessions and groups when a pipeline is set; before the first there are none."""
        asked = [p4runtime.Entity(), p4runtime.Entity()]
        asked[0].packet_replication_engine_entry.clone_session_entry.SetInParent()
        asked[1].packet_replication_engine_entry.multicast_group_entry.SetInParent()
        for entity in asked:
            try:
                found = self.controller.read(entity)
            except Exception as error:  # noqa: BLE001 - a switch without a pipeline
                assert "No forwarding pipeline" in str(error)  # noqa: PT017
                continue
            for entry in found:
                self.controller.write(delete(entry))

    def _own_tables(self) -> Iterable[Any]:
        """Of the kind that the case is about."""
        if self.case.layer_2:
            return self._layer_2()
        if self.case.counting or self.case.hostile:
            return self._counting()
        return self._tables()

    def _tables(self) -> Iterable[Any]:
        for name, table in self.switch.tables.items():
            bound = self.schema.table_of(name)
            codec = TableCodec(bound)
            if table.spec.keys and not table.spec.is_const:
                yield from self._entries(bound, codec)
            actions = [a.spec for a in bound.actions if a.as_default]
            if not bound.const_default and actions and self.chooser.random.random() < 0.4:
                action = self.chooser.random.choice(actions)
                yield self._default(name, action.name, self.chooser.params(action))

    def _layer_2(self) -> Iterable[Any]:
        default = (("ingress.flood", (1,)), ("ingress.drop_unknown", ()))[self.chooser.random.random() < 0.3]
        yield self._default("ingress.dmac", *default)
        yield self._entry("ingress.vlan_flood", TableEntry((Exact(2),), "ingress.flood_vlan", (2,)))
        for vid, station in itertools.product((0, 1, 2), (1, 2, 3)):
            port, key = self.chooser.random.choice(_PORTS), (Exact(vid), Exact(0x020000000000 + station))
            if self.chooser.random.random() < 0.5:
                yield self._entry("ingress.smac", TableEntry(key, "ingress.known_station", (port,)))
            if self.chooser.random.random() < 0.5:
                yield self._entry("ingress.dmac", TableEntry(key, "ingress.set_egress", (port,)))

    def _counting(self) -> Iterable[Any]:
        random, tables = self.chooser.random, self.switch.tables
        for default in counting_traffic.defaults(random):
            yield self._default(*default)
        for name, entry in counting_traffic.entries(random, tables, _WINDOW_US):
            if not (self.case.hostile and name.startswith("ingress.count_")):
                yield self._entry(name, entry)
        if self.case.hostile:
            for name, entry in hostile_traffic.entries(random, tables, _HOSTILE_WINDOWS):
                yield self._entry(name, entry)

    def _default(self, name: str, action: str, params: tuple[int, ...]) -> Any:
        self.switch.tables[name].set_default(action, params)
        bound = self.schema.table_of(name)
        entity = p4runtime.Entity()
        entity.table_entry.table_id = bound.id
        entity.table_entry.is_default_action = True
        TableCodec(bound).write_action(action, params, entity.table_entry)
        return modify(entity)

    def _entry(self, name: str, entry: TableEntry) -> Any:
        self.switch.tables[name].insert(entry)
        entity = p4runtime.Entity()
        TableCodec(self.schema.table_of(name)).write(entry, entity.table_entry)
        return insert(entity)

    def _entries(self, bound: Any, codec: TableCodec) -> Iterable[Any]:
        actions = [a.spec for a in bound.actions if a.in_entries]
        for number in range(self.chooser.random.choice([0, 1, 3, 10, 25])):
            entry = self.chooser.entry(bound.spec, number, actions)
            match = tuple(
                self.chooser.match(key, optional=True) if kind is MatchKind.OPTIONAL else value
                for key, kind, value in zip(bound.spec.keys, bound.kinds, entry.match, strict=True)
            )
            entry = TableEntry(match, entry.action, entry.params, entry.priority)
            try:
                self.switch.tables[bound.spec.name].insert(entry)
            except TableError:
                continue
            entity = p4runtime.Entity()
            codec.write(entry, entity.table_entry)
            yield insert(entity)

    def _replicas(self) -> Iterable[Any]:
        for number, replicas in _SESSIONS.items():
            self.switch.set_clone_session(number, replicas)
            entity = p4runtime.Entity()
            session = entity.packet_replication_engine_entry.clone_session_entry
            session.session_id = number
            _add(session, replicas)
            yield insert(entity)
        for number, replicas in _GROUPS.items():
            self.switch.set_multicast_group(number, replicas)
            entity = p4runtime.Entity()
            group = entity.packet_replication_engine_entry.multicast_group_entry
            group.multicast_group_id = number
            _add(group, replicas)
            yield insert(entity)

    @staticmethod
    def _digests(config: Any) -> Iterable[Any]:
        for digest in config.p4info.digests:
            entity = p4runtime.Entity()
            entity.digest_entry.digest_id = digest.preamble.id
            entity.digest_entry.config.max_list_size = 1
            yield insert(entity)

    # -- traffic --------------------------------------------------------------------------------------

    def exchange(self, port: int, frames: list[bytes]) -> None:
        """Frames into `port` of both; what leaves must be the same, as a set for each port."""
        result = self.switch.process_many(port, frames, [1_000_000] * len(frames))
        self.target.inject(port, *frames)
        self._compare(result, frames)

    def header(self) -> list[int]:
        """Of a packet-out: random, or a question about cells as of some window."""
        random = self.chooser.random
        if self.case.hostile:
            return self._fields(hostile_traffic.question(random))
        if not self.case.counting:
            return [self.chooser.value(f.width) for f in self.schema.packet_out]
        self.windows += random.randint(0, 2)
        return self._fields(counting_traffic.question(random, self.windows * _WINDOW_US + 5))

    def _fields(self, asked: dict[str, int]) -> list[int]:
        return [asked.get(f.name, 0) for f in self.schema.packet_out]

    def packet_out(self, header: list[int], payload: bytes) -> None:
        bits = 0
        for field, value in zip(self.schema.packet_out, header, strict=True):
            bits = bits << field.width | value
        size = sum(f.width for f in self.schema.packet_out) // 8
        result = self.switch.packet_out(bits.to_bytes(size, "big") + payload, 1_000_000)
        metadata = {
            field.id: value.to_bytes(max(1, (value.bit_length() + 7) // 8), "big")
            for field, value in zip(self.schema.packet_out, header, strict=True)
        }
        self.controller.packet_out(payload, metadata)
        self._compare(result, [payload])

    def _compare(self, result: BatchResult, frames: list[bytes]) -> None:
        shown = [f.hex() for f in frames]
        expected: dict[int, list[bytes]] = {}
        for port, data in result.outputs:
            expected.setdefault(port, []).append(data)
        for port, ours in expected.items():
            assert sorted(self.target.sent(port, len(ours))) == sorted(ours), (port, shown)
        theirs = sorted(self.case.mask(p) for p in self._packet_ins(len(result.packet_ins)))
        assert theirs == sorted(self.case.mask(p) for p in result.packet_ins), shown
        self.digests |= {self._digest(d.name, d.values) for d in result.digests}

    def _packet_ins(self, count: int) -> list[bytes]:
        found = []
        size = sum(f.width for f in self.schema.packet_in) // 8
        for _ in range(count):
            try:
                packet = self.controller.packets.get(timeout=_WAIT_S)
            except queue.Empty:
                break
            values = {m.metadata_id: int.from_bytes(m.value, "big") for m in packet.metadata}
            bits = 0
            for field in self.schema.packet_in:
                bits = bits << field.width | values.get(field.id, 0)
            found.append(bits.to_bytes(size, "big") + packet.payload)
        return found

    def finish(self) -> None:
        """Nothing more came, digests and direct counters are equal."""
        # what BMv2 still has in its queues would be run by the next case's program
        time.sleep(_SETTLE_S)
        assert self.controller.packets.empty()
        assert all(q.empty() for q in self.target._frames.values())
        theirs: set[tuple[str, tuple[int, ...]]] = set()
        while not self.controller.digests.empty():
            received = self.controller.digests.get()
            name = self._digest_names[received.digest_id]
            for sample in received.data:
                values = [int.from_bytes(m.bitstring, "big") for m in sample.struct.members]
                theirs.add(self._digest(name, values))
        assert theirs == self.digests
        for name, table in self.switch.tables.items():
            if table.spec.has_counter and table.spec.keys:
                self._compare_counters(name)
        assert self.switch.out_of_range() == {}
        self.controller.close()
        self.switch.close()

    def _digest(self, name: str, values: Sequence[int]) -> tuple[str, tuple[int, ...]]:
        clock = self._clocks.get(name)
        return name, tuple(0 if n == clock else value for n, value in enumerate(values))

    def _compare_counters(self, name: str) -> None:
        bound = self.schema.table_of(name)
        codec = TableCodec(bound)
        entity = p4runtime.Entity()
        entity.table_entry.table_id = bound.id
        entity.table_entry.counter_data.SetInParent()
        # frames that are dropped leave nothing to wait for: BMv2 may still have some of them to count
        deadline = time.monotonic() + _WAIT_S
        while True:
            different = [
                (entry, (ours.packets, ours.bytes))
                for entry in (found.table_entry for found in self.controller.read(entity))
                if not entry.is_default_action
                for ours in [self.switch.tables[name].counter(codec.match(entry.match), entry.priority)]
                if (entry.counter_data.packet_count, entry.counter_data.byte_count)
                != (ours.packets, ours.bytes)
            ]
            if not different or time.monotonic() > deadline:
                break
            time.sleep(_SETTLE_S)
        assert different == [], name


def _clock_members(info: Any) -> dict[str, int]:
    """Which member of a digest is a time."""
    found = {}
    for name, struct in info.type_info.structs.items():
        names = [member.name for member in struct.members]
        if "timestamp" in names:
            found[name] = names.index("timestamp")
    return found


def _add(message: Any, replicas: Iterable[Replica]) -> None:
    for replica in replicas:
        message.replicas.add(egress_port=replica.port, instance=replica.instance)


@pytest.mark.parametrize("seed", _SEEDS)
@pytest.mark.parametrize("name", CASES)
def test_embedded_switch_does_what_bmv2_does(bmv2, name, seed):
    case = CASES[name]
    pair = Pair(bmv2, case, seed)
    chooser = pair.chooser
    for _ in range(0, _FRAMES, _BURST):
        frames: list[bytes] = []
        while len(frames) < _BURST:
            data = case.maker(chooser.random)
            # a frame that is dropped is not waited for
            data = data if case.counting or case.hostile else chooser.spoil(data)
            if data and not case.skip(data):
                frames.append(data)
        pair.exchange(chooser.random.choice(_PORTS), frames)
        for data in frames if case.hostile else frames[:1] if pair.schema.packet_out else ():
            pair.packet_out(pair.header(), data)
    pair.finish()
