"""The scene of one attack: tape, chance, who attacks, and what attacked hosts answer.

Answers come from victims and are benign (label 0): RST from closed ports, SYN-ACK from open ones, nothing from
filtered ones, ICMP port unreachable at most once a second for each host (RFC 1812, as Linux does it).
"""

from collections.abc import Sequence

import numpy as np

from benchmarks.decision_traffic import packets
from benchmarks.decision_traffic.habits import join
from benchmarks.decision_traffic.hosts import Ends, Host, ends
from benchmarks.decision_traffic.network import Network, public_addresses
from benchmarks.decision_traffic.packets import ACK, RST, SYN, TCP, UDP
from benchmarks.decision_traffic.schedule import chance, spread_ms
from benchmarks.decision_traffic.traffic import SECOND, Column, Ints, Tape
from benchmarks.decision_traffic.truth import AttackSpec, Identity

_UNICAST_UDP_OPEN = frozenset({53, 67, 123, 137, 161, 1_900, 5_353})


class Scene:
    """Where one attack is written."""

    def __init__(self, spec: AttackSpec, network: Network, seed: int, start_s: float) -> None:
        self.spec = spec
        self.network = network
        self.ident = spec.number * 1_000 + seed
        self.random = chance(network.seed, network.name, "attack", spec.number, seed)
        self.tape = Tape()
        self.start = round(start_s * SECOND)
        self.attackers: list[Identity] = []
        self.victims: list[int] = []
        self.innocents: list[Identity] = []
        self._hosts = {host.ip: host for host in network.hosts}

    # who

    def attacker(self) -> Ends:
        """The attacker of the spec's kind; a newcomer joins first and moves the start by 6 to 30 s."""
        return self.outsider() if self.spec.attacker_is == "outside" else self.local().ends

    def local(self) -> Host:
        """An attacker in the LAN: one that training knows, or a newcomer."""
        if self.spec.attacker_is == "new":
            host = self.network.newcomer(self.random, "stranger", "pc")
            ready = join(self.tape, self.random, np.array([self.start]), host, self.network.gateway)
            self.start = int(ready[0]) + int(self.random.uniform(1, 25) * SECOND)
        else:
            host = self.pick(
                [each for each in self.network.of_kind("pc", "camera", "recorder") if each.always_on]
            )
        self.attackers.append(Identity.of(host))
        return host

    def outsider(self) -> Ends:
        """An attacker in the Internet."""
        row = self.network.outside(public_addresses(self.random, 1))
        self.attackers.append(Identity(self.network.uplink_port, self.network.gateway.mac, int(row.ip[0])))
        return row

    def pick(self, hosts: Sequence[Host]) -> Host:
        """One of them, by chance, that is no attacker."""
        free = [host for host in hosts if all(host.mac != attacker.mac for attacker in self.attackers)]
        return free[int(self.random.integers(0, len(free)))]

    def victim(self, port: int | None = None, *, filtered: bool | None = None) -> Host:
        """A host with this service (the published server where the attacker is outside); noted as victim."""
        hosts = self.network.serving(port) if port else list(self.network.hosts[1:])
        if filtered is not None:
            hosts = [host for host in hosts if host.filtered == filtered]
        if self.spec.attacker_is.startswith("outside"):
            hosts = [host for host in hosts if host.kind == "server"] or hosts
        found = self.pick([host for host in hosts if host.ip not in self.victims] or hosts)
        self.victims.append(found.ip)
        return found

    # when

    def steady(self, count: int, rate: float, *, jitter: float = 0.3) -> Ints:
        """`count` times at `rate` a second from the start on."""
        gaps = np.maximum(self.random.normal(1, jitter, count), 0.05) / rate
        gaps[0] = 0
        times: Ints = self.start + (np.cumsum(gaps) * SECOND).astype(np.int64)
        return times

    def bursts(self, count: int, rate: float, size: int, pause_s: float) -> Ints:
        """`count` times in bursts of `size` at `rate` a second, with pauses between."""
        times: Ints = self.steady(count, rate) + (np.arange(count) // size) * int(pause_s * SECOND)
        return times

    # packets of the attacker

    def tcp(
        self,
        time: Ints,
        src: Ends,
        dst: Ends,
        sport: Column,
        dport: Column,
        flags: int,
        *,
        length: int = 60,
        seq: Column | None = None,
    ) -> None:
        """Segments of the attacker."""
        number = self.random.integers(0, 1 << 32, len(time)) if seq is None else seq
        answer = self.random.integers(0, 1 << 32, len(time)) if flags == ACK else 0
        packets.tcp(
            self.tape,
            time,
            src,
            dst,
            sport=sport,
            dport=dport,
            flags=flags,
            seq=number,
            ack=answer,
            length=length,
            attack=self.ident,
        )

    def resolve(self, time: Ints, src: Ends, addresses: Ints) -> Ints:
        """The attacker asks the LAN for each address; owners answer.  Returns the rows that exist."""
        packets.arp_request(self.tape, time, src, addresses, attack=self.ident)
        exists = np.flatnonzero(np.isin(addresses, list(self._hosts)))
        owners = self.owners(addresses[exists])
        later = time[exists] + spread_ms(self.random, len(exists), 0.05, 1.8)
        packets.arp_reply(self.tape, later, owners, src)
        return exists

    def owners(self, addresses: Ints) -> Ends:
        """The local hosts with these addresses."""
        return ends([self._hosts[int(address)] for address in addresses])

    # answers

    def answer_syns(
        self,
        time: Ints,
        src: Ends,
        target: Host,
        sport: Column,
        dport: Column,
        *,
        resets: Ends | None = None,
        label: int | None = None,
    ) -> None:
        """What `target` answers to SYNs of `src`, and the RST that answers its SYN-ACKs.

        `resets` sends that RST (default: `src`); `label` is its attack id (default: this attack).
        """
        ports = np.broadcast_to(dport, len(time))
        is_open = np.isin(ports, list(target.open_ports))
        accepted, closed = np.flatnonzero(is_open), np.flatnonzero(~is_open)
        at = self._answer(time, src, target, sport, ports, accepted, SYN | ACK)
        who = src if resets is None else resets
        packets.tcp(
            self.tape,
            at + spread_ms(self.random, len(at), 0.1, 0.6),
            who.at(accepted),
            target.ends,
            sport=np.broadcast_to(sport, len(time))[accepted],
            dport=ports[accepted],
            flags=RST,
            attack=self.ident if label is None else label,
        )
        if not target.filtered:
            self._answer(time, src, target, sport, ports, closed, RST | ACK)

    def answer_resets(self, time: Ints, src: Ends, target: Host, sport: Column, dport: Column) -> None:
        """A RST for each segment of no connection, open port or not."""
        if not target.filtered:
            ports = np.broadcast_to(dport, len(time))
            self._answer(time, src, target, sport, ports, np.arange(len(time)), RST)

    def _answer(
        self, time: Ints, src: Ends, target: Host, sport: Column, dport: Ints, rows: Ints, flags: int
    ) -> Ints:
        at: Ints = time[rows] + spread_ms(self.random, len(rows), 0.08, 0.9)
        packets.tcp(
            self.tape,
            at,
            target.ends,
            src.at(rows),
            sport=dport[rows],
            dport=np.broadcast_to(sport, len(time))[rows],
            flags=flags,
            seq=self.random.integers(0, 1 << 32, len(rows)),
            ack=self.random.integers(0, 1 << 32, len(rows)),
            length=74 if flags & SYN else 60,
        )
        return at

    def answer_datagrams(
        self, time: Ints, src: Ends, target: Host, sport: Column, dport: Column, payload: int
    ) -> None:
        """ICMP port unreachable for closed ports, one a second at most."""
        ports = np.broadcast_to(dport, len(time))
        closed = np.flatnonzero(~np.isin(ports, list(_UNICAST_UDP_OPEN)))
        if target.filtered or not len(closed):
            return
        rows = closed[once_a_second(time[closed])]
        packets.unreachable(
            self.tape,
            time[rows] + spread_ms(self.random, len(rows), 0.1, 0.8),
            target.ends,
            src.at(rows),
            code=packets.PORT,
            proto=UDP,
            sport=np.broadcast_to(sport, len(time))[rows],
            dport=ports[rows],
            length=max(60, payload + 42),
        )

    def undeliverable(self, time: Ints, src: Ends, proto: int, sport: Column, dport: Column) -> None:
        """ICMP errors of a router that has no way to the Internet, one a second at most."""
        if self.network.has_internet or not len(time):
            return
        rows = once_a_second(time)
        packets.unreachable(
            self.tape,
            time[rows] + spread_ms(self.random, len(rows), 0.3, 2),
            self.network.gateway.ends,
            src.at(rows),
            code=packets.NET,
            proto=proto,
            sport=np.broadcast_to(sport, len(time))[rows],
            dport=np.broadcast_to(dport, len(time))[rows],
            length=60 if proto == TCP else 90,
        )


def once_a_second(time: Ints) -> Ints:
    """Rows of the first of each second."""
    order = np.argsort(time, kind="stable")
    second = time[order] // SECOND
    first = np.ones(len(time), np.bool_)
    first[1:] = second[1:] != second[:-1]
    rows: Ints = order[first]
    return rows
