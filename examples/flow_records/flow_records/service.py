"""Flow records in over UDP, record batches out, one key for each exporter.

routers, switches ──NetFlow v5, v9, IPFIX, sFlow v5──► FlowRecords ──► network.flows.flow_records.<exporter>
                                                                  └──► network.exporter.flow_records.<exporter>
"""

import logging
import sys
import threading
import time
from collections.abc import Sequence
from ipaddress import ip_address
from typing import Any, Final

import due.service
from apps.messages import one_line
from due import PUB_ONLY, Capability, Engine, Interest, RecordBatch
from due.errors import InvalidOption
from flow_records.columns import EXPORTER, FLOWS, joined
from flow_records.datagram_queue import Datagram, DatagramQueue
from flow_records.decoding.errors import FlowDecodeError
from flow_records.decoding.exporter import Exporter
from flow_records.settings import MOST_EXPORTERS, Settings, segment_of
from flow_records.udp_listener import UdpListener

INTERESTS: tuple[Interest, ...] = ()
CAPABILITIES = (Capability(f"{FLOWS}.*"), Capability(f"{EXPORTER}.*"))

_AT_ONCE: Final = 16
"""Datagrams between two looks at how many records there are."""
_ROWS_A_TICK: Final = 1 << 17
"""Records after which a tick leaves the rest to the next one."""
_ROWS_AN_ITEM: Final = 1 << 15
_STATE_S: Final = 1.0
_SAY_EVERY_S: Final = 60.0

log = logging.getLogger("flow_records")


class FlowRecordsService:
    """The app as `due.service.run` drives it: a thread receives, `tick` decodes and writes."""

    def __init__(self, engine: Engine, settings: Settings) -> None:
        self._engine, self._settings = engine, settings
        self._names = {str(ip_address(address)): name for name, address in settings.exporters.items()}
        self._queue = DatagramQueue(settings.queue)
        self._exporters: dict[str, Exporter] = {}
        self._lock = threading.Lock()
        self._listener: UdpListener | None = None
        self._not_listed = 0
        self._too_many = 0
        self._written = 0
        self._state_at = 0.0
        self._said: dict[str, float] = {}

    def start(self) -> None:
        """Listen, if there is anybody to listen to.

        Raises:
            InvalidOption: a port cannot be listened on.
        """
        settings = self._settings
        if not self._names and not settings.any_exporter:
            log.warning("no exporters are listed, so none is listened to; see flow_records.exporters")
            return
        try:
            self._listener = UdpListener(settings.listen, settings.ports, self._exporter_of, self._queue)
        except OSError as error:
            raise InvalidOption(f"flow_records: {error.strerror}; see listen and ports") from None

    def ready(self) -> dict[str, str]:
        """For the ready line: where it listens."""
        return {"listening": " ".join(self._listener.addresses if self._listener else ())}

    def tick(self) -> None:
        """Decode what has arrived, and write it: one item for each exporter.

        Raises:
            RuntimeError: the thread that receives is dead.
        """
        if self._listener is not None and self._listener.failure:
            raise RuntimeError(f"flow_records: {self._listener.failure}")
        now = time.monotonic()
        for exporter, batches in sorted(self._decoded(now).items()):
            self._write(exporter, joined(batches))
        if now >= self._state_at:
            self._state_at = now + _STATE_S
            self._tell()

    def stop(self) -> None:
        """Close the sockets, and write what has arrived."""
        if self._listener is not None:
            self._listener.close()
            self._listener = None
            while len(self._queue):
                self.tick()

    def health(self) -> dict[str, Any]:
        """Counters for `sdnator status` and Prometheus."""
        with self._lock:
            exporters = [{"name": name} | one.health() for name, one in sorted(self._exporters.items())]
        sums = ("records", "lost_records", "lost_datagrams", "without_template", "refused")
        return {
            **{name: sum(int(one[name]) for one in exporters) for name in sums},
            "not_listed": self._not_listed + self._too_many,
            "queue_dropped": self._queue.dropped,
            "written": self._written,
            "listening": self._listener.addresses if self._listener else [],
            "exporters": exporters,
        }

    def _exporter_of(self, address: str) -> str | None:
        """Called in the listener's thread."""
        name = self._names.get(address)
        if name is None and self._settings.any_exporter:
            return segment_of(address)
        if name is None:
            self._not_listed += 1
            self._say("not listed", f"a datagram of {address}, which is not listed in flow_records.exporters")
        return name

    def _decoded(self, now: float) -> dict[str, list[RecordBatch]]:
        """What waits, up to so many records, by exporter."""
        found: dict[str, list[RecordBatch]] = {}
        rows = 0
        with self._lock:
            while rows < _ROWS_A_TICK and (datagrams := self._queue.take(_AT_ONCE)):
                for datagram in datagrams:
                    batches = self._decode(datagram, now)
                    rows += sum(map(len, batches))
                    if batches:
                        found.setdefault(datagram.exporter, []).extend(batches)
        return found

    def _write(self, exporter: str, flows: RecordBatch) -> None:
        for start in range(0, len(flows), _ROWS_AN_ITEM):
            part = flows.take(slice(start, start + _ROWS_AN_ITEM))
            self._written += len(part)
            newest_us = int(part["time_us"].max())
            flags = [] if self._settings.archive else [PUB_ONLY]
            self._engine.write(f"{FLOWS}.{exporter}", part, flags, event_time=newest_us * 1000)

    def _decode(self, datagram: Datagram, now: float) -> list[RecordBatch]:
        exporter = self._exporters.get(datagram.exporter)
        if exporter is None:
            if len(self._exporters) >= MOST_EXPORTERS:
                self._too_many += 1
                return []
            rate = self._settings.sampling.get(datagram.exporter, 1)
            exporter = self._exporters[datagram.exporter] = Exporter(rate, self._settings.template_s)
        try:
            return exporter.decode(datagram.content, datagram.port, now, datagram.received_us)
        except FlowDecodeError as error:
            self._say(datagram.exporter, f"a datagram of {datagram.exporter}: {error}")
            return []

    def _say(self, about: str, text: str) -> None:
        """Log a refusal, once a minute for each exporter."""
        now = time.monotonic()
        if now - self._said.get(about, now - _SAY_EVERY_S) >= _SAY_EVERY_S:
            self._said[about] = now
            log.warning("refused %s; further ones are only counted", one_line(text))

    def _tell(self) -> None:
        """Write what is known of each exporter, losses above all."""
        with self._lock:
            states = {name: one.health() for name, one in sorted(self._exporters.items())}
        for name, state in states.items():
            self._engine.write(
                f"{EXPORTER}.{name}", state | {"queue_dropped": self._queue.dropped}, [PUB_ONLY]
            )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the collector until a signal ends it."""
    return due.service.run("flow_records", FlowRecordsService, Settings, INTERESTS, CAPABILITIES, argv)


if __name__ == "__main__":
    sys.exit(main())
