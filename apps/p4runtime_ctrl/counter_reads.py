"""When the counters of a switch's blocks are read: in a thread of its own, one read at a time.  I/O.

    a second of capture time │ decisions │ a second without either ─► soon ─► thread: read ─► worker thread: told

A switch under a flood answers late, and a decision must not wait for it.
"""

import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

from apps.p4runtime_ctrl.southbound.session import P4RuntimeSession
from apps.p4runtime_ctrl.state.block_counters import BlockCounters
from apps.p4runtime_ctrl.state.desired_switch import DesiredSwitch

_CALM_S: Final = 0.25
"""Seconds; counters are read once for decisions in quick succession, since reading all blocks costs as much as
carrying out several decisions."""
_SHARE: Final = 5
"""Counter reads take at most this fraction (1/n) of the time."""


class CounterReads:
    """Of one switch.

    Args:
        switch: whose blocks are counted.
        session: the connection now; None: there is none.
        second: of capture time, now.
        put: runs a job in the worker's thread.
        told: called there when there are new counters.
        pause_s: least time between two reads, seconds.
    """

    def __init__(
        self,
        switch: DesiredSwitch,
        *,
        session: Callable[[], P4RuntimeSession | None],
        second: Callable[[], int],
        put: Callable[[Callable[[], None]], None],
        told: Callable[[], None],
        pause_s: float,
    ) -> None:
        self._switch = switch
        self._session, self._second, self._put, self._told = session, second, put, told
        self._pause_s = pause_s
        self._blocks = BlockCounters()
        self._counting = threading.Event()
        self._uncounted = False
        """Decisions were carried out since the last read."""
        self._counted_second = 0
        self._counted_at = 0.0
        self._count_after = 0.0

    @property
    def shown(self) -> list[dict[str, Any]]:
        """The counters to be published; none once there are no blocks."""
        if not self._switch.blocks:
            self._blocks.take([])
        return self._blocks.shown

    @property
    def outdated(self) -> bool:
        """Without blocks no counter is read, and the last one would be listed until a packet comes."""
        return bool(self._blocks.shown) and not self._switch.blocks

    def decided(self) -> None:
        """Decisions were carried out."""
        self._uncounted = True
        if time.monotonic() - self._counted_at > _CALM_S:
            self._soon()

    def packets_came(self) -> None:
        """Capture time may have moved on by a second."""
        if self._second() != self._counted_second:
            self._soon()

    def look(self, now: float) -> None:
        """Periodic work at `now`, seconds (monotonic)."""
        if now - self._counted_at > (_CALM_S if self._uncounted else 1):
            self._soon()

    def _soon(self) -> None:
        """Start a read, unless one runs, none is due, or there are no blocks."""
        if self._counting.is_set() or self._session() is None or not self._switch.blocks:
            return
        if time.monotonic() < self._count_after:
            return
        self._counting.set()
        self._put(self._begin)

    def _begin(self) -> None:
        self._uncounted = False
        told = (self._session(), self._switch.counted_tables, time.monotonic())
        threading.Thread(
            target=self._read, args=told, name=f"counters {self._switch.name}", daemon=True
        ).start()

    def _read(self, session: P4RuntimeSession | None, tables: Sequence[int], began: float) -> None:
        found: list[dict[str, Any]] = []
        failed: Exception | None = None
        try:
            if session is not None:
                entries = [entry for table in tables for entry in session.read_counters(table)]
                found = self._switch.readings(entries)
        except Exception as error:  # noqa: BLE001 - whatever it is, the worker says it, or ends with it
            failed = error
        finally:
            self._put(partial(self._take, session, found, began, failed))

    def _take(
        self,
        session: P4RuntimeSession | None,
        found: list[dict[str, Any]],
        began: float,
        failed: Exception | None,
    ) -> None:
        self._counted_second = self._second()
        self._counted_at = time.monotonic()
        spent = self._counted_at - began
        self._count_after = began + max(self._pause_s, spent * _SHARE)
        self._counting.clear()
        if failed is not None:
            raise failed
        if session is not None and session is self._session():
            self._blocks.take(found)
            self._told()
