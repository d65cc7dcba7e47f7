"""Scans: of ports, of addresses, of the LAN; and those in somebody else's name.

Numbers resemble nmap (one source port, 60-byte SYNs, an answer's RST), Mirai (sequence number = address, port 23
nine times of ten) and arp-scan.  Not imitated: retransmissions and adaptive timing of nmap.
"""

import numpy as np

from benchmarks.decision_traffic import packets
from benchmarks.decision_traffic.hosts import Ends, Host, ends
from benchmarks.decision_traffic.network import public_addresses
from benchmarks.decision_traffic.packets import ACK, SYN, TCP
from benchmarks.decision_traffic.scene import Scene
from benchmarks.decision_traffic.schedule import spread_ms
from benchmarks.decision_traffic.traffic import SECOND, Ints
from benchmarks.decision_traffic.truth import Identity

_COMMON = (21, 22, 23, 25, 53, 80, 110, 139, 143, 443, 445, 993, 3306, 3389, 5900, 8080)


def _ports(scene: Scene, count: int) -> Ints:
    """Ports in random order, the common ones among them."""
    rest = np.setdiff1d(np.arange(1, 65_536), _COMMON)
    chosen = np.concatenate([_COMMON, scene.random.choice(rest, max(count - len(_COMMON), 1), replace=False)])
    return scene.random.permutation(chosen)[:count]


def syn_scan(
    scene: Scene,
    *,
    count: int,
    rate: float,
    burst: tuple[int, float] | None = None,
    service: int | None = None,
) -> None:
    """SYNs to the ports of one host; `burst` = packets in a burst and seconds between bursts."""
    attacker = scene.attacker()
    target = scene.victim(service)
    ports, sport = _ports(scene, count), int(scene.random.integers(33_000, 65_000))
    time = scene.bursts(count, rate, *burst) if burst else scene.steady(count, rate)
    scene.tcp(time, attacker, target.ends, sport, ports, SYN)
    scene.answer_syns(time, attacker, target, sport, ports)


def many_hosts_scan(scene: Scene, *, ports: tuple[int, ...], rate: float) -> None:
    """SYNs to a few ports of every host of the LAN."""
    attacker = scene.attacker()
    addresses = _lan(scene, attacker)
    time = scene.steady(len(addresses), rate / len(ports))
    exists = scene.resolve(time, attacker, addresses)
    sport = int(scene.random.integers(33_000, 65_000))
    for row in exists:
        target = _host(scene, int(addresses[row]))
        scene.victims.append(target.ip)
        at = time[row] + 2_000 + (np.arange(len(ports)) * SECOND / rate).astype(np.int64)
        wanted = np.array(ports)
        scene.tcp(at, attacker, target.ends, sport, wanted, SYN)
        scene.answer_syns(at, attacker, target, sport, wanted)


def telnet_scan(scene: Scene, *, count: int, rate: float, inside: float = 0.1) -> None:
    """SYNs to port 23 or 2323 of random addresses of the Internet, a few of them in the LAN."""
    host = scene.local()
    addresses = public_addresses(scene.random, count)
    local = np.flatnonzero(scene.random.random(count) < inside)
    port = np.where(scene.random.random(count) < 0.1, 2_323, 23)
    time, sport = scene.steady(count, rate, jitter=0.8), int(scene.random.integers(1_024, 65_000))
    far = np.setdiff1d(np.arange(count), local)
    there = scene.network.outside(addresses[far])
    scene.tcp(time[far], host.ends, there, sport, port[far], SYN, seq=addresses[far])
    scene.undeliverable(time[far], host.ends, TCP, sport, port[far])
    if not len(local):
        return
    near = scene.network.prefix | scene.random.integers(1, 255, len(local))
    exists = scene.resolve(time[local], host.ends, near)
    for row in exists:
        if int(near[row]) == host.ip:
            continue
        target = _host(scene, int(near[row]))
        at = time[local[row] : local[row] + 1] + 1_500
        scene.victims.append(target.ip)
        scene.tcp(at, host.ends, target.ends, sport, 23, SYN, seq=np.array([target.ip]))
        scene.answer_syns(at, host.ends, target, sport, 23)


def udp_scan(scene: Scene, *, count: int, rate: float) -> None:
    """Empty datagrams to the ports of one host that answers."""
    attacker = scene.attacker()
    target = scene.victim(filtered=False)
    ports, sport = _ports(scene, count), int(scene.random.integers(33_000, 65_000))
    time = scene.steady(count, rate)
    packets.udp(
        scene.tape, time, attacker, target.ends, sport=sport, dport=ports, payload=0, attack=scene.ident
    )
    scene.answer_datagrams(time, attacker, target, sport, ports, 0)


def ack_scan(scene: Scene, *, count: int, rate: float, targets: int = 3) -> None:
    """ACKs of no connection to the ports of a few hosts; each answers with a RST unless it is filtered."""
    attacker = scene.attacker()
    ports, sport = _ports(scene, count // targets), int(scene.random.integers(33_000, 65_000))
    time = scene.steady(len(ports) * targets, rate)
    for number in range(targets):
        target = scene.victim()
        at = time[number::targets]
        scene.tcp(at, attacker, target.ends, sport, ports, ACK)
        scene.answer_resets(at, attacker, target, sport, ports)


def ping_sweep(scene: Scene, *, nets: int, rate: float, syn: bool) -> None:
    """Pings, or SYNs to port 80, of every address of neighbouring networks behind the router and of the LAN."""
    attacker = scene.local()
    base = (scene.network.prefix & 0xFFFF0000) | int(scene.random.integers(0, 200)) << 8
    far = base + np.arange(256 * nets)
    far = far[(far >> 8) != scene.network.prefix >> 8]
    time = scene.steady(len(far), rate)
    sport = int(scene.random.integers(33_000, 65_000))
    there = scene.network.outside(far)
    _knock(scene, time, attacker.ends, there, sport, syn=syn)
    local = _lan(scene, attacker.ends)
    after = time[-1] + (np.arange(1, len(local) + 1) * SECOND / rate).astype(np.int64)
    exists = scene.resolve(after, attacker.ends, local)
    hosts = [_host(scene, int(local[row])) for row in exists]
    scene.victims += [host.ip for host in hosts]
    at = after[exists] + 2_500
    _knock(scene, at, attacker.ends, ends(hosts), sport, syn=syn)
    for number, host in enumerate(hosts):
        one = at[number : number + 1]
        if syn:
            scene.answer_syns(one, attacker.ends, host, sport, 80)
        else:
            back = one + spread_ms(scene.random, 1, 0.1, 1.5)
            packets.echo(scene.tape, back, host.ends, attacker.ends, reply=True, length=60)


def _knock(scene: Scene, time: Ints, src: Ends, dst: Ends, sport: int, *, syn: bool) -> None:
    if syn:
        scene.tcp(time, src, dst, sport, 80, SYN)
    else:
        packets.echo(scene.tape, time, src, dst, reply=False, length=60, attack=scene.ident)


def arp_scan(scene: Scene, *, rate: float, rounds: int = 1) -> None:
    """Asks for every address of the LAN, in order."""
    attacker = scene.local()
    addresses = np.tile(scene.network.prefix | np.arange(256), rounds)
    addresses = addresses[addresses != attacker.ip]
    time = scene.steady(len(addresses), rate, jitter=0.1)
    scene.resolve(time, attacker.ends, addresses)
    scene.victims += [host.ip for host in scene.network.hosts if host.ip != attacker.ip]


def planted_scan(scene: Scene, *, count: int, rate: float, steal_mac: bool) -> None:
    """A SYN scan in the name of an innocent host: its address, or its address and MAC, from the attacker's port.

    The victim answers the innocent, which resets connections that it never asked for.
    """
    attacker = scene.local()
    innocent = scene.pick([host for host in scene.network.of_kind("pc", "camera") if host.always_on])
    scene.innocents.append(Identity.of(innocent))
    target = scene.pick([host for host in scene.network.hosts[1:] if host is not innocent])
    scene.victims.append(target.ip)
    mac = innocent.mac if steal_mac else attacker.mac
    scene.attackers[:] = [Identity(attacker.port, mac, 0)]
    false = Ends(np.array([mac]), np.array([innocent.ip]), np.array([attacker.port]))
    ports, sport = _ports(scene, count), int(scene.random.integers(33_000, 65_000))
    time = scene.steady(count, rate)
    scene.tcp(time, false, target.ends, sport, ports, SYN)
    scene.answer_syns(time, innocent.ends, target, sport, ports, resets=innocent.ends, label=0)


def planted_names(scene: Scene, *, count: int, rate: float) -> None:
    """Datagrams to many ports in the name of an innocent host's address, from a newcomer's port and MAC."""
    attacker = scene.local()
    innocent = scene.pick([host for host in scene.network.hosts[1:] if host.always_on])
    scene.innocents.append(Identity.of(innocent))
    scene.attackers[:] = [Identity(attacker.port, attacker.mac, 0)]
    false = Ends(np.array([attacker.mac]), np.array([innocent.ip]), np.array([attacker.port]))
    ports = _ports(scene, count)
    time = scene.steady(count, rate)
    target = scene.victim(filtered=False)
    packets.udp(
        scene.tape, time, false, target.ends, sport=40_000, dport=ports, payload=0, attack=scene.ident
    )
    scene.answer_datagrams(time, innocent.ends, target, 40_000, ports, 0)


def _lan(scene: Scene, attacker: Ends) -> Ints:
    addresses = scene.network.prefix | np.arange(1, 255)
    others: Ints = addresses[addresses != attacker.ip[0]]
    return others


def _host(scene: Scene, address: int) -> Host:
    return next(host for host in scene.network.hosts if host.ip == address)
