"""Reads how many frames each counting entry has met, while somebody wants to know: planning goes by it.

In a thread of its own: a switch under a flood answers late.  I/O.
"""

import logging
import threading
from collections.abc import Callable, Iterator
from typing import Any, Final, Protocol

import numpy as np

from apps.p4runtime_ctrl.errors import ControllerError, Malformed
from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
from apps.p4runtime_ctrl.state.desired_state import check_entry
from due import RecordBatch

_LOG = logging.getLogger(__name__)
_STAGES: Final = "ingress.count_"
_QUERIES: Final = 256
_EVERY_S: Final = 2.0


class CounterReader(Protocol):
    """What reads counters: a P4Runtime session."""

    def read_counters(self, table_id: int) -> Iterator[Any]:
        """Entries of one table with their direct counters."""


class TelemetryCounters:
    """The counters of one switch's counting stages.

    Args:
        switch: its name, for the log.
        program: whose counting stages are read.
        publish: takes the packets by classifier bit.
        failed: takes an error that nobody expects.
    """

    def __init__(
        self,
        switch: str,
        program: ProgramInfo,
        publish: Callable[[RecordBatch], None],
        failed: Callable[[Exception], None],
    ) -> None:
        self._switch = switch
        self._tables = [table.id for table in program.tables.values() if table.name.startswith(_STAGES)]
        self._publish = publish
        self._failed = failed
        self._reading = threading.Event()
        self._due = 0.0
        self.wanted = False

    def look(self, session: CounterReader | None, now: float) -> None:
        """Start a read if one is due; `now`: s, monotonic."""
        if not self.wanted or session is None or self._reading.is_set() or now < self._due:
            return
        self._reading.set()
        self._due = now + _EVERY_S
        name = f"telemetry counters {self._switch}"
        threading.Thread(target=self._read, args=(session,), name=name, daemon=True).start()

    def _read(self, session: CounterReader) -> None:
        try:
            packets: dict[int, int] = {}
            for table in self._tables:
                packets |= dict(_counter(entry) for entry in session.read_counters(table))
            self._publish(
                RecordBatch(
                    {
                        "bit": np.array(list(packets), dtype=np.uint8),
                        "packets": np.array(list(packets.values()), dtype=np.uint64),
                    }
                )
            )
        except ControllerError as error:
            # whether the switch works, others watch; the next read is soon
            _LOG.warning("%s: no telemetry counters: %s", self._switch, error)
        except Exception as error:  # noqa: BLE001 - whatever it is, the worker ends with it
            self._failed(error)
        finally:
            self._reading.clear()


def _counter(entry: Any) -> tuple[int, int]:
    """Bit of the query map, and packets; raises `Malformed` for an entry that is not of a counting stage."""
    check_entry(entry)
    bits = int.from_bytes(entry.match[0].ternary.value, "big") if len(entry.match) == 1 else 0
    if bits.bit_count() != 1 or bits >> _QUERIES:
        raise Malformed("an entry of a counting stage is not for one query")
    return bits.bit_length() - 1, int(entry.counter_data.packet_count)
