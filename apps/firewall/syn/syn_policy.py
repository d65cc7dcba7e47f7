"""A SYN flood towards a service: block its senders, or protect the service?  Pure rules.

Blocking helps where few addresses send nearly everything and each of them again and again.  Spoofed
floods have almost one address per SYN: there only the SYN guard helps.  A guard harms nobody and comes
first; a block follows when the sources had time to complete their handshakes and did not.  An address
that has completed handshakes before, or is on the allow-list, is never blocked, since anybody can forge
it in a SYN; nor is one that sends far less than the flood's own sources: a client of a service whose
backlog is full repeats its SYNs, too.  If a service answers nobody (SynDefence tells), nobody is blocked.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

import msgspec

from apps.firewall.policy.rules import AllowList
from apps.firewall.syn.services import TcpService


class SynRules(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the defence against SYN floods."""

    copies: Literal["suspects", "all"] = "suspects"
    """Which SYNs the switch copies: samples of those towards hosts that it reports, or all of them, as replays need,
    where a flood may be over before a sample can be requested."""
    threshold: int = 100
    """SYNs towards one host within a window from which a flood is suspected; with all copies new half-open
    connections also count."""
    window_ms: int = 200
    """Length of that window."""
    grace_ms: int = 60
    """Capture time that handshakes get to complete before the service is guarded."""
    patience_ms: int = 1000
    """Capture time that a source gets to complete its handshakes before it is blocked."""
    reset_after_ms: int = 1000
    """Age at which half-open connections that a flood left at a server are reset, once a rule stops the flood."""
    resets: int = 4096
    """Maximum number of resets for one decision; 0: none, the connections stay until the server's own time-out."""
    sample: int = 20_000
    """SYNs kept in memory for the case that a flood is suspected."""
    sample_most: int = 500
    """SYNs that are copied of one suspected flood."""
    sample_ms: int = 1500
    """Longest time for which they are copied."""
    least: int = 50
    """Minimum number of SYNs without a handshake in a sample that counts as a flood."""
    repeats: int = 4
    """A source is repeating if it sent this many SYNs of the sample ..."""
    share: float = 0.9
    """Repeating sources are blocked if they sent at least this share of the sample ..."""
    lightest: float = 0.33
    """... and at least this fraction of the weighted median of SYNs per source."""
    sources: int = 200
    """... and there are at most this many of them."""
    protect_s: int = 3600
    """Seconds for which a service is guarded after a flood; services in `guard` always are."""
    challenge: bool = True
    """False: guards are decided and reported, but nobody is challenged and no connection is reset, as in replays,
    whose clients cannot answer."""


@dataclass(frozen=True)
class Sample:
    """SYNs towards a service that no handshake has followed, by source."""

    service: TcpService
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
        return SynVerdict("nothing", (), f"{total} unfinished SYNs towards {sample.service} are not a flood")
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
    spared_note = f"{names} may be forged (known or allowed), so the service is guarded"
    if not block:
        return SynVerdict("protect", (), f"{what}; {share}: {spared_note}")
    return SynVerdict(
        "block and protect", block, f"{what}; {share}: blocked but for {len(spared)}; {spared_note}"
    )


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
    """Sources too many to block one by one: block their common prefixes if that covers enough of them."""
    prefixes = gather(repeating) if gather else {}
    members = {address for some in prefixes.values() for address in some}
    theirs = sum(repeating[address] for address in members)
    if len(prefixes) <= rules.sources and theirs >= rules.share * sum(repeating.values()):
        named = tuple(sorted(prefixes))
        return SynVerdict(
            "block", named, f"{what}: {len(members):,} of them share prefixes, which are blocked"
        )
    return SynVerdict("protect", (), f"{what}: too many to block, so the service is guarded")
