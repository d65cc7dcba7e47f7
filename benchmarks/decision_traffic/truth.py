"""What is known of an attack: who, whom, when, and what would help."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

import numpy as np

from benchmarks.decision_traffic.hosts import Host
from benchmarks.decision_traffic.network import Network
from benchmarks.decision_traffic.traffic import Traffic

Kind = Literal["scan", "flood", "guessing", "spoofing"]
Remedy = Literal["block_sender", "block_address", "guard", "meter"]
"""`block_sender`: a MAC on a port; `block_address`: what one address sends; `guard`: challenge SYNs towards
the victim's service; `meter`: limit a kind of packets towards the victim."""
AttackerIs = Literal["known", "new", "outside", "inside forging", "outside forging"]
"""A host that training knows, one that it does not, or somebody behind the router; `forging`: other addresses."""

MOST_SEEDS: Final = 1_000


class Identity(NamedTuple):
    """Where packets come from."""

    port: int
    mac: int
    ip: int

    @classmethod
    def of(cls, host: Host) -> "Identity":
        """A local host's."""
        return cls(host.port, host.mac, host.ip)


@dataclass(frozen=True, kw_only=True)
class AttackTruth:
    """The truth about one attack in a `Traffic`."""

    id: int
    """What `Traffic.attack` has for the attacker's packets."""
    name: str
    kind: Kind
    attacker_is: AttackerIs
    first_us: int
    """Absolute time of the attacker's first packet."""
    last_us: int
    packets: int
    """Of the attacker; answers are not counted."""
    attackers: tuple[Identity, ...]
    """The true senders; an `ip` of 0 where addresses are forged, and a MAC of `innocents` where that is stolen (only
    the port is the attacker's then)."""
    forged: bool
    """Source addresses are not the attacker's own."""
    victims: tuple[int, ...]
    """Addresses of the inside hosts that are attacked; blocking them is a hit on the innocent."""
    innocents: tuple[Identity, ...]
    """Whose address or MAC somebody else uses."""
    remedies: tuple[Remedy, ...]
    """Each of these would be effective without harm to others."""
    held_back: bool


@dataclass(frozen=True, kw_only=True)
class AttackSpec:
    """An attack that can be made in a network; the same seed gives the same packets."""

    number: int
    name: str
    kind: Kind
    attacker_is: AttackerIs
    rate: float
    """Attack packets a second while it is active, about."""
    held_back: bool
    needs: tuple[str, ...]
    """`internet`: the router forwards from outside."""
    make: Callable[["AttackSpec", Network, int, float], tuple[Traffic, AttackTruth]]
    seeds: Sequence[int] = (1, 2, 3)

    def fits(self, network: Network) -> bool:
        """Whether this attack can happen there: nobody outside reaches a network without Internet."""
        return "internet" not in self.needs or network.has_internet

    def traffic(self, network: Network, seed: int, start_s: float) -> tuple[Traffic, AttackTruth]:
        """The packets of the attack and of what its victims answer.

        Args:
            network: where it happens.
            seed: 0 to 999; chooses attacker, victims, times and numbers.
            start_s: second of the network at which it begins; a newcomer joins then and attacks within 30 s.

        Returns:
            Traffic to be merged with the network's, and the truth about it.

        Raises:
            ValueError: the attack does not fit this network, or the seed is out of range.
        """
        if not self.fits(network):
            raise ValueError(
                f"{self.name}: needs {', '.join(self.needs)}, which {network.name} does not have"
            )
        if not 0 <= seed < MOST_SEEDS:
            raise ValueError(f"{self.name}: seed {seed}; 0 to {MOST_SEEDS - 1} is possible")
        return self.make(self, network, seed, start_s)


def told(
    traffic: Traffic,
    spec: AttackSpec,
    ident: int,
    *,
    attackers: Sequence[Identity],
    victims: Sequence[int],
    innocents: Sequence[Identity],
    remedies: tuple[Remedy, ...],
    forged: bool,
) -> AttackTruth:
    """The truth about the packets that carry `ident`."""
    rows = np.flatnonzero(traffic.attack == ident)
    times = traffic.columns["time_us"][rows]
    return AttackTruth(
        id=ident,
        name=spec.name,
        kind=spec.kind,
        attacker_is=spec.attacker_is,
        first_us=int(times[0]),
        last_us=int(times[-1]),
        packets=len(rows),
        attackers=tuple(attackers),
        forged=forged,
        victims=tuple(dict.fromkeys(victims)),
        innocents=tuple(innocents),
        remedies=remedies,
        held_back=spec.held_back,
    )
