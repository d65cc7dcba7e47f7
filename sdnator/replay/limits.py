"""What the rate limits of a replay looked at and dropped; and what those of a dry run would have dropped.

The switch drops what is over a limit, and says of each packet only that it was dropped: those that a limit in force
looks at are put down to it.  Where limits are decided but not set, a meter as the switch's is run here.
"""

import ipaddress
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from apps.messages import Decision, RateLimit
from sdnator.capture.captures import Capture
from sdnator.replay.guards import batches

_SECOND_US: Final = 1_000_000
_SYN, _ACK = 0x02, 0x10
_HALF: Final = 64
_NEVER: Final = np.iinfo(np.int64).max


class TokenBucket:
    """A meter with one rate and a burst of a second's worth, full at first.

    Args:
        rate: packets a second.
    """

    def __init__(self, rate: int) -> None:
        self._rate = rate
        self._tokens = rate
        self._last = 0

    def take(self, time_us: int) -> bool:
        """Whether a packet may pass."""
        gained = time_us * self._rate // _SECOND_US
        if gained > self._last:
            self._tokens = min(self._tokens + gained - self._last, self._rate)
        self._last = gained
        if self._tokens < 1:
            return False
        self._tokens -= 1
        return True


class ModelledLimit:
    """A rate limit with its meters, packet by packet.

    Args:
        victim: address.
        limit: what is limited.
    """

    def __init__(self, victim: str, limit: RateLimit) -> None:
        self._victim = victim
        self._limit = limit
        self._meter = TokenBucket(limit.rate)
        self._spared = {
            int(ipaddress.ip_address(source)): TokenBucket(limit.spared_rate) for source in limit.spared
        }
        self.dropped = 0

    def over(self, columns: Mapping[str, Any], among: NDArray[np.bool_] | None = None) -> NDArray[np.bool_]:
        """Which packets it drops, of those in `among`; they come in order of time."""
        mine = matches(columns, self._victim, self._limit)
        rows = np.flatnonzero(mine if among is None else mine & among)
        found = np.zeros(len(mine), np.bool_)
        fields = (columns[name][rows].tolist() for name in ("time_us", "ip_src_hi", "ip_src_lo"))
        for row, time_us, high, low in zip(rows.tolist(), *fields, strict=True):
            if not self._meter.take(time_us):
                own = self._spared.get(high << _HALF | low)
                found[row] = own is None or not own.take(time_us)
        self.dropped += int(found.sum())
        return found


def matches(columns: Mapping[str, Any], victim: str, limit: RateLimit) -> NDArray[np.bool_]:
    """Which packets a rate limit looks at."""
    network = ipaddress.ip_network(victim)
    mine: NDArray[np.bool_] = (columns["ip_version"] == network.version) & (columns["quoted"] == 0)
    shift, address = 128 if network.version == 6 else 32, int(network.network_address)
    mask = (1 << shift) - (1 << (shift - network.prefixlen))
    for name, part in (("ip_dst_hi", _HALF), ("ip_dst_lo", 0)):
        low_mask = np.uint64(mask >> part & (1 << _HALF) - 1)
        mine &= columns[name] & low_mask == np.uint64(address >> part & (1 << _HALF) - 1)
    if limit.kind == "icmp":
        kind, echo = ("icmp_type", 8) if network.version == 4 else ("icmp6_type", 128)
        mine &= columns[kind] == echo
    elif limit.kind == "tcp":
        mine &= (columns["tcp_dport"] == limit.port) & (columns["tcp_flags"] & _SYN == 0)
    elif limit.kind == "syn":
        mine &= (columns["tcp_dport"] >= 0) & (columns["tcp_flags"] & (_SYN | _ACK) == _SYN)
        mine &= ~np.isin(columns["tcp_dport"], limit.open_ports)
    elif limit.kind == "udp":
        mine &= columns["udp_sport"] >= 0
    else:
        mine &= columns["udp_sport" if limit.kind == "udp_from" else "udp_dport"] == limit.port
    return mine


@dataclass(frozen=True)
class ReplayedLimit:
    """A rate limit that was decided: in force from `since` until before `until`, capture time in ns."""

    decision: Decision
    limit: RateLimit
    since: int
    until: int


@dataclass(eq=False)
class LimitedPackets:
    """What the rate limits of a pass did; one entry of the arrays for each packet of the capture."""

    seen: NDArray[np.bool_]
    """Looked at by a limit that was set."""
    would: NDArray[np.bool_]
    """Would have been dropped by a limit that was not set."""
    by_limit: list[tuple[ReplayedLimit, NDArray[np.bool_]]] = field(default_factory=list)
    """Each limit, and the packets that it looked at; of a dry run those that it would have dropped."""

    def rows(self, time_ns: NDArray[np.int64], dropped: NDArray[np.bool_]) -> list[dict[str, Any]]:
        """One row for each limit, in the order of deciding.

        Args:
            time_ns: of each packet.
            dropped: which packets the switch dropped.
        """
        return [
            {
                "id": each.decision.id,
                "address": each.decision.target.address,
                "packets": each.limit.words,
                "rate": each.limit.rate,
                "spared": len(each.limit.spared),
                "reason": each.decision.reason,
                "decided": each.since / 1e9,
                "packet": int(np.argmax(time_ns >= each.since))
                if bool((time_ns >= each.since).any())
                else None,
                "effect": "would limit" if each.decision.dry_run else "limited",
                "packets_dropped": 0 if each.decision.dry_run else int((mine & dropped).sum()),
                "packets_passed": 0 if each.decision.dry_run else int((mine & ~dropped).sum()),
                "packets_would_be_dropped": int(mine.sum()) if each.decision.dry_run else 0,
            }
            for each, mine in self.by_limit
        ]


def limits_of(decisions: Sequence[Decision]) -> list[ReplayedLimit]:
    """Rate limits from decisions, in their order; one that is never lifted lasts to the end."""
    ends = {each.id: each.event_time for each in reversed(decisions) if each.action == "unmeter"}
    first = {each.id: each for each in reversed(decisions) if each.action == "meter"}
    return [
        ReplayedLimit(each, each.limit, each.event_time, ends.get(each.id, _NEVER))
        for each in sorted(first.values(), key=lambda each: (each.event_time, each.id))
        if each.limit is not None
    ]


def limited_packets(capture: Path, packets: int, decisions: Sequence[Decision]) -> LimitedPackets:
    """Read a capture again, if there were rate limits, and find the packets that these looked at.

    Args:
        capture: the file.
        packets: how many of its packets were replayed.
        decisions: of the firewall.
    """
    found = LimitedPackets(np.zeros(packets, np.bool_), np.zeros(packets, np.bool_))
    limits = limits_of(decisions)
    if not limits:
        return found
    masks = [np.zeros(packets, np.bool_) for _ in limits]
    models = [ModelledLimit(each.decision.target.address, each.limit) for each in limits]
    with Capture(capture) as frames:
        for first, batch in batches(islice(iter(frames), packets)):
            here = slice(first, first + len(batch))
            times = batch["time_us"]
            for each, mask, model in zip(limits, masks, models, strict=True):
                within = (times >= each.since // 1_000) & (times < each.until // 1_000)
                if each.decision.dry_run:
                    mask[here] = model.over(batch, within)
                else:
                    mask[here] = matches(batch, each.decision.target.address, each.limit) & within
    for each, mask in zip(limits, masks, strict=True):
        found.by_limit.append((each, mask))
        target = found.would if each.decision.dry_run else found.seen
        target |= mask
    return found
