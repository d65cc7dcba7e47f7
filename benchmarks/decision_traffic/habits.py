"""Habits that hosts of every LAN have: names, time, addresses, discovery, spanning tree.

Each function returns a habit for one host or one group of hosts; its constants come from the network's seed.
"""

from collections.abc import Sequence

import numpy as np

from benchmarks.decision_traffic import packets
from benchmarks.decision_traffic.hosts import Ends, Host, ends, group
from benchmarks.decision_traffic.network import Habit, Slice
from benchmarks.decision_traffic.schedule import Random, every, poisson, spread_ms
from benchmarks.decision_traffic.traffic import SECOND, Ints, Tape

MDNS, SSDP, ALL_HOSTS, EVERYBODY = (
    group("224.0.0.251"),
    group("239.255.255.250"),
    group("224.0.0.1"),
    group("255.255.255.255"),
)
STP_MAC, LLDP_MAC, LOOPBACK_KIND, LLDP_KIND = 0x0180C2000000, 0x0180C200000E, 0x9000, 0x88CC


def ask_names(
    tape: Tape,
    random: Random,
    time: Ints,
    client: Ends,
    server: Ends,
    *,
    both: float = 0.5,
    unanswered: float = 0.01,
    wait_ms: tuple[float, float] = (0.4, 35),
) -> None:
    """DNS questions at `time` and their answers; a share `both` asks for IPv6 too, the unanswered are repeated."""
    for share in (1.0, both):
        rows = np.flatnonzero(random.random(len(time)) < share)
        at = time[rows] + (0 if share == 1.0 else 60)
        src, dst = client.at(rows), server.at(rows)
        sport = random.integers(1_024, 65_535, len(rows))
        payload = random.integers(27, 58, len(rows))
        silent = random.random(len(rows)) < unanswered
        packets.udp(tape, at, src, dst, sport=sport, dport=53, payload=payload)
        lost = np.flatnonzero(silent)
        for delay in (5 * SECOND, 10 * SECOND):
            packets.udp(
                tape,
                at[lost] + delay,
                src.at(lost),
                dst.at(lost),
                sport=sport[lost],
                dport=53,
                payload=payload[lost],
            )
        heard = np.flatnonzero(~silent)
        packets.udp(
            tape,
            at[heard] + spread_ms(random, len(heard), *wait_ms),
            dst.at(heard),
            src.at(heard),
            sport=53,
            dport=sport[heard],
            payload=payload[heard] + random.integers(12, 190, len(heard)),
        )


def ask_addresses(
    tape: Tape, random: Random, time: Ints, asking: Ends, asked: Ends, *, unicast: bool
) -> None:
    """ARP requests and the replies of those who own the addresses."""
    if unicast:
        packets.arp_request(tape, time, asking, asked.ip, to=asked.mac)
    else:
        packets.arp_request(tape, time, asking, asked.ip)
    packets.arp_reply(tape, time + spread_ms(random, len(time), 0.08, 2.5), asked, asking)


def arp_refresh(host: Host, peers: Sequence[Host], per_hour: float, random: Random) -> Habit:
    """Asks for the addresses of its peers again, mostly of them directly."""
    rows, share = ends(peers), random.uniform(0.5, 0.9)

    def habit(now: Slice) -> None:
        time = poisson(now.random, now.start, now.end, per_hour)
        peer = now.random.integers(0, len(peers), len(time))
        direct = now.random.random(len(time)) < share
        for unicast in (True, False):
            chosen = np.flatnonzero(direct == unicast)
            asked = rows.at(peer[chosen])
            ask_addresses(now.tape, now.random, time[chosen], host.ends, asked, unicast=unicast)

    return habit


def arp_for_absent(host: Host, address: int, period_s: float, random: Random) -> Habit:
    """Asks three times in turn for a machine that is not there, again and again."""
    phase = random.random()

    def habit(now: Slice) -> None:
        time = every(now.random, now.start, now.end, period_s, spread_s=period_s / 6, phase=phase)
        for delay in (0, SECOND, 2 * SECOND):
            packets.arp_request(now.tape, time + delay, host.ends, address)

    return habit


def renew_lease(host: Host, server: Host, period_s: float, random: Random) -> Habit:
    """DHCP request to the server and its acknowledgement."""
    phase = random.random()

    def habit(now: Slice) -> None:
        time = every(now.random, now.start, now.end, period_s, spread_s=60, phase=phase)
        packets.udp(now.tape, time, host.ends, server.ends, sport=68, dport=67, payload=300)
        later = time + spread_ms(now.random, len(time), 1, 30)
        packets.udp(now.tape, later, server.ends, host.ends, sport=67, dport=68, payload=300)

    return habit


def keep_time(host: Host, server: Ends, period_s: float, random: Random, *, answered: bool = True) -> Habit:
    """NTP."""
    phase, sport = random.random(), 123 if random.random() < 0.5 else 0

    def habit(now: Slice) -> None:
        time = every(now.random, now.start, now.end, period_s, spread_s=period_s / 20, phase=phase)
        ports = np.full(len(time), 123) if sport else now.random.integers(32_768, 61_000, len(time))
        packets.udp(now.tape, time, host.ends, server, sport=ports, dport=123, payload=48)
        if answered:
            later = time + spread_ms(now.random, len(time), 8, 60)
            packets.udp(now.tape, later, server, host.ends, sport=123, dport=ports, payload=48)

    return habit


def mdns_speaker(host: Host, per_hour: float, random: Random) -> Habit:
    """Asks and announces services in short rounds (after 0, 1 and 3 s)."""
    size, ipv6 = int(random.integers(60, 320)), random.random() < 0.5

    def habit(now: Slice) -> None:
        time = poisson(now.random, now.start, now.end, per_hour / 3)
        for delay in (0, SECOND, 3 * SECOND):
            at = time + delay
            packets.udp(now.tape, at, host.ends, MDNS, sport=5_353, dport=5_353, payload=size)
            if ipv6:
                packets.mdns6(now.tape, at + 40, host.ends, payload=size)

    return habit


def ssdp_seeker(host: Host, answering: Sequence[Host], period_s: float, random: Random) -> Habit:
    """M-SEARCH four times in a row, and the answers of those that offer something."""
    phase = random.random()

    def habit(now: Slice) -> None:
        time = every(now.random, now.start, now.end, period_s, spread_s=period_s / 10, phase=phase)
        sport = now.random.integers(49_152, 65_535, len(time))
        for number in range(4):
            at = time + number * SECOND
            packets.udp(now.tape, at, host.ends, SSDP, sport=sport, dport=1_900, payload=175)
            for other in answering:
                later = at + spread_ms(now.random, len(at), 5, 900)
                packets.udp(now.tape, later, other.ends, host.ends, sport=1_900, dport=sport, payload=310)

    return habit


def ssdp_announcer(host: Host, period_s: float, random: Random, *, services: int = 6) -> Habit:
    """NOTIFY for each of its services, back to back."""
    phase, size = random.random(), int(random.integers(280, 420))

    def habit(now: Slice) -> None:
        time = every(now.random, now.start, now.end, period_s, spread_s=1, phase=phase)
        for number in range(services):
            at = time + number * 1_700
            packets.udp(now.tape, at, host.ends, SSDP, sport=1_900, dport=1_900, payload=size + 7 * number)

    return habit


def bridge(host: Host, period_s: float = 2.0) -> Habit:
    """Spanning tree, LLDP every 30 s and a loopback test every 10 s, as a switch behind this port sends them."""

    def habit(now: Slice) -> None:
        packets.raw(now.tape, every(now.random, now.start, now.end, period_s, phase=0.3), host.ends, STP_MAC)
        lldp = every(now.random, now.start, now.end, 30, phase=0.1)
        packets.raw(now.tape, lldp, host.ends, LLDP_MAC, kind=LLDP_KIND, length=133)
        loop = every(now.random, now.start, now.end, 10, phase=0.7)
        packets.raw(now.tape, loop, host.ends, host.mac, kind=LOOPBACK_KIND)

    return habit


def group_queries(router: Host, members: Sequence[Host]) -> Habit:
    """IGMP: the router asks every 125 s, members answer within ten seconds."""

    def habit(now: Slice) -> None:
        time = every(now.random, now.start, now.end, 125, phase=0.2)
        packets.igmp(now.tape, time, router.ends, ALL_HOSTS)
        for host in members:
            later = time + spread_ms(now.random, len(time), 100, 10_000)
            packets.igmp(now.tape, later, host.ends, MDNS)

    return habit


def neighbours6(hosts: Sequence[Host], per_hour: float) -> Habit:
    """Neighbour discovery, router advertisements and multicast reports of IPv6."""
    rows = ends(hosts)

    def habit(now: Slice) -> None:
        time = poisson(now.random, now.start, now.end, per_hour)
        who = rows.at(now.random.integers(0, len(hosts), len(time)))
        packets.neighbour(now.tape, time, who, kind=135)
        half = np.flatnonzero(now.random.random(len(time)) < 0.3)
        packets.neighbour(now.tape, time[half] + SECOND, who.at(half), kind=143, length=90)

    return habit


def pings(
    host: Host, peers: Sequence[Host], period_s: float, random: Random, *, number: int = 1, length: int = 98
) -> Habit:
    """Pings each peer `number` times every period, in turn; peers answer."""
    phase = random.random()

    def habit(now: Slice) -> None:
        base = every(now.random, now.start, now.end, period_s, phase=phase)
        for place, peer in enumerate(peers):
            for count in range(number):
                time = base + place * 1_300 + count * SECOND + spread_ms(now.random, len(base), 0, 2)
                packets.echo(now.tape, time, host.ends, peer.ends, reply=False, length=length)
                back = time + spread_ms(now.random, len(time), 0.2, 3)
                heard = np.flatnonzero(now.random.random(len(time)) > 0.004)
                packets.echo(now.tape, back[heard], peer.ends, host.ends, reply=True, length=length)

    return habit


def joins(host: Host, server: Host, per_hour: float) -> Habit:
    """Leaves and comes back now and then: DHCP, ARP probes and announcements, neighbour discovery."""

    def habit(now: Slice) -> None:
        time = poisson(now.random, now.start, now.end, per_hour)
        join(now.tape, now.random, time, host, server)

    return habit


def join(tape: Tape, random: Random, time: Ints, host: Host, server: Host) -> Ints:
    """What a machine sends when it comes into the LAN; returns when it is ready."""
    nobody = Ends(np.array([host.mac]), np.array([0]), np.array([host.port]))
    offered = time + spread_ms(random, len(time), 2, 400)
    asked = offered + spread_ms(random, len(time), 1, 20)
    for at in (time, asked):
        packets.udp(tape, at, nobody, EVERYBODY, sport=68, dport=67, payload=300)
    for at in (offered, asked + 4_000):
        packets.udp(tape, at, server.ends, host.ends, sport=67, dport=68, payload=300)
    probing = asked + 30_000
    for number in range(3):
        packets.arp_request(tape, probing + number * SECOND, host.ends, host.ip, claimed_ip=0)
    for number in range(2):
        packets.arp_request(tape, probing + (3 + 2 * number) * SECOND, host.ends, host.ip)
    packets.neighbour(tape, probing + 500_000, host.ends, kind=133, length=70)
    packets.neighbour(tape, probing + 700_000, host.ends, kind=143, length=90)
    ready: Ints = probing + 3 * SECOND + 200_000
    ask_addresses(tape, random, ready, host.ends, server.ends, unicast=False)
    return ready
