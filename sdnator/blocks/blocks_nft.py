"""Active blocks as an nftables ruleset, for hosts that have no P4 switch before them."""

import ipaddress
from collections.abc import Iterable

from apps.messages import Decision, Target


def nft_sets(decisions: Iterable[Decision]) -> str:
    """Blocked addresses, prefixes and MACs as a table of their own, which replaces itself when it is loaded."""
    targets = [each.target for each in decisions if each.action == "block" and not each.dry_run]
    sets = {
        "blocked4": ("ipv4_addr; flags interval; auto-merge", _addresses(targets, 4)),
        "blocked6": ("ipv6_addr; flags interval; auto-merge", _addresses(targets, 6)),
        "blocked_mac": ("ether_addr", sorted({each.address for each in targets if each.kind == "mac"})),
    }
    lines = ["table inet sdnator", "delete table inet sdnator", "table inet sdnator {"]
    for name, (kind, addresses) in sets.items():
        elements = f" elements = {{ {', '.join(addresses)} }};" if addresses else ""
        lines.append(f"  set {name} {{ type {kind};{elements} }}")
    for hook in ("input", "forward"):
        lines += [f"  chain {hook} {{", f"    type filter hook {hook} priority -10;"]
        lines += [
            "    ip saddr @blocked4 drop",
            "    ip6 saddr @blocked6 drop",
            "    ether saddr @blocked_mac drop",
            "  }",
        ]
    return "\n".join([*lines, "}"])


def _addresses(targets: Iterable[Target], version: int) -> list[str]:
    networks = {ipaddress.ip_network(each.address) for each in targets if each.kind == "ip"}
    found = sorted(each for each in networks if each.version == version)
    return [str(each.network_address if each.num_addresses == 1 else each) for each in found]
