"""Prefixes with so many misbehaving addresses that the whole prefix is blocked.  Pure.

A prefix with a known, allowed or guarded address is never blocked: an attacker who forges addresses of such
a prefix must not get it blocked.
"""

import ipaddress
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping

from apps.firewall.policy.block_lifecycle import SECOND, BlockLifecycle
from apps.messages import Decision, Target

Network = ipaddress.IPv4Network | ipaddress.IPv6Network


def prefix_of(address: str, v4: int, v6: int) -> Network:
    """The prefix that would be blocked in place of an address."""
    bits = v6 if ":" in address else v4
    return ipaddress.ip_network(f"{address}/{bits}", strict=False)


def crowded_prefixes(
    addresses: Iterable[str], least: int, v4: int, v6: int, spare: Callable[[Network], bool]
) -> dict[Network, list[str]]:
    """Prefixes with at least the configured number of the addresses, and these; spared prefixes are left out."""
    if not least:
        return {}
    groups: defaultdict[Network, list[str]] = defaultdict(list)
    for address in addresses:
        groups[prefix_of(address, v4, v6)].append(address)
    return {
        network: sorted(members)
        for network, members in groups.items()
        if len(members) >= least and not spare(network)
    }


def any_within(network: Network, addresses: Collection[str]) -> bool:
    """Whether one of the addresses lies in the network."""
    if network.num_addresses <= 256 and len(addresses) > 256:
        return any(str(each) in addresses for each in network)
    parsed = (ipaddress.ip_address(each) for each in addresses)
    return any(each.version == network.version and each in network for each in parsed)


def gather_blocks(
    lifecycle: BlockLifecycle, gather: Callable[[Iterable[str]], Mapping[str, Collection[str]]], now: int
) -> Iterator[Decision]:
    """Replace blocks of many addresses of a prefix by one block of the prefix; those asked for stay as they are."""
    single = {
        block.decision.target.address: block.decision
        for block in lifecycle.blocks.values()
        if block.decision.target.kind == "ip"
        and "/" not in block.decision.target.address
        and not block.is_asked_for
    }
    for prefix, members in gather(single).items():
        made = [single[each] for each in members]
        switches = {each.switch for each in made}
        evidence = [each for decision in made[-3:] for each in decision.evidence]
        reason = (
            f"{len(members)} addresses of {prefix} are blocked: the whole prefix is, instead of each of them"
        )
        yield lifecycle.open(
            switches.pop() if len(switches) == 1 else "*",
            Target(kind="ip", address=prefix),
            reason,
            evidence,
            now,
            seconds=max(1, max(each.expires for each in made) - now) // SECOND or 1,
        )
        for each in made:
            lifted = lifecycle.lift(each.id, now, f"{prefix} is blocked as a whole")
            if lifted is not None:
                yield lifted
