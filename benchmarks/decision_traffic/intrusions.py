"""Guessing of passwords, ARP poisoning, and an infection that spreads slowly.

A guess is a short connection with the server's banner, an exchange of keys or names, a refusal and the close.
"""

from typing import Final

import numpy as np

from benchmarks.decision_traffic import packets
from benchmarks.decision_traffic.flows import SOUND, Fate, Talk, connect, talk
from benchmarks.decision_traffic.hosts import Ends, ends
from benchmarks.decision_traffic.scans import telnet_scan
from benchmarks.decision_traffic.scene import Scene
from benchmarks.decision_traffic.schedule import spread_ms
from benchmarks.decision_traffic.traffic import SECOND
from benchmarks.decision_traffic.truth import Identity

SSH_GUESS: Final = Talk(
    exchanges=5,
    fixed_exchanges=True,
    request=(190, 0.9),
    response=(220, 0.9),
    think_s=(0.02, 0.6),
    work_ms=(5, 90),
    linger_s=(0.05, 0.5),
    server_first=True,
    server_closes=0.5,
    most_bytes=1_400,
)
LINE_GUESS: Final = Talk(
    exchanges=2,
    fixed_exchanges=True,
    request=(14, 0.3),
    response=(34, 0.3),
    think_s=(0.02, 0.5),
    work_ms=(2, 300),
    linger_s=(0.3, 0.8),
    server_first=True,
    most_bytes=400,
)
SERVICES: Final = {22: SSH_GUESS, 21: LINE_GUESS, 23: LINE_GUESS}


def guessing(scene: Scene, *, port: int, count: int, rate: float, victims: int = 1) -> None:
    """One connection for each guess, `rate` a second, to one host or several in turn."""
    attacker = scene.attacker()
    targets = [scene.victim(port) for _ in range(victims)]
    time = scene.steady(count, rate, jitter=0.5)
    inbound = scene.spec.attacker_is == "outside"
    rtt = (60, 180) if inbound else (0.2, 0.9)
    rows = ends(targets).at(np.arange(count) % victims)
    connections = connect(scene.random, time, attacker, rows, port, rtt_ms=rtt, inbound=inbound)
    talk(
        scene.tape,
        scene.random,
        connections,
        SERVICES[port],
        Fate(dead=0, refused=0, slow=0, lost=0.003) if inbound else SOUND,
        attack=(scene.ident, 0),
    )


def arp_poisoning(scene: Scene, *, seconds: float, period_s: float, victims: int) -> None:
    """Tells hosts that it is the gateway, and the gateway that it is them, every few seconds.

    The owners stay: the gateway's and the hosts' own ARP packets go on in the network's traffic.  Frames that the
    deceived send to the attacker are not moved here: they would come from the same ports, with another receiver.
    """
    attacker, gateway = scene.local(), scene.network.gateway
    free = [host for host in scene.network.hosts[1:] if host.always_on and host.mac != attacker.mac]
    deceived = [free[int(row)] for row in scene.random.permutation(len(free))[:victims]]
    scene.victims += sorted({gateway.ip, *(host.ip for host in deceived)})
    scene.innocents += [Identity.of(gateway), *(Identity.of(host) for host in deceived)]
    base = scene.start + (np.arange(0, seconds, period_s) * SECOND).astype(np.int64)
    for number, host in enumerate(deceived):
        for owner, told in ((gateway, host), (host, gateway)):
            at = base + number * 150 + spread_ms(scene.random, len(base), 0, 12)
            packets.arp_reply(
                scene.tape, at, attacker.ends, told.ends, claimed_ip=owner.ip, attack=scene.ident
            )


def gratuitous_poisoning(scene: Scene, *, seconds: float, period_s: float) -> None:
    """Tells everybody by ARP announcements that it has the gateway's address."""
    attacker, gateway = scene.local(), scene.network.gateway
    scene.victims.append(gateway.ip)
    scene.innocents.append(Identity.of(gateway))
    at = scene.start + (np.arange(0, seconds, period_s) * SECOND).astype(np.int64)
    packets.arp_request(scene.tape, at, attacker.ends, gateway.ip, claimed_ip=gateway.ip, attack=scene.ident)


def slow_infection(scene: Scene, *, count: int, rate: float) -> None:
    """A few SYNs a minute to telnet services anywhere, and a heartbeat to whoever sends orders."""
    telnet_scan(scene, count=count, rate=rate, inside=0.05)
    bot = scene.attackers[0]
    row = Ends(np.array([bot.mac]), np.array([bot.ip]), np.array([bot.port]))
    master = scene.network.outside(scene.random.integers(90 << 24, 100 << 24, 1))
    times = scene.start + (np.arange(0, count / rate, 60.0) * SECOND).astype(np.int64)
    sport = 40_000 + np.arange(len(times)) % 20_000
    scene.tcp(times, row, master, sport, 48_101, packets.SYN)
    if scene.network.has_internet:
        packets.tcp(
            scene.tape,
            times + 90_000,
            master,
            row,
            sport=48_101,
            dport=sport,
            flags=packets.RST | packets.ACK,
        )
