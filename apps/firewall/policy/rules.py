"""Options of blocking, the allow-list, and the rule of seconds: pure, no clock and no I/O.

Under the rule of seconds a sender is blocked at five anomalous seconds of ten, or at two if its rate is also twenty times its highest
rate of any second of training.  A MAC is blocked only if it has a single address, otherwise the address is;
routers and servers alert but are not blocked unless the operator says so; the allow-list always wins.
"""

import ipaddress
from dataclasses import dataclass, field
from typing import Literal

import msgspec

from apps.messages import Alert, Role, Sender, Target


class Rules(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of blocking."""

    rule: Literal["sequential", "seconds", "paper"] = "sequential"
    """What decides: the sum of all evidence, anomalous seconds, or the first packet at or above the threshold."""
    false_blocks_per_day: float = 0.1
    """Sequential rule: how many false blocks a day are acceptable; the bound follows from it and from training."""
    anomalous_seconds: int = 5
    """Rule of seconds: anomalous seconds among the last ten that lead to a block."""
    anomalous_seconds_fast: int = 2
    """The same for senders far beyond their training rate."""
    fast_rate_ratio: float = 20.0
    """\"Far beyond\": this many times the highest rate of any second of training."""
    protected_roles: tuple[Role, ...] = ("gateway", "dns", "dhcp", "multicast")
    """Senders in these roles alert but are not blocked."""
    allow: tuple[str, ...] = ()
    """Addresses, prefixes and MAC addresses that are never blocked."""
    durations_s: tuple[int, ...] = (600, 3600, 86_400, 604_800)
    """Length of a block by offence: first, second, third, fourth and later."""
    limit_s: int = 60
    """Seconds for which a rate limit lasts; then it is lifted, unless it still drops a flood."""
    max_blocks: int = 4096
    """Maximum number of blocks in force; beyond it the firewall stops blocking and reports that."""
    max_decisions_per_minute: int = 120
    """Maximum number of blocks decided per minute of capture time; beyond it the firewall stops blocking and reports that."""
    max_known_share: float = 0.25
    """Largest share of the hosts known from handshakes, or from training if that saw more, that may be blocked at a time
    (one always may)."""
    block_known_addresses: bool = False
    """Also block addresses known from handshakes that are behind a router; others can forge them."""
    block_unproven_addresses: bool = False
    """Also block addresses behind a router that have completed no handshake; others can forge them."""
    prefix_neighbours: int = 128
    """Number of misbehaving addresses of one prefix from which the whole prefix is blocked; 0: never."""
    prefix_v4: int = 24
    """Length of that prefix for IPv4."""
    prefix_v6: int = 64
    """Length of that prefix for IPv6."""
    false_alarm_days: int = 90
    """Days of capture time for which evidence that was called a false alarm counts less."""
    dry_run: bool = False
    """Decide and archive, but write nothing to the switch."""

    def __post_init__(self) -> None:
        if not self.false_blocks_per_day > 0:
            raise ValueError(
                f"false_blocks_per_day={self.false_blocks_per_day}: must be greater than 0, for instance 0.1"
            )
        if not 1 <= self.false_alarm_days <= 3_650:
            raise ValueError(f"false_alarm_days={self.false_alarm_days}: must be 1 to 3,650")
        if not self.limit_s > 0:
            raise ValueError(f"limit_s={self.limit_s}: must be greater than 0, for instance 60")


@dataclass(frozen=True)
class AllowList:
    """Addresses, prefixes and MACs that no block may touch."""

    networks: tuple[ipaddress.IPv4Network | ipaddress.IPv6Network, ...] = ()
    macs: frozenset[str] = field(default_factory=frozenset)

    @classmethod
    def parse(cls, entries: tuple[str, ...]) -> "AllowList":
        """Read entries of the operator; raises ValueError that names the wrong one."""
        networks, macs = [], set()
        for entry in entries:
            if is_mac(entry):
                macs.add(entry.lower())
                continue
            try:
                networks.append(ipaddress.ip_network(entry, strict=False))
            except ValueError as error:
                raise ValueError(
                    f"allow-list entry {entry!r} is not an IP address, prefix or MAC address: {error}"
                ) from error
        return cls(tuple(networks), frozenset(macs))

    def covers(self, sender: Sender) -> bool:
        """True if a block of this sender would touch an allowed one."""
        if sender.mac in self.macs:
            return True
        return bool(sender.ip) and self.covers_address(sender.ip)

    def covers_target(self, target: Target) -> bool:
        """True if a block of this target would touch an allowed one."""
        if target.kind == "mac":
            return target.address.lower() in self.macs
        return self.covers_address(target.address)

    def covers_address(self, text: str) -> bool:
        """True if the address is an allowed one; of a prefix, if one of its addresses is."""
        if "/" in text:
            return self.touches(ipaddress.ip_network(text))
        address = ipaddress.ip_address(text)
        return any(address in network for network in self.networks)

    def touches(self, prefix: ipaddress.IPv4Network | ipaddress.IPv6Network) -> bool:
        """True if an allowed address lies in the prefix, or the prefix in an allowed one."""
        # a network of the other IP version overlaps with nothing
        return any(prefix.overlaps(network) for network in self.networks)


def is_mac(text: str) -> bool:
    """Whether a text is a MAC address with colons."""
    octets = text.split(":")
    return len(octets) == 6 and all(
        len(octet) == 2 and set(octet.lower()) <= set("0123456789abcdef") for octet in octets
    )


@dataclass(frozen=True)
class PolicyVerdict:
    """Result of the rules for an alert: a target to block, or why there is none."""

    target: Target | None
    reason: str


def judge(alert: Alert, rules: Rules, allow_list: AllowList, *, on_probation: bool = False) -> PolicyVerdict:
    """Apply the rules to one alert.  On probation one anomalous second is enough."""
    needed, why = _seconds_needed(alert, rules, on_probation=on_probation)
    if alert.anomalous_seconds < needed:
        return PolicyVerdict(None, f"{alert.anomalous_seconds} anomalous seconds of ten, {needed} needed")
    if allow_list.covers(alert.sender):
        return PolicyVerdict(None, "the sender is on the allow-list")
    if alert.role in rules.protected_roles:
        return PolicyVerdict(None, f"the sender is a {alert.role}: it alerts but is not blocked")
    target = narrowest_target(alert.sender, alert.mac_addresses)
    if target is None:
        return PolicyVerdict(
            None,
            f"{alert.mac_addresses} addresses are behind {alert.sender.mac}, and the frames carry no address",
        )
    return PolicyVerdict(target, f"{why}: {alert.reason}")


def _seconds_needed(alert: Alert, rules: Rules, *, on_probation: bool) -> tuple[int, str]:
    if on_probation:
        return 1, "anomalous again during probation"
    ratio = alert.rate / alert.training_rate if alert.training_rate > 0 else 0.0
    if ratio >= rules.fast_rate_ratio:
        return rules.anomalous_seconds_fast, (
            f"anomalous in {alert.anomalous_seconds} seconds of the last ten at {ratio:.0f} times its training rate"
        )
    return rules.anomalous_seconds, f"anomalous in {alert.anomalous_seconds} seconds of the last ten"


def narrowest_target(sender: Sender, mac_addresses: int) -> Target | None:
    """The narrowest match that stops this sender and nobody else; None if there is none.

    Args:
        sender: whom to stop.
        mac_addresses: IP addresses seen behind its MAC.
    """
    if mac_addresses <= 1:
        return Target(kind="mac", address=sender.mac, port=sender.port)
    if sender.ip:
        return Target(kind="ip", address=sender.ip)
    return None
