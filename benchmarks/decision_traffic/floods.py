"""Floods: SYNs from one source and from forged ones, ACKs, datagrams, pings, and amplified DNS answers.

A server answers every SYN (as with SYN cookies) and repeats some answers; of the hosts whose addresses are forged
some send a RST.  Not imitated: what an overloaded victim no longer does, and a link that is full.
"""

import numpy as np

from benchmarks.decision_traffic import packets
from benchmarks.decision_traffic.hosts import Ends, Host
from benchmarks.decision_traffic.network import public_addresses
from benchmarks.decision_traffic.packets import ACK, RST, SYN, UDP
from benchmarks.decision_traffic.scene import Scene, once_a_second
from benchmarks.decision_traffic.schedule import spread_ms
from benchmarks.decision_traffic.traffic import SECOND, Ints
from benchmarks.decision_traffic.truth import Identity


def _service(host: Host) -> int:
    return next(port for port in (443, 80, 445, 22, 23, 8_009, 9_999) if port in host.open_ports)


def _served(scene: Scene) -> Host:
    """A victim with a service."""
    hosts = [host for host in scene.network.hosts[1:] if host.open_ports and host.kind != "gateway"]
    if scene.spec.attacker_is.startswith("outside"):
        hosts = scene.network.of_kind("server")
    found = scene.pick([host for host in hosts if {443, 80, 445, 22, 23, 8_009, 9_999} & host.open_ports])
    scene.victims.append(found.ip)
    return found


def syn_flood(scene: Scene, *, count: int, rate: float) -> None:
    """SYNs with the attacker's own address, from a fresh port each, to a service of a host in the LAN."""
    attacker, target = scene.attacker(), _served(scene)
    time, port = scene.steady(count, rate), _service(target)
    sport = 1_024 + (np.arange(count) * 7 + int(scene.random.integers(0, 60_000))) % 64_000
    scene.tcp(time, attacker, target.ends, sport, port, SYN)
    scene.answer_syns(time, attacker, target, sport, port)


def forged_syn_flood(scene: Scene, *, count: int, rate: float, sources: int = 0) -> None:
    """SYNs with forged addresses (`sources` different ones, 0: all different) to one service."""
    false, target = _forged(scene, count, sources), _served(scene)
    time, port = scene.steady(count, rate), _service(target)
    sport = scene.random.integers(1_024, 65_535, count)
    scene.tcp(time, false, target.ends, sport, port, SYN)
    _backscatter(scene, time, false, target, sport, port)


def _forged(scene: Scene, count: int, sources: int = 0) -> Ends:
    """Rows with forged addresses: behind the router, or with MAC and port of a host in the LAN."""
    drawn = public_addresses(scene.random, sources or count)
    addresses = drawn[scene.random.integers(0, len(drawn), count)] if sources else drawn
    if scene.spec.attacker_is == "inside forging":
        host = scene.pick([each for each in scene.network.of_kind("pc", "camera") if each.always_on])
        scene.attackers.append(Identity(host.port, host.mac, 0))
        return Ends(np.full(count, host.mac), addresses, np.full(count, host.port))
    scene.attackers.append(Identity(scene.network.uplink_port, scene.network.gateway.mac, 0))
    return scene.network.outside(addresses)


def _backscatter(scene: Scene, time: Ints, false: Ends, target: Host, sport: Ints, port: int) -> None:
    """SYN-ACKs to those whose addresses are forged, again after 1 and 3 s, and some RSTs of theirs."""
    count = len(time)
    back = scene.network.outside(false.ip)
    number = scene.random.integers(0, 1 << 32, count)
    at = time + spread_ms(scene.random, count, 0.08, 0.6)
    has_reset = scene.random.random(count) < (0.15 if scene.network.has_internet else 0.0)
    kept = scene.random.random(count) < min(1.0, 256 / max(count, 1))
    for delay in (0, SECOND, 3 * SECOND):
        rows = np.arange(count) if delay == 0 else np.flatnonzero(kept & ~has_reset)
        packets.tcp(
            scene.tape,
            at[rows] + delay,
            target.ends,
            back.at(rows),
            sport=port,
            dport=sport[rows],
            flags=SYN | ACK,
            seq=number[rows],
            length=74,
        )
    rows = np.flatnonzero(has_reset)
    packets.tcp(
        scene.tape,
        at[rows] + spread_ms(scene.random, len(rows), 15, 200),
        back.at(rows),
        target.ends,
        sport=sport[rows],
        dport=port,
        flags=RST,
        seq=number[rows] + 1,
    )


def ack_flood(scene: Scene, *, count: int, rate: float, payload: int = 0) -> None:
    """ACKs of no connection with forged addresses to one service; the victim sends RSTs."""
    false, target = _forged(scene, count), _served(scene)
    time, port = scene.steady(count, rate), _service(target)
    sport = scene.random.integers(1_024, 65_535, count)
    scene.tcp(time, false, target.ends, sport, port, ACK, length=max(60, 54 + payload))
    scene.answer_resets(time, scene.network.outside(false.ip), target, sport, port)


def udp_flood(scene: Scene, *, count: int, rate: float, payload: int = 512, inside: bool = False) -> None:
    """Datagrams to random ports of one host: in the Internet, or in the LAN."""
    host = scene.local()
    time = scene.steady(count, rate)
    sport = int(scene.random.integers(1_024, 65_000))
    dport = scene.random.integers(1, 65_535, count)
    victim = scene.victim() if inside else None
    target = victim.ends if victim else scene.network.outside(public_addresses(scene.random, 1))
    packets.udp(
        scene.tape, time, host.ends, target, sport=sport, dport=dport, payload=payload, attack=scene.ident
    )
    if victim is not None:
        scene.answer_datagrams(time, host.ends, victim, sport, dport, payload)
    else:
        scene.undeliverable(time, host.ends, UDP, sport, dport)


def icmp_flood(scene: Scene, *, count: int, rate: float, length: int = 98) -> None:
    """Pings to one host, which answers them."""
    attacker, target = scene.attacker(), scene.victim()
    time = scene.steady(count, rate)
    packets.echo(scene.tape, time, attacker, target.ends, reply=False, length=length, attack=scene.ident)
    back = time + spread_ms(scene.random, count, 0.08, 0.9)
    packets.echo(scene.tape, back, target.ends, attacker, reply=True, length=length)


def dns_amplification(scene: Scene, *, count: int, rate: float, servers: int) -> None:
    """Large DNS answers that nobody asked for, from many name servers, to one host in the LAN.

    The name servers are innocent: somebody has asked them in the victim's name.  Answers over 1,472 bytes
    come in fragments, of which only the first has ports; here all fit into one frame.
    """
    addresses = public_addresses(scene.random, servers)[scene.random.integers(0, servers, count)]
    scene.attackers.append(Identity(scene.network.uplink_port, scene.network.gateway.mac, 0))
    target = scene.victim()
    scene.innocents.append(Identity.of(target))
    time = scene.steady(count, rate)
    sizes = scene.random.choice([512, 1_232, 1_400, 1_472], count, p=[0.1, 0.3, 0.2, 0.4])
    sport = scene.random.integers(1_024, 65_535, max(count // 400, 1))
    dport = sport[np.arange(count) % len(sport)]
    from_servers = scene.network.outside(addresses)
    packets.udp(
        scene.tape,
        time,
        from_servers,
        target.ends,
        sport=53,
        dport=dport,
        payload=sizes,
        attack=scene.ident,
    )
    if target.filtered:
        return
    rows = once_a_second(time)
    packets.unreachable(
        scene.tape,
        time[rows] + 300,
        target.ends,
        from_servers.at(rows),
        code=packets.PORT,
        proto=UDP,
        sport=53,
        dport=dport[rows],
        length=sizes[rows] + 42,
    )
