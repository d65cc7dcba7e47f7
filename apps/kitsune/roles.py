"""Roles of senders: gateways, DNS, DHCP and multicast speakers alert but are not blocked.

Roles are learnt from the training traffic only, so that an attacker cannot acquire one later.
"""

import ipaddress
from functools import lru_cache
from typing import Any, Final

from apps.messages import Role

MOST_ADDRESSES: Final = 1_024
"""Most addresses remembered behind one MAC; counting stops there."""
MOST_MACS: Final = 65_536
_ROUTED: Final = 3
"""A MAC with traffic from or to this many addresses outside the local network is a gateway."""
_DNS, _DHCP = 53, 67
_FEW: Final = 4
_KEPT: Final = 4_096
"""Addresses of which it is known whether they are inside."""
_BORROWED: Final = 4
"""Most addresses of a host that lends itself others' names; a MAC with more may be a new router."""

Address = tuple[int, int, int]


class Roles:
    """Learns roles, and the addresses behind each MAC."""

    def __init__(self) -> None:
        self._behind: dict[int, set[Address]] = {}
        self._towards: dict[int, set[Address]] = {}
        self._serves: dict[Address, Role] = {}
        self._multicast: dict[Address, list[int]] = {}
        self._gateways: set[int] = set()
        self._gateway_addresses: set[Address] = set()
        self._counted: dict[int, tuple[int, int]] = {}
        """By MAC: how many addresses there were, and what `addresses` said."""

    def see(self, mac: int, address: Address) -> None:
        """A frame came from this MAC and address (once per sender is enough)."""
        if address[0] and not is_link_local(address):
            _remember(self._behind, mac, address)

    def learn(
        self, address: Address, udp_sport: int, to_mac: int, destination: Address, to_multicast: bool
    ) -> None:
        """Learn from a training packet: the role of its sender and of the MAC that forwards it."""
        if destination[0] and not to_multicast:
            _remember(self._towards, to_mac, destination)
        if udp_sport == _DNS and self._serves.get(address) != "dhcp":
            self._serves[address] = "dns"
        elif udp_sport == _DHCP:
            self._serves[address] = "dhcp"
        tally = self._multicast.setdefault(address, [0, 0])
        tally[0] += 1
        tally[1] += to_multicast

    def towards(self, mac: int, address: Address) -> None:
        """A training packet went to this MAC for this address (once per pair is enough)."""
        _remember(self._towards, mac, address)

    def spoke(self, address: Address, packets: int, multicast: int, *, dns: bool, dhcp: bool) -> None:
        """What an address sent in training: number of packets, of those to groups, and of those as DNS or DHCP server."""
        if dns or dhcp:
            self._serves[address] = "dhcp" if dhcp else "dns"
        self._multicast[address] = [packets, multicast]

    def is_full(self, mac: int) -> bool:
        """Whether no more addresses are remembered behind a MAC."""
        return len(self._behind.get(mac, ())) >= MOST_ADDRESSES

    def close_training(self) -> None:
        """End training: roles do not change any more."""
        for mac in self._behind.keys() | self._towards.keys():
            behind = self._behind.get(mac, set())
            routed = behind | self._towards.get(mac, set())
            if sum(not is_inside(address) for address in routed) >= _ROUTED:
                self._gateways.add(mac)
                self._gateway_addresses |= {address for address in behind if is_inside(address)}
        self._towards.clear()
        for address, (packets, multicast) in self._multicast.items():
            if address[0] and packets >= _FEW and 2 * multicast >= packets:
                self._serves.setdefault(address, "multicast")
        self._multicast.clear()

    def role(self, mac: int, address: Address) -> Role:
        """A sender's role in training; an outside address behind a gateway's MAC is a host."""
        if address in self._gateway_addresses or (mac in self._gateways and not address[0]):
            return "gateway"
        return self._serves.get(address, "host")

    def addresses(self, mac: int) -> int:
        """Number of addresses of one family seen behind a MAC, without link-local ones."""
        behind = self._behind.get(mac, set())
        count, most = self._counted.get(mac, (0, 0))
        if count != len(behind):  # addresses are never forgotten
            fourth = sum(address[0] == 4 for address in behind)
            most = max(fourth, len(behind) - fourth)
            self._counted[mac] = len(behind), most
        return most

    def is_borrowed(self, mac: int, address: Address) -> bool:
        """Whether a local host uses an outside address beside its own: training has such addresses behind gateways only."""
        return (
            bool(self._gateways)
            and mac not in self._gateways
            and address[0] != 0
            and not is_inside(address)
            and 1 < self.addresses(mac) <= _BORROWED
        )

    def is_routed(self, mac: int, address: Address) -> bool:
        """Whether the sender is behind a gateway of training."""
        return mac in self._gateways and address[0] != 0 and address not in self._gateway_addresses

    def to_state(self) -> dict[str, Any]:
        """The learnt roles as plain values."""
        return {
            "behind": [[mac, sorted(map(list, addresses))] for mac, addresses in self._behind.items()],
            "serves": [[list(address), role] for address, role in self._serves.items()],
            "gateways": sorted(self._gateways),
            "gateway_addresses": sorted(map(list, self._gateway_addresses)),
        }

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> "Roles":
        """The inverse of `to_state`."""
        roles = cls()
        roles._behind = {mac: {_address(entry) for entry in entries} for mac, entries in state["behind"]}
        roles._serves = {_address(entry): role for entry, role in state["serves"]}
        roles._gateways = set(state["gateways"])
        roles._gateway_addresses = {_address(entry) for entry in state["gateway_addresses"]}
        return roles


def _remember(table: dict[int, set[Address]], mac: int, address: Address) -> None:
    addresses = table.get(mac)
    if addresses is None:
        if len(table) >= MOST_MACS:
            return
        addresses = table[mac] = set()
    if len(addresses) < MOST_ADDRESSES:
        addresses.add(address)


def _address(entry: list[int]) -> Address:
    version, hi, lo = entry
    return version, hi, lo


def _parsed(address: Address) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    version, hi, lo = address
    return ipaddress.IPv4Address(lo) if version == 4 else ipaddress.IPv6Address(hi << 64 | lo)


@lru_cache(maxsize=_KEPT)
def is_link_local(address: Address) -> bool:
    """Whether an address is link-local or unspecified; every host has one besides its own."""
    parsed = _parsed(address)
    return parsed.is_unspecified or (address[0] == 6 and parsed.is_link_local)


@lru_cache(maxsize=_KEPT)
def is_inside(address: Address) -> bool:
    """Whether an address is private or link-local, and so of the local network."""
    return _parsed(address).is_private
