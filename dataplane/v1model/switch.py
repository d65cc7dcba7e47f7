"""The switch engine: frames and control operations in, frames, packet-ins and digests out.

    frame ──► parser ─► ingress ─┬─ clone (I2E) ─┐
               ▲   ▲             ├─ multicast ───┤
       recirculate resubmit ─────┤               ▼
               │                 └─ egress_spec ► egress ─► checksums ─► deparser ─► Result
               └───────────────────────────────────┘  └ clone (E2E) ─► egress

No socket, no thread and no clock in here: time is an argument (µs), so meters, idle time-outs and
`ingress_global_timestamp` run on the packets' clock.
"""

import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from dataplane.compiler.c_machine import CMachine
from dataplane.compiler.machine import BatchResult, MachineMaker, Replicas
from dataplane.errors import DataplaneError
from dataplane.frame_block import FrameBlock
from dataplane.v1model.externs import CounterArray, MeterArray, RegisterArray
from dataplane.v1model.program import Program
from dataplane.v1model.tables import Table, TableEntry
from dataplane.v1model.tree import TableNode

_MAX_SESSION = 0x7FFF
_MAX_GROUP = 0xFFFF


@dataclass(frozen=True, slots=True)
class Replica:
    """One copy made by a multicast group or clone session."""

    port: int
    instance: int = 0


class Switch:
    """A program loaded and running.

    All methods may be called from several threads; one lock serialises them.

    program: from `dataplane.v1model.program.load`
    cpu_port: frames sent there become packet-ins, and `packet_out` enters there
    maker: what turns the program into something that runs
    """

    tables: Mapping[str, Table]
    counters: Mapping[str, CounterArray]
    meters: Mapping[str, MeterArray]
    registers: Mapping[str, RegisterArray]

    def __init__(self, program: Program, *, cpu_port: int = 510, maker: MachineMaker = CMachine) -> None:
        """Raises CompilerError where the C cannot be built, Unsupported where the program
        needs wider integers than there are."""
        self.program = program
        self.cpu_port = cpu_port
        self.lock = threading.RLock()
        self._now = 0
        self._machine = maker(program, cpu_port)
        numbers = {a.spec.name: a.number for a in program.actions}
        self.tables = {
            name: Table(
                spec, self._machine.tables[name], self._numbers(name, numbers), self.lock, self.now_us
            )
            for name, spec in program.tables.items()
        }
        self.counters = {
            name: CounterArray(spec, self._machine.counters[name], self.lock)
            for name, spec in program.counters.items()
            if not spec.table
        }
        self.meters = {
            name: MeterArray(spec, self._machine.meters[name], self.lock)
            for name, spec in program.meters.items()
            if not spec.table
        }
        self.registers = {
            name: RegisterArray(spec, self._machine.registers[name], self.lock)
            for name, spec in program.registers.items()
        }
        self._sessions: dict[int, tuple[tuple[Replica, ...], int]] = {}
        self._groups: dict[int, tuple[Replica, ...]] = {}

    def _numbers(self, table: str, numbers: Mapping[str, int]) -> dict[str, int]:
        """Action numbers of a table; p4c may give several actions one name (NoAction)."""
        for pipeline in (self.program.ingress, self.program.egress):
            node = pipeline.nodes.get(table)
            if isinstance(node, TableNode):
                return {self.program.actions[n].spec.name: n for n in node.actions}
        return dict(numbers)

    def now_us(self) -> int:
        """The packets' clock: the time of the latest frame."""
        return self._now

    def advance(self, now_us: int) -> None:
        """The packets' clock stands at `now_us`, though no frame came: what is written now is that young."""
        with self.lock:
            self._now = now_us

    def process(self, port: int, frame: bytes, now_us: int) -> BatchResult:
        """One frame that arrived on `port` at `now_us` (µs of the packets' clock, 48 bits)."""
        return self.process_many(port, (frame,), (now_us,))

    def process_many(self, port: int, frames: Sequence[bytes], times_us: Sequence[int]) -> BatchResult:
        """Many frames in order under one lock; the lists of the result run over all of them.

        `verdicts` has one byte per frame.  A digest or packet-in belongs to the frame whose turn it was;
        order is kept.
        """
        with self.lock:
            if times_us:
                self._now = times_us[-1]
            return self._machine.run(port, frames, times_us)

    def process_block(self, port: int, block: FrameBlock) -> BatchResult:
        """As `process_many`, of frames that stand end to end, each as long as on the wire."""
        with self.lock:
            self._now = int(block.times_us[-1])
            return self._machine.run_block(port, block.data, block.captured, block.times_us)

    def packet_out(self, payload: bytes, now_us: int) -> BatchResult:
        """A packet-out: packet_out header in front, then the frame; enters at the CPU port."""
        return self.process(self.cpu_port, payload, now_us)

    def expired(self, now_us: int) -> list[tuple[Table, TableEntry]]:
        """Entries whose idle time-out has passed at `now_us`.

        Each is reported once per elapsed time-out: again when another full time-out has gone by unhit,
        until it is deleted or hit.
        """
        with self.lock:
            return [(table, entry) for table in self.tables.values() for entry in table.expired(now_us)]

    def set_ports(self, ports: Iterable[int] | None) -> None:
        """The ports that exist: frames to others are dropped and counted (None = every port exists)."""
        with self.lock:
            self._machine.set_ports(None if ports is None else frozenset(ports))

    # -- packet replication ---------------------------------------------------------------------------

    def set_clone_session(self, session: int, replicas: Iterable[Replica], *, packet_length: int = 0) -> None:
        """Install or replace a clone session; `packet_length` in bytes, 0 = whole frames.

        Raises DataplaneError where the session is not within 0..32767.
        """
        if not 0 <= session <= _MAX_SESSION:
            raise DataplaneError(f"clone session {session} is not within 0..{_MAX_SESSION}")
        copies = tuple(replicas)
        with self.lock:
            self._machine.set_clone_session(session, _pairs(copies), packet_length)
            self._sessions[session] = (copies, packet_length)

    def delete_clone_session(self, session: int) -> None:
        """Remove a session; a missing one is no error."""
        with self.lock:
            if self._sessions.pop(session, None) is not None:
                self._machine.set_clone_session(session, None, 0)

    def set_multicast_group(self, group: int, replicas: Iterable[Replica]) -> None:
        """Install or replace a group; copies are made in the order given.

        Raises DataplaneError where the group is not within 1..65535.
        """
        if not 1 <= group <= _MAX_GROUP:
            raise DataplaneError(f"multicast group {group} is not within 1..{_MAX_GROUP}")
        copies = tuple(replicas)
        with self.lock:
            self._machine.set_multicast_group(group, _pairs(copies))
            self._groups[group] = copies

    def delete_multicast_group(self, group: int) -> None:
        """Remove a group; a missing one is no error."""
        with self.lock:
            if self._groups.pop(group, None) is not None:
                self._machine.set_multicast_group(group, None)

    def statistics(self) -> dict[str, int]:
        """Counts since the start: frames, parser_errors (one per pass), dropped (frames that made neither
        packet-in nor output), no_such_port, loop_drops, oversized."""
        with self.lock:
            return self._machine.statistics()

    def out_of_range(self) -> dict[str, int]:
        """Accesses of the program beyond the last cell of a counter, meter or register array since the start,
        by the array's name; arrays without any are left out.  Such a read leaves its target as it was, a write
        is dropped.  BMv2's release builds crash there: a correct program has none."""
        with self.lock:
            return self._machine.out_of_range()

    def close(self) -> None:
        """Free what the back end holds; the C back end raises DataplaneError when used afterwards."""
        with self.lock:
            self._machine.close()


def _pairs(replicas: tuple[Replica, ...]) -> Replicas:
    return tuple((r.port, r.instance) for r in replicas)
