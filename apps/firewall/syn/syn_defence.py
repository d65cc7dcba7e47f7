"""Defence against SYN floods: which services are guarded, and which sources are blocked.

    switch seen ──► guard of the services that the settings name, and known sources
    syn_flood result or surge ──► the SYNs that came towards that host ──► policy ──► evidence ──► guard, soon
                                                                   ... once more, later ──► block, surely
    handshake ──► known source

Pure: decisions are returned and the caller publishes them; times are capture time in ns.
"""

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import islice
from typing import Any

from apps.firewall.evidence.history import EarlierBlocks
from apps.firewall.evidence.known_sources import KnownSources
from apps.firewall.evidence.shared import shared_text
from apps.firewall.policy.block_lifecycle import SECOND, BlockLifecycle, decision_id
from apps.firewall.policy.prefix_aggregation import Network, any_within, crowded_prefixes
from apps.firewall.policy.rules import AllowList
from apps.firewall.syn.flood_evidence import Suspicion, SynFinding, flood_evidence, source_evidence
from apps.firewall.syn.recent_syns import RecentSyns
from apps.firewall.syn.services import TcpService
from apps.firewall.syn.syn_policy import Sample, SynRules, SynVerdict, judge_syns
from apps.messages import Confirmation, Decision, Exhibit

EVERY_SWITCH = "*"
UNKNOWN_HISTORY = "history unknown: Data Archives do not answer"
COLD_HISTORY = "nobody is known from handshakes yet, so everybody is challenged once"
SERVICES_LEARNT = 4096
SOURCES_SAMPLED = 4096
REFUSED_S = 30
"""Seconds for which a guard that a switch has refused is not tried again."""
MOST_REFUSED = 1024


class Watch:
    """The SYNs towards one host, under examination."""

    def __init__(self, suspicion: Suspicion, now: int) -> None:
        self.suspicion = suspicion
        self.host = suspicion.host
        self.now = now
        self.unsure = False
        """Sources would be blocked if they had had more time to finish their handshakes."""
        self.syns: Counter[tuple[int, str]] = Counter()
        """By port and source."""
        self.total = 0

    def add(self, port: int, source: str) -> None:
        self.total += 1
        if len(self.syns) < SOURCES_SAMPLED or (port, source) in self.syns:
            self.syns[port, source] += 1

    def finished(self, port: int, source: str) -> None:
        """A handshake removes its SYN from the sample, and one repetition of it."""
        if self.syns[port, source] > 2:
            self.syns[port, source] -= 2
        else:
            del self.syns[port, source]  # a Counter accepts this for missing keys, too

    def often(self, rules: SynRules) -> list[str]:
        """Sources that may be blocked."""
        found = (source for (_, source), count in self.syns.items() if count >= rules.repeats)
        return list(islice(found, rules.sources))


class SynDefence:
    """Guards services and examines suspected floods; blocks are opened in the `BlockLifecycle`."""

    def __init__(
        self,
        rules: SynRules,
        services: Iterable[TcpService],
        lifecycle: BlockLifecycle,
        allow: AllowList,
        known: KnownSources,
        is_silent: Callable[[TcpService], bool] = lambda _: False,
    ) -> None:
        """`is_silent`: whether no answer of a service has been seen."""
        self.rules = rules
        self._is_silent = is_silent
        self.known = known
        self._always = frozenset(services)
        self._lifecycle = lifecycle
        self.allow = allow
        self._guarded: dict[TcpService, Decision] = {}
        self._refused: dict[TcpService, tuple[Decision, int]] = {}
        """Guards that no switch has, and when the last one refused."""
        self.services: dict[TcpService, TcpService] = {}
        """Known from handshakes; the most recent last."""
        self.recent = RecentSyns(rules.sample)
        self._finished: deque[tuple[int, str, TcpService]] = deque(maxlen=rules.sample)

    @property
    def guarded(self) -> list[TcpService]:
        """All services under guard."""
        return sorted(self._always | self._guarded.keys())

    def arm(self, switch: str, now: int) -> list[Decision]:
        """The guards for a switch that has connected."""
        beforehand = [
            self._protect(
                service, switch, "the settings name it as a service that matters", (), now, expires=0
            )
            for service in sorted(self._always)
        ]
        return beforehand + [_on(switch, decision) for decision in self._guarded.values()]

    def suspect(self, suspicion: Suspicion, until: int | None = None) -> Watch:
        """Collect the SYNs of a suspected flood up to a capture time, ns; None: all that have come."""
        host, since = suspicion.host, suspicion.since
        now = suspicion.now if until is None else until
        for service, decision in self._guarded.items():
            if service.address == host:
                expires = now + self.rules.protect_s * SECOND
                self._guarded[service] = _changed(decision, expires=expires)
        watch = Watch(suspicion, now)
        for port, source in self.recent.towards(host, since, until):
            watch.add(port, source)
        for at, source, service in self._finished:
            if since <= at and (until is None or at <= until) and service.address == host:
                watch.finished(service.port, source)
        return watch

    def handshake(self, source: str, service: TcpService, at: int) -> None:
        """A source has completed a handshake with a service."""
        source = shared_text(source)
        self.known.learn(source, at)
        service = self.services.pop(service, service)
        self.services[service] = service
        if len(self.services) > SERVICES_LEARNT:
            del self.services[next(iter(self.services))]
        self._finished.append((at, source, service))

    def ports_of(self, address: str) -> tuple[int, ...] | None:
        """Ports of a host's services, as known from handshakes; None if no handshake of anybody has been seen."""
        if not self.services:
            return None
        return tuple(service.port for service in self.services if service.address == address)

    def findings(self, watch: Watch, nats: float, *, sure: bool = True) -> Iterator[SynFinding]:
        """What a watch has come to, as evidence.

        To be decided one by one: what is decided about one counts for those after it.  Unless handshakes had time to
        complete (`sure`) nobody is to be blocked: the service is to be guarded, and the watch is marked as unsure.

        Args:
            watch: the SYNs towards a host.
            nats: the weight of a rule that decides by itself.
            sure: whether handshakes had time to complete.
        """
        sampled = self.rules.copies == "suspects"
        if not len(self.recent) or (sampled and not watch.total):  # the stream of SYNs does not reach us
            yield from self._known_services(watch, nats)
            return
        by_port: dict[int, dict[str, int]] = {}
        for (port, source), count in watch.syns.items():
            by_port.setdefault(port, {})[source] = count
        for port, syns in sorted(by_port.items()):
            sample = Sample(TcpService(watch.host, port), syns)
            verdict = judge_syns(sample, self.rules, self.allow, self.known, self.gather)
            if verdict.block and sure and self._is_dead(sample.service):
                # a device may send SYNs to a server that is gone: nothing is half-open there.  Where
                # only one direction passes the switch the guard has to do, since nobody can tell the two apart
                yield flood_evidence(sample, f"{verdict.reason} once it answers anybody", watch, nats)
            elif verdict.block and not sure:
                watch.unsure = True
                reason = f"{verdict.reason} unless they finish their handshakes soon; guarded meanwhile"
                yield flood_evidence(sample, reason, watch, nats)
            else:
                yield from self._of_verdict(sample, verdict, watch, nats)

    def _known_services(self, watch: Watch, nats: float) -> Iterator[SynFinding]:
        suspicion = watch.suspicion
        reason = f"{suspicion.evidence.summary}, whose SYNs were not seen here: its known service is guarded"
        for service in [each for each in self.services if each.address == watch.host]:
            unseen = Sample(service, {"": suspicion.count})
            yield flood_evidence(unseen, reason, watch, nats)

    def _of_verdict(
        self, sample: Sample, verdict: SynVerdict, watch: Watch, nats: float
    ) -> Iterator[SynFinding]:
        if verdict.protects:
            yield flood_evidence(sample, verdict.reason, watch, nats)
        blocked = {block.decision.target.address for block in self._lifecycle.blocks.values()}
        for source in verdict.block:
            if source not in blocked and not self._lifecycle.in_blocked_prefix(source):
                yield source_evidence(source, sample, verdict.reason, watch, nats)

    def decide(self, finding: SynFinding, offences: Mapping[str, EarlierBlocks] | None) -> list[Decision]:
        """Decisions by a finding; `offences` are earlier blocks by address, None if unknown."""
        evidence = finding.evidence
        if not finding.source:
            return self.guard(finding.service, finding.reason, (finding.exhibit,), evidence.event_time)
        cap = self._lifecycle.cap_reached(evidence.event_time)
        if cap is not None:
            self._lifecycle.refuse(cap, finding.source, evidence.event_time)
            return []
        note = "" if offences is not None else f" ({UNKNOWN_HISTORY})"
        made = self._lifecycle.open(
            EVERY_SWITCH,
            finding.target,
            finding.reason + note,
            (finding.exhibit,),
            evidence.event_time,
            offences=(offences or {}).get(finding.source, EarlierBlocks()).times,
        )
        return [made]

    def _is_dead(self, service: TcpService) -> bool:
        return service not in self.services and self._is_silent(service)

    def gather(self, addresses: Iterable[str]) -> dict[str, list[str]]:
        """Prefixes that may be blocked in place of the addresses."""
        rules = self._lifecycle.rules
        found = crowded_prefixes(
            addresses, rules.prefix_neighbours, rules.prefix_v4, rules.prefix_v6, self.is_inhabited
        )
        return {str(network): members for network, members in found.items()}

    def is_inhabited(self, prefix: Network) -> bool:
        """Whether the prefix contains a known, allowed or guarded address."""
        if self.allow.touches(prefix) or any_within(prefix, self.known):
            return True
        services = {each.address for each in (*self.services, *self._always, *self._guarded)}
        return any_within(prefix, services)

    def spared(self) -> Callable[[str], bool]:
        """Clients whose half-open connections are not reset: known, allowed, or with a finished handshake."""
        finished = {source for _, source, _ in self._finished}
        return lambda each: each in finished or each in self.known or self.allow.covers_address(each)

    def restore(self, decisions: Iterable[Decision]) -> None:
        """Restore guards that a flood led to before a restart; those of the settings are always set."""
        for decision in decisions:
            port = decision.target.port
            if decision.action == "protect" and decision.expires and port is not None:
                service = TcpService(decision.target.address, port)
                held = self._guarded.get(service)
                if held is None or held.expires < decision.expires:
                    # it was told to each switch that connected, and ends on all of them
                    self._guarded[service] = _on(EVERY_SWITCH, decision)

    def confirm(self, confirmation: Confirmation, now: int, *, stands: bool) -> None:
        """Record what a switch says of a guard; one that was refused is not in force, and a flood may set it again.

        Args:
            confirmation: of this or another decision.
            now: capture time, ns.
            stands: whether the decision is in force on any switch.
        """
        if confirmation.state == "failed" and not stands:
            for service, decision in self._guarded.items():
                if decision.id == confirmation.id:
                    self._refused[service] = self._guarded.pop(service), now
                    break
            if len(self._refused) > MOST_REFUSED:
                del self._refused[next(iter(self._refused))]
        elif stands:
            for service, (decision, _) in self._refused.items():
                if decision.id == confirmation.id:  # another switch had refused it before
                    del self._refused[service]
                    self._guarded.setdefault(service, decision)
                    break

    def holds(self, which: str) -> bool:
        """Whether a guard set because of a flood has this id or address."""
        return any(which in (each.id, service.address) for service, each in self._guarded.items())

    def release(self, which: str, now: int, reason: str) -> list[Decision]:
        """Lift guards set because of floods, by id or address; a flood that continues sets them again."""
        found = [service for service, each in self._guarded.items() if which in (each.id, service.address)]
        return [
            _changed(self._guarded.pop(service), action="unprotect", reason=reason, event_time=now)
            for service in found
        ]

    def release_all(self, now: int, reason: str) -> list[Decision]:
        """Lift all guards set because of floods."""
        lifted = [
            _changed(each, action="unprotect", reason=reason, event_time=now)
            for each in self._guarded.values()
        ]
        self._guarded.clear()
        return lifted

    def due(self, now: int) -> list[Decision]:
        """Lift guards that have expired."""
        over = [service for service, decision in self._guarded.items() if 0 < decision.expires <= now]
        reason = "no flood was seen for the length of a guard"
        return [
            _changed(self._guarded.pop(service), action="unprotect", reason=reason, event_time=now)
            for service in over
        ]

    def guard(
        self, service: TcpService, reason: str, evidence: tuple[Exhibit, ...], now: int
    ) -> list[Decision]:
        """Guard a service; nothing if it is guarded already."""
        expires = now + self.rules.protect_s * SECOND
        if service in self._guarded:
            self._guarded[service] = _changed(self._guarded[service], expires=expires)
        if service in self._always or service in self._guarded or self._was_refused(service, now):
            return []
        reason = reason if len(self.known) else f"{reason} ({COLD_HISTORY})"
        made = self._protect(service, EVERY_SWITCH, reason, evidence, now, expires=expires)
        self._guarded[service] = made
        self._refused.pop(service, None)
        return [made]

    def _was_refused(self, service: TcpService, now: int) -> bool:
        """Whether a switch has just refused a guard of it; tried at each suspicion it would come and go."""
        _, at = self._refused.get(service, (None, now - REFUSED_S * SECOND))
        return abs(now - at) < REFUSED_S * SECOND

    def _protect(
        self,
        service: TcpService,
        switch: str,
        reason: str,
        evidence: tuple[Exhibit, ...],
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
            dry_run=self._lifecycle.rules.dry_run or not self.rules.challenge,
        )


def _on(switch: str, decision: Decision) -> Decision:
    return _changed(decision, switch=switch)


def _changed(old: Decision, **changes: Any) -> Decision:
    return Decision(**({name: getattr(old, name) for name in old.__struct_fields__} | changes))
