"""One exporter: its datagrams, of whatever protocol, as flow records; its domains, and what was lost on the way."""

from collections import Counter
from typing import Any, Final

from due import RecordBatch
from flow_records.decoding.errors import FlowDecodeError
from flow_records.decoding.netflow5 import NetFlow5
from flow_records.decoding.sequence import SequenceGaps
from flow_records.decoding.sflow5 import SFlow5
from flow_records.decoding.templated import ExportDomain, export_header

MOST_DOMAINS: Final = 64
"""Domains of NetFlow v9 and IPFIX, and as many numbered sources of the others."""
DEFAULT_LIFETIME_S: Final = 1800.0
_NAMES: Final = {
    b"\x00\x05": "netflow5",
    b"\x00\x09": "netflow9",
    b"\x00\x0a": "ipfix",
    b"\x00\x00": "sflow5",
}
_UNITS: Final = {
    "netflow5": "lost_records",
    "ipfix": "lost_records",
    "netflow9": "lost_datagrams",
    "sflow5": "lost_datagrams",
}
"""What the sequence numbers of each protocol count."""
_Place = tuple[str, int | bytes, int]
"""Protocol, domain, and the port where it tells sessions apart."""


class Exporter:
    """Decodes the datagrams of one exporter.  Not thread-safe.

    Args:
        sampling: rate where the exporter tells none: 1 of so many packets is looked at.
        lifetime_s: how long templates are kept without being repeated.
    """

    def __init__(self, sampling: int = 1, lifetime_s: float = DEFAULT_LIFETIME_S) -> None:
        self._sampling = sampling
        self._lifetime_s = lifetime_s
        self._domains: dict[_Place, tuple[ExportDomain, float]] = {}
        self._gaps: dict[_Place, tuple[SequenceGaps, float]] = {}
        self._forgotten: Counter[str] = Counter()
        """Losses of sources that are no longer kept."""
        self._counts: Counter[str] = Counter()
        self._refused: Counter[str] = Counter()
        self._clock_off_us = 0

    def decode(self, datagram: bytes, port: int, now: float, received_us: int) -> list[RecordBatch]:
        """The flow records of a datagram.

        Args:
            datagram: as it arrived.
            port: from which it was sent.
            now: s, of a clock that never goes back.
            received_us: when it arrived, us since the epoch.

        Returns:
            Batches with the columns of `FLOW_COLUMNS`, none of them empty.

        Raises:
            FlowDecodeError: the datagram is refused as a whole; it is counted.
        """
        self._counts["datagrams"] += 1
        try:
            found = self._flows(datagram, port, now, received_us)
        except FlowDecodeError as error:
            self._refused[error.cause] += 1
            raise
        self._counts["records"] += sum(map(len, found))
        return [batch for batch in found if len(batch)]

    def health(self) -> dict[str, Any]:
        """Counters since the start; losses by the unit that the exporter numbers."""
        counts = {
            name: self._counts[name] for name in ("datagrams", "records", "without_template", "not_flows")
        }
        losses = Counter({"lost_records": 0, "lost_datagrams": 0, "reordered": 0, "restarts": 0})
        losses.update(self._forgotten)
        for place, gaps in self._numbered():
            losses.update(_losses(place[0], gaps))
        protocols = sorted({place[0] for place in (*self._domains, *self._gaps)})
        templates = sum(len(domain.templates) for domain, _ in self._domains.values())
        return {
            **counts,
            **losses,
            "refused": sum(self._refused.values()),
            "refused_by_cause": dict(self._refused),
            "protocols": protocols,
            "templates": templates,
            "clock_off_s": round(self._clock_off_us / 1e6, 1),
        }

    def _flows(self, datagram: bytes, port: int, now: float, received_us: int) -> list[RecordBatch]:
        protocol = _NAMES.get(datagram[:2])
        if protocol == "netflow5":
            five = NetFlow5(datagram)
            self._gaps_of((protocol, five.engine, 0), now).hear(five.sequence, five.count)
            self._clock_off_us = received_us - five.export_us
            return [five.flows(self._sampling)]
        if protocol == "sflow5" and datagram[:4] == b"\x00\x00\x00\x05":
            sampled = SFlow5(datagram)
            self._gaps_of((protocol, sampled.source, 0), now).hear(sampled.sequence, 1)
            self._counts["not_flows"] += sampled.not_flows
            return [sampled.flows(received_us, self._sampling)]
        if protocol not in ("netflow9", "ipfix"):
            raise FlowDecodeError(
                "version", f"neither NetFlow v5, v9, IPFIX nor sFlow v5: {datagram[:4].hex()}"
            )
        header = export_header(datagram)
        # RFC 7011, 10.3: over UDP a session is that of a port; NetFlow v9 knows the source id only
        place = (protocol, header.domain, port if protocol == "ipfix" else 0)
        found, counts = self._domain(place, now).decode(datagram, header, now)
        self._clock_off_us = received_us - header.export_us
        self._counts["without_template"] += counts.without_template
        self._counts["not_flows"] += counts.not_flows
        return found

    def _domain(self, place: _Place, now: float) -> ExportDomain:
        if place not in self._domains:
            self._make_room(self._domains, now)
        domain, _ = self._domains.get(place) or (ExportDomain(self._sampling, self._lifetime_s), now)
        self._domains[place] = (domain, now)
        return domain

    def _gaps_of(self, place: _Place, now: float) -> SequenceGaps:
        if place not in self._gaps:
            self._make_room(self._gaps, now)
        gaps, _ = self._gaps.get(place) or (SequenceGaps(), now)
        self._gaps[place] = (gaps, now)
        return gaps

    def _make_room(
        self,
        known: dict[_Place, tuple[ExportDomain, float]] | dict[_Place, tuple[SequenceGaps, float]],
        now: float,
    ) -> None:
        """Forget what has been silent for a template's lifetime; raises FlowDecodeError if that is too little."""
        if len(known) < MOST_DOMAINS:
            return
        for place in [place for place, (_, heard) in known.items() if now - heard > self._lifetime_s]:
            kept, _ = known.pop(place)
            self._forgotten.update(_losses(place[0], kept.gaps if isinstance(kept, ExportDomain) else kept))
        if len(known) >= MOST_DOMAINS:
            raise FlowDecodeError("limit", f"over {MOST_DOMAINS} domains of one exporter")

    def _numbered(self) -> list[tuple[_Place, SequenceGaps]]:
        found = [(place, domain.gaps) for place, (domain, _) in self._domains.items()]
        return found + [(place, gaps) for place, (gaps, _) in self._gaps.items()]


def _losses(protocol: str, gaps: SequenceGaps) -> dict[str, int]:
    return {_UNITS[protocol]: gaps.lost, "reordered": gaps.reordered, "restarts": gaps.restarts}
