"""Defence against SYN floods: which services are guarded, which floods are looked at, what follows.

    switch seen ──► guard of the services that the settings name, and known sources
    syn_flood result ──► sample of the SYNs towards that host ──► policy ──► block or protect
    handshake ──► known source

Pure: decisions are handed out, the caller publishes them; times are capture time in ns.
"""

import ipaddress
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from apps.firewall.known_sources import KnownSources
from apps.firewall.ledger import SECOND, Ledger, decision_id
from apps.firewall.policy import AllowList
from apps.firewall.services import Service
from apps.firewall.syn_policy import Sample, SynRules, SynVerdict, judge_syns
from apps.messages import Decision, Evidence, Target
from due import RecordBatch

EVERY_SWITCH = "*"
HOSTS_WATCHED = 64
SOURCES_SAMPLED = 4096


class Watch:
    """A look at the SYNs towards one host."""

    def __init__(self, evidence: Evidence, now: int) -> None:
        self.evidence = evidence
        self.now = now
        self.syns: Counter[tuple[int, str]] = Counter()
        """By port and source."""
        self.total = 0

    def add(self, port: int, source: str) -> None:
        self.total += 1
        if len(self.syns) < SOURCES_SAMPLED or (port, source) in self.syns:
            self.syns[port, source] += 1

    def finished(self, port: int, source: str) -> None:
        """A handshake: that SYN was meant well."""
        if self.syns[port, source] > 1:
            self.syns[port, source] -= 1
        else:
            del self.syns[port, source]


class SynDefence:
    """Guards, watches and what they lead to; blocks are entered in the ledger."""

    def __init__(
        self,
        rules: SynRules,
        services: Iterable[Service],
        ledger: Ledger,
        allow: AllowList,
        known: KnownSources,
    ) -> None:
        self.rules = rules
        self.known = known
        self._always = frozenset(services)
        self._ledger = ledger
        self._allow = allow
        self._guarded: dict[Service, Decision] = {}
        self.watches: dict[str, Watch] = {}
        self.refused = 0

    @property
    def guarded(self) -> list[Service]:
        """All services under guard."""
        return sorted(self._always | self._guarded.keys())

    def arm(self, switch: str, now: int) -> list[Decision]:
        """The guards of a switch that has come."""
        beforehand = [
            self._protect(
                service, switch, "the settings name it as a service that matters", (), now, expires=0
            )
            for service in sorted(self._always)
        ]
        return beforehand + [_on(switch, decision) for decision in self._guarded.values()]

    def suspect(self, host: str, evidence: Evidence, now: int) -> bool:
        """A flood towards a host is suspected; True if its SYNs are to be looked at."""
        for service, decision in self._guarded.items():
            if service.address == host:
                expires = now + self.rules.protect_s * SECOND
                self._guarded[service] = _changed(decision, expires=expires)
        if host in self.watches or len(self.watches) >= HOSTS_WATCHED:
            return False
        self.watches[host] = Watch(evidence, now)
        return True

    def handshake(self, source: str, service: Service, at: int) -> None:
        """A source has completed a handshake with a service."""
        self.known.learn(source, at)
        watch = self.watches.get(service.address)
        if watch is not None:
            watch.finished(service.port, source)

    def conclude(self, host: str, offences: Mapping[str, int]) -> list[Decision]:
        """End a watch and decide; `offences` are earlier blocks by address."""
        watch = self.watches.pop(host)
        by_port: dict[int, dict[str, int]] = {}
        for (port, source), count in watch.syns.items():
            by_port.setdefault(port, {})[source] = count
        decisions: list[Decision] = []
        for port, syns in sorted(by_port.items()):
            sample = Sample(Service(host, port), syns)
            verdict = judge_syns(sample, self.rules, self._allow, self.known)
            decisions += self._carry_out(sample.service, verdict, watch, offences)
        return decisions

    def due(self, now: int) -> list[Decision]:
        """Guards whose time is over."""
        over = [service for service, decision in self._guarded.items() if 0 < decision.expires <= now]
        reason = "no flood was seen for the time of a guard"
        return [
            _changed(self._guarded.pop(service), action="unprotect", reason=reason, event_time=now)
            for service in over
        ]

    def _carry_out(
        self, service: Service, verdict: SynVerdict, watch: Watch, offences: Mapping[str, int]
    ) -> list[Decision]:
        decisions: list[Decision] = []
        if verdict.protects and service not in self._always and service not in self._guarded:
            expires = watch.now + self.rules.protect_s * SECOND
            made = self._protect(
                service, EVERY_SWITCH, verdict.reason, (watch.evidence,), watch.now, expires=expires
            )
            self._guarded[service] = made
            decisions.append(made)
        for source in verdict.block:
            if self._ledger.blocks_address(source):
                continue
            if self._ledger.cap_reached(watch.now) is not None:
                self.refused += 1
                continue
            target = Target(kind="ip", address=source)
            decisions.append(
                self._ledger.open(
                    EVERY_SWITCH,
                    target,
                    verdict.reason,
                    (watch.evidence,),
                    watch.now,
                    offences=offences.get(source, 0),
                )
            )
        return decisions

    def _protect(
        self,
        service: Service,
        switch: str,
        reason: str,
        evidence: tuple[Evidence, ...],
        now: int,
        *,
        expires: int,
    ) -> Decision:
        return Decision(
            id=decision_id(switch, service.target, now),
            action="protect",
            switch=switch,
            target=service.target,
            reason=reason,
            evidence=evidence,
            event_time=now,
            expires=expires,
            dry_run=self._ledger.rules.dry_run,
        )


def _on(switch: str, decision: Decision) -> Decision:
    return _changed(decision, switch=switch)


def _changed(old: Decision, **changes: Any) -> Decision:
    return Decision(**({name: getattr(old, name) for name in old.__struct_fields__} | changes))


def syns_of(batch: RecordBatch) -> Iterator[tuple[int, str]]:
    """Destination port and source address of each row of a batch of packets."""
    names = ("ip_version", "ip_src_hi", "ip_src_lo", "tcp_dport")
    for version, high, low, port in zip(*(batch[name].tolist() for name in names), strict=True):
        if version:
            address = ipaddress.IPv4Address(low) if version == 4 else ipaddress.IPv6Address(high << 64 | low)
            yield port, str(address)
