"""Owners of IPv4 addresses (MAC and port), learnt from ARP, and claims of others' addresses.  Pure.

A claim of an address that belongs to another host proves nothing by itself: hosts get new addresses, and
a standby takes over from a dead router.  It is an attack if the owner, from its own port and MAC, uses
the address after the claim.  Then the claimant's port + MAC is blocked, never the address.

Four cases are only reported and lead to no block: the owner was not present in training, so it may be the
attacker itself; it speaks from a port to which it has moved since, as an attacker under its MAC would; the
claimant has the owner's MAC on another port, as an owner that moves to and fro has; and the claimant shares its
port with other hosts, one of which may have forged its MAC.

An owner that was present in training stays the owner on its port of training: its MAC on another port is a claim,
and becomes a move, which holds until the port of training speaks again, if that port is silent for as long as a
claim waits.
"""

import ipaddress
from collections import OrderedDict, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple, Self

from due import RecordBatch

ADDRESSES: Final = 16_384
CLAIMS: Final = 1024
PORTS: Final = 1024
STATIONS: Final = 256
"""MAC addresses remembered per port."""
_GROUP: Final = 1 << 40


class BoundHost(NamedTuple):
    """A MAC address behind a port of a switch."""

    port: int
    mac: int

    @classmethod
    def of(cls, port: int, mac: str) -> Self:
        """From a MAC address with colons."""
        return cls(port, int(mac.replace(":", ""), 16))

    @property
    def text(self) -> str:
        """The MAC address with colons."""
        return ":".join(f"{byte:02x}" for byte in self.mac.to_bytes(6, "big"))


@dataclass
class _Binding:
    host: BoundHost
    home: BoundHost
    """The host where it was bound; `host` has the same MAC, and another port after a move."""
    since: int
    seen: int
    trained: bool
    """It was present in training, and nobody else claimed its address."""


@dataclass(frozen=True)
class BindingConflict:
    """A host claims an address whose owner is present; times are capture time in ns."""

    address: str
    owner: BoundHost
    thief: BoundHost
    claimed: int
    """When it claimed the address."""
    at: int
    """When the owner spoke."""
    owner_trained: bool
    """Whether the owner was present in training, on this port; otherwise it may be the attacker."""
    thief_alone: bool
    """Whether no other host behind its port could have forged its MAC."""

    @property
    def certain(self) -> bool:
        """Whether a block of the claimant harms nobody else."""
        return self.owner_trained and self.thief_alone and self.thief.mac != self.owner.mac


class ArpBindings:
    """At most `ADDRESSES` addresses; the least recently used one is evicted first.

    Training lasts `training_s` from the first packet on; later bindings are settled after `settle_s` without
    another claim.  A claim waits `contest_s` for the owner.
    """

    def __init__(self, *, training_s: float, settle_s: float, contest_s: float) -> None:
        self._training = int(training_s * 1e9)
        self._trained_at = 0
        self._settle = int(settle_s * 1e9)
        self._contest = int(contest_s * 1e9)
        self._bound: OrderedDict[int, _Binding] = OrderedDict()
        self._claims: OrderedDict[tuple[int, BoundHost], int] = OrderedDict()
        self._behind: defaultdict[int, set[int]] = defaultdict(set)

    def __len__(self) -> int:
        return len(self._bound)

    @property
    def claims(self) -> int:
        """Claims that wait for the owner to speak."""
        return len(self._claims)

    def add(self, batch: RecordBatch) -> list[BindingConflict]:
        """ARP packets in order; columns time_us, port, arp_op, arp_src_mac, arp_src_ip and eth_src are used."""
        names = ("time_us", "port", "arp_op", "eth_src", "arp_src_mac", "arp_src_ip")
        found: list[BindingConflict] = []
        for at, port, operation, sender, mac, address in zip(
            *(batch[name].tolist() for name in names), strict=True
        ):
            if operation not in (1, 2) or not address or mac & _GROUP or sender & _GROUP:
                continue
            self._trained_at = self._trained_at or at * 1000 + self._training
            # where ARP and Ethernet differ, the Ethernet source counts: a block would match it
            found += self._heard(address, BoundHost(port, sender), at * 1000, honest=sender == mac)
        return found

    def _heard(self, address: int, host: BoundHost, now: int, *, honest: bool) -> Iterator[BindingConflict]:
        if host.port in self._behind or len(self._behind) < PORTS:
            neighbours = self._behind[host.port]
            if len(neighbours) < STATIONS:
                neighbours.add(host.mac)
        bound = self._bound.get(address)
        if bound is None:
            if honest:
                self._bind(address, host, now)
        elif host in (bound.host, bound.home):
            if honest:
                yield from self._spoke(address, bound, host, now)
        elif not self._settled(bound, now) or (bound.host.mac == host.mac and not bound.trained):
            # too new to have an owner, or the owner moved to another port
            self._bind(address, host, now)
        elif bound.host.mac == host.mac:
            self._elsewhere(address, bound, host, now, honest=honest)
        else:
            self._claim(address, host, now)
            if now - bound.seen > self._settle:  # the owner is gone
                self._bind(address, host, now)

    def _spoke(self, address: int, bound: _Binding, host: BoundHost, now: int) -> Iterator[BindingConflict]:
        """The owner, on its own port or on that to which it has moved."""
        if host != bound.host:  # it is back, and who was taken for it may have been another
            self._claim(address, bound.host, bound.seen)
        self._seen(address, bound, host, now)
        yield from self._contested(address, bound, now)

    def _elsewhere(self, address: int, bound: _Binding, host: BoundHost, now: int, *, honest: bool) -> None:
        """The MAC of a trained owner on another port: a move, once the owner's port has been silent for long enough."""
        since = min(now, self._claims.get((address, host), now))  # no later than now: a clock may be set back
        self._claim(address, host, since)
        if honest and now - since > self._contest:
            del self._claims[address, host]
            self._seen(address, bound, host, now)

    def _claim(self, address: int, host: BoundHost, at: int) -> None:
        self._claims[address, host] = at
        if len(self._claims) > CLAIMS:
            self._claims.popitem(last=False)

    def _seen(self, address: int, bound: _Binding, host: BoundHost, now: int) -> None:
        bound.host, bound.seen = host, now
        self._bound.move_to_end(address)

    def _settled(self, bound: _Binding, now: int) -> bool:
        return (bound.trained and now >= self._trained_at) or now - bound.since >= self._settle

    def forged(self, address: str, host: BoundHost) -> bool:
        """Whether an address certainly belongs to another host than the one that uses it."""
        if ":" in address or not address:
            return False
        bound = self._bound.get(int(ipaddress.IPv4Address(address)))
        return bound is not None and bound.trained and host not in (bound.host, bound.home)

    def addresses_of(self, host: BoundHost) -> list[str]:
        """Addresses that belong to a host."""
        found = (address for address, bound in self._bound.items() if bound.host == host)
        return [str(ipaddress.IPv4Address(address)) for address in found]

    def _bind(self, address: int, host: BoundHost, now: int) -> None:
        trained = now < self._trained_at and address not in self._bound
        self._bound[address] = _Binding(host, host, now, now, trained)
        self._bound.move_to_end(address)
        self._claims.pop((address, host), None)
        if len(self._bound) > ADDRESSES:
            self._bound.popitem(last=False)

    def _contested(self, address: int, bound: _Binding, now: int) -> Iterator[BindingConflict]:
        for key in [key for key in self._claims if key[0] == address]:
            claimed, thief = self._claims.pop(key), key[1]
            if now - claimed <= self._contest:
                text = str(ipaddress.IPv4Address(address))
                trained = bound.trained and bound.host == bound.home
                # the owner is behind its own port, whoever uses its MAC behind that of the claimant
                alone = self.is_alone(thief, elsewhere=bound.host.mac)
                yield BindingConflict(text, bound.host, thief, claimed, now, trained, alone)

    def is_alone(self, host: BoundHost, *, elsewhere: int = -1) -> bool:
        """Whether it is the only host behind its port, but for a MAC whose host is elsewhere."""
        others = self._behind.get(host.port, {host.mac, 0}) - {host.mac, elsewhere}
        lives_here = any(each.host == host for each in self._bound.values())
        return not (others and lives_here)
