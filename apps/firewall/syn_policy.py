"""A SYN flood towards a service: block its senders, or protect the service?  Pure rules.

Blocking helps where few addresses send nearly everything and each of them again and again.  Spoofed
floods have almost one address per SYN: there only the SYN guard helps.  A guard harms nobody and comes
first; a block follows when the sources had time to finish their handshakes, and did not.  An address
that has completed handshakes before, or is on the allow-list, is never blocked, since anybody can write
it into a SYN; nor is one that sends far less than the flood's own sources: a client of a service whose
backlog is full repeats its SYNs, too.  Where a service answers nobody (SynDefence knows), nobody is blocked.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

import msgspec

from apps.firewall.policy import AllowList
from apps.firewall.services import Service


class SynRules(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the operator can set about SYN floods."""

    threshold: int = 100
    """SYNs, or half-open connections, that come up within a window towards one host: a flood is suspected."""
    window_ms: int = 200
    """Length of that window."""
    grace_ms: int = 100
    """So long, wall time, may the handshakes of a surge of SYNs take to be finished."""
    patience_ms: int = 1000
    """... and so long until a source is blocked for not finishing them; the service is guarded meanwhile."""
    reset_after_ms: int = 1000
    """Half-open connections that a flood left at a server are reset at this age, when a rule stops the flood."""
    resets: int = 4096
    """At most so many for one decision; 0: none, the server's own time-out is waited out."""
    sample: int = 20_000
    """SYNs kept at a time, to be looked at when a flood is suspected."""
    least: int = 50
    """Fewer unfinished SYNs in a sample are no flood."""
    repeats: int = 4
    """A source repeats when it sent this many unanswered SYNs of the sample."""
    share: float = 0.9
    """Repeating sources are blocked if this share of the sample is theirs."""
    lightest: float = 0.33
    """... at least this part of what the sources send that make up the flood (its weighted median)."""
    sources: int = 200
    """... and they are no more than this."""
    protect_s: int = 3600
    """A service is protected for this long after a flood; services of the settings always."""


@dataclass(frozen=True)
class Sample:
    """SYNs towards a service that no handshake has followed, by source."""

    service: Service
    syns: Mapping[str, int]

    @property
    def total(self) -> int:
        return sum(self.syns.values())


@dataclass(frozen=True)
class SynVerdict:
    """What to do; `block` names the sources, `protect` is the service's guard."""

    kind: Literal["nothing", "block", "protect", "block and protect"]
    block: tuple[str, ...]
    reason: str

    @property
    def protects(self) -> bool:
        return self.kind in ("protect", "block and protect")


Gather = Callable[[Iterable[str]], Mapping[str, Collection[str]]]
"""Addresses → the prefixes that may be blocked in their place, each with its members."""


def judge_syns(
    sample: Sample, rules: SynRules, allow: AllowList, known: Collection[str], gather: Gather | None = None
) -> SynVerdict:
    """Which defence follows from the number and repetition of sources."""
    total = sample.total
    if total < rules.least:
        return SynVerdict("nothing", (), f"{total} unfinished SYNs towards {sample.service} are no flood")
    floor = max(rules.repeats, rules.lightest * _typical(sample.syns.values()))
    repeating = {source: count for source, count in sample.syns.items() if count >= floor}
    theirs = sum(repeating.values())
    what = f"{total:,} unfinished SYNs from {len(sample.syns):,} sources towards {sample.service}"
    share = f"{len(repeating):,} of the sources repeat and sent {theirs / total:.0%}"
    if theirs < rules.share * total:
        return SynVerdict(
            "protect", (), f"{what}; {share}: spoofed or too many to block, so the service is guarded"
        )
    if len(repeating) > rules.sources:
        return _by_prefix(repeating, rules, f"{what}; {share}", gather)
    spared = sorted(source for source in repeating if source in known or allow.covers_address(source))
    block = tuple(sorted(repeating.keys() - set(spared)))
    if not spared:
        return SynVerdict("block", block, f"{what}; {share}: these are blocked")
    names = ", ".join(spared[:3])
    excuse = f"{names} may be forged (known or allowed), so the service is guarded"
    if not block:
        return SynVerdict("protect", (), f"{what}; {share}: {excuse}")
    return SynVerdict("block and protect", block, f"{what}; {share}: blocked but for {len(spared)}; {excuse}")


def _typical(counts: Iterable[int]) -> int:
    """The weighted median: half of all SYNs come from sources that sent at least this many."""
    ordered = sorted(counts)
    half, seen = sum(ordered) / 2, 0
    for count in ordered:
        seen += count
        if seen >= half:
            return count
    return 0


def _by_prefix(repeating: Mapping[str, int], rules: SynRules, what: str, gather: Gather | None) -> SynVerdict:
    """Too many to block one by one: perhaps they are neighbours."""
    prefixes = gather(repeating) if gather else {}
    members = {address for some in prefixes.values() for address in some}
    theirs = sum(repeating[address] for address in members)
    if len(prefixes) <= rules.sources and theirs >= rules.share * sum(repeating.values()):
        named = tuple(sorted(prefixes))
        return SynVerdict(
            "block", named, f"{what}: {len(members):,} of them are neighbours, blocked by prefix"
        )
    return SynVerdict("protect", (), f"{what}: too many to block, so the service is guarded")
