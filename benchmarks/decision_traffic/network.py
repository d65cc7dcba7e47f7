"""A network: its hosts, and the habits that make its benign traffic hour by hour.

A habit writes the packets that begin within an hour; what lasts longer is cut an hour after its end.
Chance comes from seed, habit and hour alone, so a reading may begin anywhere and memory is that of
two hours.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from benchmarks.decision_traffic.hosts import BROADCAST_MAC, Ends, Host
from benchmarks.decision_traffic.schedule import Random, chance
from benchmarks.decision_traffic.traffic import (
    EMPTY,
    HOUR,
    SECOND,
    Ints,
    Tape,
    Traffic,
    merge,
    renumbered,
)

LOCALLY_ADMINISTERED: Final = 0x02_00_00_00_00_00


class Slice(NamedTuple):
    """An hour of one habit."""

    tape: Tape
    random: Random
    start: int
    """µs of the network."""
    end: int


Habit = Callable[[Slice], None]


@dataclass(frozen=True, eq=False)
class Network:
    """Hosts behind a switch, each on its own port, and their router to the Internet on the uplink port."""

    name: str
    seed: int
    prefix: int
    """The LAN, a /24."""
    gateway: Host
    hosts: Sequence[Host]
    """All that ever speak, the gateway included; attackers and newcomers are no part of it."""
    habits: Mapping[str, Habit]
    has_internet: bool = True
    """Whether anything outside answers."""

    @property
    def uplink_port(self) -> int:
        """The port of the router, where all outside addresses come from."""
        return self.gateway.port

    @property
    def broadcast(self) -> Ends:
        """The LAN's broadcast address."""
        return Ends(*(np.array([value]) for value in (BROADCAST_MAC, self.prefix | 255, 0)))

    def outside(self, addresses: Ints) -> Ends:
        """Ends in the Internet: behind the router's MAC."""
        count = len(addresses)
        return Ends(
            np.full(count, self.gateway.mac), addresses.astype(np.int64), np.full(count, self.uplink_port)
        )

    def of_kind(self, *kinds: str) -> list[Host]:
        """Hosts of these kinds, in order."""
        return [host for host in self.hosts if host.kind in kinds]

    def serving(self, port: int) -> list[Host]:
        """Local hosts other than the gateway with this TCP service."""
        return [host for host in self.hosts if port in host.open_ports and host is not self.gateway]

    def newcomer(self, random: Random, name: str, kind: str = "pc") -> Host:
        """A host that nobody has ever seen: its own MAC, a free address and a free port of the switch."""
        taken = {host.ip for host in self.hosts}
        free = [self.prefix + number for number in range(20, 250) if self.prefix + number not in taken]
        ip = int(random.choice(free))
        mac = LOCALLY_ADMINISTERED | int(random.integers(1, 1 << 40))
        port = max(host.port for host in self.hosts) + 1 + int(random.integers(0, 8))
        return Host(name, mac, ip, port, kind, filtered=kind == "pc")

    def chunks(self, start_s: float, end_s: float) -> Iterator[Traffic]:
        """Benign packets from `start_s` to `end_s` (seconds of the network), at most an hour in each part.

        `arrival` runs through all parts from 0.  The packets are the same wherever a reading starts.

        Raises:
            ValueError: `start_s` is negative or not before `end_s`.
        """
        if not 0 <= start_s < end_s:
            raise ValueError(f"chunks from {start_s} s to {end_s} s: 0 <= start < end is needed")
        first, last = int(start_s * SECOND) // HOUR, -(-int(end_s * SECOND) // HOUR)
        spill = self._hour(first - 1).between(first * 3_600, (first + 1) * 3_600) if first else EMPTY
        arrival = 0
        for hour in range(first, last):
            own = self._hour(hour)
            now = merge(spill, own.between(hour * 3_600, (hour + 1) * 3_600))
            spill = own.between((hour + 1) * 3_600, (hour + 2) * 3_600)
            part = now.between(max(start_s, hour * 3_600), min(end_s, (hour + 1) * 3_600))
            yield renumbered(part, arrival)
            arrival += len(part)

    def _hour(self, hour: int) -> Traffic:
        tape = Tape()
        for name, habit in self.habits.items():
            habit(Slice(tape, chance(self.seed, self.name, name, hour), hour * HOUR, (hour + 1) * HOUR))
        return tape.traffic()


def public_addresses(random: Random, count: int) -> Ints:
    """Addresses of the Internet: no private, loopback, multicast or link-local ones; they may repeat."""
    found = np.zeros(0, np.int64)
    while len(found) < count:
        drawn = random.integers(1 << 24, 223 << 24, 2 * count + 8)
        high = drawn >> 24
        private = (high == 10) | (high == 127) | (drawn >> 20 == 0xAC1) | (drawn >> 16 == 0xC0A8)
        found = np.concatenate([found, drawn[~private & (drawn >> 16 != 0xA9FE)]])
    return found[:count]


def machine_address(random: Random, vendor: int) -> int:
    """A MAC of a vendor's block of 24 bits."""
    return vendor << 24 | int(random.integers(1, 1 << 24))
