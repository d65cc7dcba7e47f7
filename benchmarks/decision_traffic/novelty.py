"""Benign novelty: what training never saw and nobody must block, on top of a network from a time on.

Where a network has no Internet, newcomers try in vain (SYNs and their retries, as the other devices there), and
downloads come from the network drive.  Not imitated: what the network's other hosts would leave out meanwhile; a
restarted router does not silence the traffic of the network itself.
"""

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from benchmarks.decision_traffic import habits, packets
from benchmarks.decision_traffic.flows import SOUND, Fate, Talk, connect, talk, unanswered
from benchmarks.decision_traffic.hosts import Ends, Host, ends, group
from benchmarks.decision_traffic.network import Network, public_addresses
from benchmarks.decision_traffic.packets import TCP
from benchmarks.decision_traffic.scene import once_a_second
from benchmarks.decision_traffic.schedule import chance, every, lognormal, poisson, spread_ms, within
from benchmarks.decision_traffic.traffic import SECOND, Ints, Tape, Traffic
from benchmarks.decision_traffic.web import REQUEST, Popularity, contact, keep_open

WS_DISCOVERY: Final = group("239.255.255.250")
_IPP: Final = Talk(exchanges=3, response=(900, 0.8), think_s=(0.02, 0.6))
_PLAYBOOK: Final = Talk(
    exchanges=9, request=(700, 1.2), response=(400, 0.8), think_s=(0.02, 0.8), server_first=True
)


class _Stage:
    """Tape, chance and time of one novelty."""

    def __init__(self, network: Network, name: str, seed: int, start_s: float) -> None:
        self.network = network
        self.random = chance(network.seed, network.name, "novelty", name, seed)
        self.tape = Tape()
        self.start = round(start_s * SECOND)
        self.popular = Popularity(network, chance(network.seed, "novel hosts"), once=0.3)

    def newcomer(self, name: str, kind: str) -> tuple[Host, int]:
        """A host that has just joined, and when it is ready."""
        host = self.network.newcomer(self.random, name, kind)
        ready = habits.join(self.tape, self.random, np.array([self.start]), host, self.network.gateway)
        return host, int(ready[0])

    def known(self, *kinds: str) -> Host:
        """A host that training knows."""
        hosts = [host for host in self.network.of_kind(*kinds) if host.always_on] or self.network.hosts[1:]
        return hosts[int(self.random.integers(0, len(hosts)))]

    def source(self) -> Ends:
        """Where downloads come from."""
        if self.network.has_internet:
            return self.network.outside(public_addresses(self.random, 1))
        return self.network.of_kind("drive")[0].ends

    def store(self) -> Host:
        """Where backups go."""
        return self.network.of_kind("file server", "drive")[0]

    def reach(self, time: Ints, client: Host) -> None:
        """Connections to many hosts outside, names first; unanswered where there is no Internet."""
        gateway = self.network.gateway.ends
        if self.network.has_internet:
            contact(
                self.tape,
                self.random,
                time,
                client,
                gateway,
                self.popular,
                what=REQUEST,
                quic=0.15,
                kept=0.25,
            )
            return
        habits.ask_names(self.tape, self.random, time, client.ends, gateway)
        few = self.network.outside(public_addresses(self.random, 12))
        server = few.at(self.random.integers(0, 12, len(time)))
        connections = connect(self.random, time + 9_000, client.ends, server, 443)
        sent = unanswered(self.tape, self.random, connections, tries=3)
        rows = once_a_second(sent)
        packets.unreachable(
            self.tape,
            sent[rows] + 900,
            gateway,
            client.ends,
            code=packets.NET,
            proto=TCP,
            sport=connections.sport[rows % len(time)],
            dport=443,
            length=74,
        )

    def transfer(
        self, client: Ends, server: Ends, port: int, *, up: int, down: int, gap_us: float, streams: int
    ) -> None:
        """Parallel connections that move so many bytes in all, a full segment every `gap_us`."""
        outside = server.port[0] == self.network.uplink_port
        connections = connect(
            self.random,
            self.start + self.random.integers(0, 200_000, streams),
            client,
            server,
            port,
            rtt_ms=(9, 40) if outside else (0.2, 0.6),
        )
        what = Talk(
            exchanges=1,
            fixed_exchanges=True,
            request=(max(up // streams, 300), 0.02),
            response=(max(down // streams, 300), 0.02),
            gap_us=gap_us * streams,
            most_bytes=1 << 30,
            left_open=0,
        )
        talk(self.tape, self.random, connections, what, Fate(dead=0, refused=0, slow=0, lost=0.001))

    def stay_connected(self, host: Host, ready: int, seconds: float, number: int) -> None:
        """Push connections that stay open."""
        for _ in range(number if self.network.has_internet else 0):
            period = float(self.random.uniform(25, 240))
            time = every(
                self.random, ready, ready + int(seconds * SECOND), period, phase=self.random.random()
            )
            server = self.popular.favourite(self.random)
            sport = int(self.random.integers(40_000, 60_000))
            keep_open(self.tape, time, host, server, sport, 25_000, period)


def new_phone(network: Network, seed: int, start_s: float) -> Traffic:
    """A telephone joins: DHCP, ARP, names, tens of TLS connections within seconds, then push for an hour."""
    stage = _Stage(network, "phone", seed, start_s)
    host, ready = stage.newcomer("new telephone", "telephone")
    count = int(stage.random.integers(40, 90))
    first = ready + lognormal(stage.random, 3 * SECOND, 0.8, count, 25 * SECOND)
    later = poisson(stage.random, ready + 60 * SECOND, ready + 3_600 * SECOND, 70)
    stage.reach(np.concatenate([first, later]), host)
    stage.stay_connected(host, ready, 3_600, 3)
    for delay in (0, SECOND, 3 * SECOND):
        at = np.array([ready + delay])
        packets.udp(stage.tape, at, host.ends, habits.MDNS, sport=5_353, dport=5_353, payload=120)
        packets.mdns6(stage.tape, at + 50, host.ends, payload=120)
    return stage.tape.traffic()


def firmware_update(network: Network, seed: int, start_s: float) -> Traffic:
    """A device that never did so downloads 15 to 60 MB at once."""
    stage = _Stage(network, "firmware", seed, start_s)
    device = stage.known("printer", "telephone", "camera", "plug", "doorbell")
    size = int(stage.random.uniform(15e6, 60e6))
    gateway = network.gateway.ends
    habits.ask_names(stage.tape, stage.random, np.array([stage.start]), device.ends, gateway)
    stage.start += 60_000
    stage.transfer(
        device.ends,
        stage.source(),
        443 if network.has_internet else 80,
        up=400,
        down=size,
        gap_us=450,
        streams=1,
    )
    return stage.tape.traffic()


def nightly_backup(network: Network, seed: int, start_s: float) -> Traffic:
    """A host copies 0.4 to 0.9 GB to the file server: 2,000 to 5,000 packets/s for minutes."""
    stage = _Stage(network, "backup", seed, start_s)
    store = stage.store()
    client = stage.known("server", "build server", "pc")
    size = int(stage.random.uniform(0.4e9, 0.9e9))
    stage.transfer(
        client.ends,
        store.ends,
        445,
        up=size,
        down=3_000,
        gap_us=float(stage.random.uniform(320, 700)),
        streams=1,
    )
    return stage.tape.traffic()


def video_call(network: Network, seed: int, start_s: float) -> Traffic:
    """STUN to several candidates, some in vain, then 200 to 500 datagrams/s each way for minutes, to one relay.

    Without Internet the call is with another host of the LAN.
    """
    stage = _Stage(network, "call", seed, start_s)
    random, client = stage.random, stage.known("pc")
    others = [host for host in network.hosts[1:] if host is not client]
    inside = ends([others[int(row)] for row in random.integers(0, len(others), 5)])
    outside = network.outside(public_addresses(random, 5))
    candidates = outside if network.has_internet else inside
    sport = random.integers(49_152, 65_535, 5)
    for number in range(5):
        tries = 1 if number == 0 else int(random.integers(2, 7))
        at = stage.start + number * 20_000 + 500_000 * (2 ** np.arange(tries) - 1)
        where = candidates.at(np.full(tries, number))
        port = 3_478 if number < 2 else int(random.integers(49_152, 65_535))
        packets.udp(stage.tape, at, client.ends, where, sport=sport[0], dport=port, payload=100)
        if number == 0:
            packets.udp(stage.tape, at + 24_000, where, client.ends, sport=port, dport=sport[0], payload=96)
    relay, begin = candidates.at(np.zeros(1, np.int64)), stage.start + 4 * SECOND
    seconds = float(random.uniform(120, 420))
    for src, dst, ports in ((client.ends, relay, (sport[0], 3_478)), (relay, client.ends, (3_478, sport[0]))):
        rate = float(random.uniform(200, 500))
        count = int(seconds * rate)
        gaps = np.maximum(random.normal(1, 0.35, count), 0.02) / rate
        time = begin + (np.cumsum(gaps) * SECOND).astype(np.int64)
        size = np.where(random.random(count) < 0.25, 120, random.integers(700, 1_200, count))
        packets.udp(stage.tape, time, src, dst, sport=int(ports[0]), dport=int(ports[1]), payload=size)
    return stage.tape.traffic()


def new_laptop(network: Network, seed: int, start_s: float) -> Traffic:
    """A laptop joins, looks for printers by mDNS, SSDP and WS-Discovery, asks each that answers, and goes online."""
    stage = _Stage(network, "laptop", seed, start_s)
    host, ready = stage.newcomer("new laptop", "pc")
    offering = network.of_kind("printer", "television", "drive", "file server")
    for number in range(4):
        at = np.array([ready + 400_000 + number * SECOND])
        packets.udp(stage.tape, at, host.ends, habits.MDNS, sport=5_353, dport=5_353, payload=190)
        packets.udp(stage.tape, at + 30_000, host.ends, habits.SSDP, sport=50_001, dport=1_900, payload=175)
        packets.udp(stage.tape, at + 61_000, host.ends, WS_DISCOVERY, sport=50_002, dport=3_702, payload=656)
        for other in offering:
            later = at + 61_000 + spread_ms(stage.random, 1, 2, 600)
            packets.udp(stage.tape, later, other.ends, host.ends, sport=3_702, dport=50_002, payload=900)
    rows = ends(offering)
    habits.ask_addresses(
        stage.tape,
        stage.random,
        ready + 3 * SECOND + np.arange(len(offering)) * 7_000,
        host.ends,
        rows,
        unicast=False,
    )
    which = np.tile(np.arange(len(offering)), 3)
    port = np.repeat([631, 80, 9_100], len(offering))
    time = ready + 4 * SECOND + np.arange(len(which)) * 130_000
    listening = np.array([int(p) in offering[int(w)].open_ports for p, w in zip(port, which, strict=True)])
    connections = connect(stage.random, time, host.ends, rows.at(which), port)
    good = np.flatnonzero(listening)
    talk(stage.tape, stage.random, connections.only(good), _IPP, SOUND)
    refused = connections.only(np.flatnonzero(~listening))
    talk(stage.tape, stage.random, refused, _IPP, Fate(dead=0, refused=1.0))
    stage.reach(ready + 6 * SECOND + lognormal(stage.random, 8 * SECOND, 1.0, 60, 300 * SECOND), host)
    return stage.tape.traffic()


def restarted_router(network: Network, seed: int, start_s: float) -> Traffic:
    """The router is back: it asks for every host, every host asks for it, leases and connections are tried again."""
    stage = _Stage(network, "router", seed, start_s)
    random, gateway = stage.random, network.gateway
    hosts = [host for host in network.hosts[1:] if host.always_on]
    rows, count = ends(hosts), len(hosts)
    back = stage.start + 45 * SECOND
    for host in hosts:
        tries = int(random.integers(8, 40))
        at = np.sort(stage.start + random.integers(0, 45 * SECOND, tries))
        packets.arp_request(stage.tape, at, host.ends, gateway.ip)
    for number in range(3):
        packets.arp_request(stage.tape, np.array([back + number * SECOND]), gateway.ends, gateway.ip)
    time = back + np.sort(random.integers(0, 6 * SECOND, count))
    habits.ask_addresses(stage.tape, random, time, gateway.ends, rows, unicast=False)
    for host in hosts:
        begin = back + int(random.integers(0, 20 * SECOND))
        one = np.array([begin])
        habits.ask_addresses(stage.tape, random, one, host.ends, gateway.ends, unicast=False)
        if random.random() < 0.6:
            packets.udp(stage.tape, one + 90_000, host.ends, gateway.ends, sport=68, dport=67, payload=300)
            packets.udp(stage.tape, one + 95_000, gateway.ends, host.ends, sport=67, dport=68, payload=300)
        tries = int(random.integers(2, 18))
        stage.reach(begin + lognormal(random, 4 * SECOND, 1.0, tries, 60 * SECOND), host)
    return stage.tape.traffic()


def speed_test(network: Network, seed: int, start_s: float) -> Traffic:
    """Six connections at once: ten seconds down, then ten up, 4,000 to 9,000 packets/s."""
    stage = _Stage(network, "speed", seed, start_s)
    client, server = stage.known("pc"), stage.source()
    gap = float(stage.random.uniform(170, 320))
    size = int(10 * SECOND / gap * 1_448)
    port = 8_080 if network.has_internet else 80
    pings = stage.start + np.arange(10) * 200_000
    packets.echo(stage.tape, pings, client.ends, server, reply=False)
    packets.echo(stage.tape, pings + 12_000, server, client.ends, reply=True)
    stage.start += 3 * SECOND
    stage.transfer(client.ends, server, port, up=400, down=size, gap_us=gap, streams=6)
    stage.start += 12 * SECOND
    stage.transfer(client.ends, server, port, up=size // 3, down=400, gap_us=3 * gap, streams=6)
    return stage.tape.traffic()


def smart_tv(network: Network, seed: int, start_s: float) -> Traffic:
    """A television joins, announces itself, goes online, and plays: a burst of 2 to 4 MB every five seconds."""
    stage = _Stage(network, "television", seed, start_s)
    random = stage.random
    host, ready = stage.newcomer("new television", "television")
    at = ready + np.array([0, 1, 2, 30, 60, 90, 300, 600]) * SECOND
    for number in range(7):
        packets.udp(
            stage.tape,
            at + number * 1_500,
            host.ends,
            habits.SSDP,
            sport=1_900,
            dport=1_900,
            payload=300 + 11 * number,
        )
    packets.udp(stage.tape, at + 40_000, host.ends, habits.MDNS, sport=5_353, dport=5_353, payload=260)
    stage.reach(ready + lognormal(random, 12 * SECOND, 1.0, 45, 200 * SECOND), host)
    playing = np.array([ready + 90 * SECOND, ready + 91 * SECOND])
    what = Talk(
        exchanges=int(random.integers(50, 110)),
        fixed_exchanges=True,
        request=(700, 0.2),
        response=(2_600_000, 0.3),
        think_s=(4.5, 0.2),
        gap_us=260,
        most_bytes=6_000_000,
    )
    rtt = (9, 30) if network.has_internet else (0.2, 0.6)
    connections = connect(random, playing[:1], host.ends, stage.source(), 443, rtt_ms=rtt)
    talk(stage.tape, random, connections, what, SOUND)
    return stage.tape.traffic()


def administration(network: Network, seed: int, start_s: float) -> Traffic:
    """An administrator's tool logs in to every server by SSH, several short connections each, within a minute."""
    stage = _Stage(network, "administration", seed, start_s)
    servers = network.serving(22)
    admin = stage.known("pc", "monitor")
    servers = [host for host in servers if host is not admin]
    each = int(stage.random.integers(4, 9))
    which = np.tile(np.arange(len(servers)), each)
    time = stage.start + np.arange(len(which)) * int(stage.random.uniform(0.2, 0.9) * SECOND)
    connections = connect(stage.random, time, admin.ends, ends(servers).at(which), 22)
    talk(stage.tape, stage.random, connections, _PLAYBOOK, SOUND)
    return stage.tape.traffic()


def restored_tabs(network: Network, seed: int, start_s: float) -> Traffic:
    """A browser starts with its forty pages of yesterday: hundreds of connections in twenty seconds."""
    stage = _Stage(network, "tabs", seed, start_s)
    pages = stage.start + stage.random.integers(0, 6 * SECOND, int(stage.random.integers(25, 50)))
    counts = stage.random.integers(3, 12, len(pages))
    time = np.repeat(pages, counts) + within(counts) * 150_000
    stage.reach(time, stage.known("pc"))
    return stage.tape.traffic()


NOVELTIES: Final[Mapping[str, Callable[[Network, int, float], Traffic]]] = {
    "new phone": new_phone,
    "firmware update": firmware_update,
    "nightly backup": nightly_backup,
    "video call": video_call,
    "new laptop": new_laptop,
    "restarted router": restarted_router,
    "speed test": speed_test,
    "smart tv": smart_tv,
    "administration": administration,
    "restored tabs": restored_tabs,
}
