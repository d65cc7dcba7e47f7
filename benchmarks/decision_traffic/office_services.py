"""Services of an office: mail, files, printing, Windows names, SSH, updates, monitoring, telephones."""

from typing import Final

import numpy as np

from benchmarks.decision_traffic import packets
from benchmarks.decision_traffic.flows import SOUND, Fate, Talk, connect, talk, unanswered
from benchmarks.decision_traffic.habits import arp_for_absent, ask_names
from benchmarks.decision_traffic.hosts import Ends, Host, ends, group
from benchmarks.decision_traffic.network import Habit, Network, Slice
from benchmarks.decision_traffic.schedule import (
    Random,
    every,
    hour_of_day,
    lognormal,
    poisson,
    spread_ms,
    within,
)
from benchmarks.decision_traffic.traffic import HOUR, SECOND, Ints
from benchmarks.decision_traffic.web import INTERNET, Browsing, Popularity, presence

LLMNR: Final = group("224.0.0.252")
SMB: Final = Talk(
    exchanges=14,
    request=(180, 0.7),
    response=(500, 1.8),
    think_s=(0.02, 2.0),
    gap_us=60,
    most_bytes=4_000_000,
)
IMAP: Final = Talk(exchanges=4, response=(600, 1.4), think_s=(0.02, 1.0), server_first=True)
SMTP_IN: Final = Talk(
    exchanges=5,
    request=(300, 1.6),
    response=(60, 0.4),
    think_s=(0.05, 1.0),
    server_first=True,
    most_bytes=400_000,
)
TYPED: Final = Talk(
    exchanges=160,
    request=(52, 0.2),
    response=(90, 0.9),
    think_s=(0.35, 1.3),
    server_first=True,
    most_think_s=120,
)
CRON_SSH: Final = Talk(
    exchanges=6, request=(300, 0.7), response=(500, 0.8), think_s=(0.01, 0.8), server_first=True
)
MISTYPED: Final = Talk(
    exchanges=5,
    fixed_exchanges=True,
    request=(190, 0.9),
    response=(220, 0.9),
    think_s=(0.6, 0.9),
    server_first=True,
    most_bytes=1_400,
)
SITE: Final = Talk(exchanges=3, response=(6_000, 1.3), think_s=(0.3, 1.2), linger_s=(5, 1.0))
PROBE: Final = Talk(
    exchanges=1, fixed_exchanges=True, request=(60, 0.1), response=(220, 0.3), linger_s=(0.01, 0.3)
)
UPDATE: Final = Talk(
    exchanges=4, response=(90_000, 1.6), think_s=(0.2, 1.0), gap_us=130, most_bytes=8_000_000
)
PRINT: Final = Talk(exchanges=5, request=(60_000, 1.0), response=(40, 0.4), think_s=(0.3, 0.8), gap_us=110)


def windows_names(network: Network, host: Host, random: Random) -> Habit:
    """NetBIOS and browser broadcasts about every 12 minutes, LLMNR for names that nobody knows."""
    phase = random.random()
    asked = random.uniform(1, 8) if host.always_on else random.uniform(0.5, 3)

    def habit(now: Slice) -> None:
        random, tape = now.random, now.tape
        time = every(random, now.start, now.end, 720, spread_s=30, phase=phase)
        packets.udp(tape, time, host.ends, network.broadcast, sport=138, dport=138, payload=201)
        names = poisson(random, now.start, now.end, asked)
        sport = random.integers(49_152, 65_535, len(names))
        for number in range(3):
            at = names + number * 750_000
            packets.udp(tape, at, host.ends, network.broadcast, sport=137, dport=137, payload=50)
            if number < 2:
                packets.udp(tape, at + 400, host.ends, LLMNR, sport=sport, dport=5_355, payload=28)

    return habit


def mail_client(network: Network, host: Host, taste: Browsing, random: Random) -> Habit:
    """Asks the server for mail every few minutes while somebody is there, seldom otherwise."""
    server, period, phase = network.of_kind("server")[0], random.uniform(180, 900), random.random()

    def habit(now: Slice) -> None:
        time = every(now.random, now.start, now.end, period, spread_s=8, phase=phase)
        there = presence(taste, now.random, time)
        kept = np.union1d(there, time[now.random.random(len(time)) < (0.15 if host.always_on else 0)])
        connections = connect(now.random, kept, host.ends, server.ends, 993)
        talk(
            now.tape, now.random, connections, IMAP, Fate(dead=0.002, refused=0.002, slow=0.001, lost=0.0005)
        )

    return habit


def files(network: Network, host: Host, taste: Browsing, random: Random) -> Habit:
    """Opens and saves documents on the file server."""
    server, per_hour = network.of_kind("file server")[0], float(random.lognormal(np.log(3), 0.5))

    def habit(now: Slice) -> None:
        time = presence(taste, now.random, poisson(now.random, now.start, now.end, per_hour))
        talk(now.tape, now.random, connect(now.random, time, host.ends, server.ends, 445), SMB, SOUND)

    return habit


def printing(network: Network, host: Host, taste: Browsing) -> Habit:
    """Prints now and then, and asks printers how they are by SNMP."""
    rows = ends(network.of_kind("printer"))

    def habit(now: Slice) -> None:
        random, tape = now.random, now.tape
        time = presence(taste, random, poisson(random, now.start, now.end, 0.5))
        printer = rows.at(random.integers(0, len(rows.ip), len(time)))
        talk(tape, random, connect(random, time, host.ends, printer, 9_100), PRINT, Fate(dead=0.01))
        asked = presence(taste, random, every(random, now.start, now.end, 600, spread_s=60))
        _snmp(now, asked, host.ends, rows.at(random.integers(0, len(rows.ip), len(asked))))

    return habit


def _snmp(now: Slice, time: Ints, asking: Ends, asked: Ends) -> None:
    sport = now.random.integers(32_768, 61_000, len(time))
    packets.udp(now.tape, time, asking, asked, sport=sport, dport=161, payload=43)
    later = time + spread_ms(now.random, len(time), 0.6, 9)
    packets.udp(now.tape, later, asked, asking, sport=161, dport=sport, payload=55)


def of_servers(network: Network, popular: Popularity, random: Random) -> dict[str, Habit]:
    """What servers do by themselves, what is done with them, and who comes from outside."""
    return _Servers(network, popular, random).habits()


class _Servers:
    """The habits around the servers of one office."""

    def __init__(self, network: Network, popular: Popularity, random: Random) -> None:
        self._popular = popular
        self._names = network.gateway.ends
        self._server, self._update = network.of_kind("server")[0], network.of_kind("update server")[0]
        self._build, self._files = network.of_kind("build server")[0], network.of_kind("file server")[0]
        pcs = network.of_kind("pc")
        self._count = len(pcs)
        self._pcs = ends(pcs)
        self._admins = pcs[: int(random.integers(1, 4))]
        self._cron_minutes = float(random.choice([10, 15, 30]))
        self._visitors = random.uniform(12, 45)
        self._mails = random.uniform(6, 25)

    def habits(self) -> dict[str, Habit]:
        return {
            "typed": self._typed,
            "cron": self._cron,
            "visitors": self._come,
            "mail out": self._mail_out,
            "updates": self._updates,
            "intranet": self._intranet,
        }

    def _typed(self, now: Slice) -> None:
        """Administrators log in by SSH; one login in six follows a password that was mistyped."""
        busy = 1.0 if 8 <= hour_of_day(now.start) < 19 else 0.08
        rows = ends([self._server, self._build, self._files, self._update])
        for host in self._admins:
            time = poisson(now.random, now.start, now.end, 0.8 * busy)
            target = rows.at(now.random.integers(0, 4, len(time)))
            connections = connect(now.random, time, host.ends, target, 22)
            talk(now.tape, now.random, connections, TYPED, Fate(refused=0.01))
            wrong = np.flatnonzero(now.random.random(len(time)) < 1 / 6)
            for before_s in (14, 6):
                at = time[wrong] - before_s * SECOND
                failed = connect(now.random, at, host.ends, target.at(wrong), 22)
                talk(now.tape, now.random, failed, MISTYPED, SOUND)

    def _cron(self, now: Slice) -> None:
        """Short SSH connections from server to server, on the minute."""
        time = every(now.random, now.start, now.end, self._cron_minutes * 60, spread_s=2, phase=0.0)
        for number, target in enumerate((self._server, self._files, self._update)):
            connections = connect(now.random, time + number * 1_500_000, self._build.ends, target.ends, 22)
            talk(now.tape, now.random, connections, CRON_SSH, Fate(dead=0.01))

    def _come(self, now: Slice) -> None:
        """Visitors of the published site and mail, from anywhere."""
        busy = 1.0 if 7 <= hour_of_day(now.start) < 22 else 0.4
        for port, what, rate in ((443, SITE, self._visitors), (25, SMTP_IN, self._mails)):
            time = poisson(now.random, now.start, now.end, rate * busy)
            time = time[~self._popular.is_down(time)]
            counts = now.random.geometric(0.6, len(time)) if port == 443 else np.ones(len(time), np.int64)
            visitor, far = self._popular.choose(now.random, len(time), 0.6)
            who = np.repeat(np.arange(len(time)), counts)
            begin = time[who] + within(counts) * 90_000
            connections = connect(now.random, begin, visitor.at(who), self._server.ends, port, inbound=True)
            connections.near[:] = far[who]
            talk(now.tape, now.random, connections, what, Fate(lost=0.004))

    def _mail_out(self, now: Slice) -> None:
        time = poisson(now.random, now.start, now.end, self._mails / 2)
        target, far = self._popular.choose(now.random, len(time), 0.4)
        ask_names(now.tape, now.random, time, self._server.ends, self._names)
        connections = connect(now.random, time + 60_000, self._server.ends, target, 25)
        connections.far[:] = far
        talk(now.tape, now.random, connections, SMTP_IN, Fate(dead=0.05, refused=0.02, slow=0.02))

    def _updates(self, now: Slice) -> None:
        time = poisson(now.random, now.start, now.end, 0.35 * self._count)
        who = self._pcs.at(now.random.integers(0, self._count, len(time)))
        talk(now.tape, now.random, connect(now.random, time, who, self._update.ends, 8_530), UPDATE, SOUND)
        fetched = poisson(now.random, now.start, now.end, 1.5)
        source, far = self._popular.choose(now.random, len(fetched), 0.0)
        connections = connect(now.random, fetched, self._update.ends, source, 443)
        connections.far[:] = far
        talk(now.tape, now.random, connections, UPDATE, INTERNET)

    def _intranet(self, now: Slice) -> None:
        busy = 1.0 if 8 <= hour_of_day(now.start) < 18 else 0.05
        time = poisson(now.random, now.start, now.end, 2.0 * self._count * busy)
        who = self._pcs.at(now.random.integers(0, self._count, len(time)))
        for port, target in ((80, self._server), (8_080, self._build)):
            mine = np.flatnonzero(now.random.random(len(time)) < 0.5)
            connections = connect(now.random, time[mine], who.at(mine), target.ends, port)
            talk(now.tape, now.random, connections, SITE, Fate(refused=0.003, lost=0.0005))


def of_monitor(network: Network, random: Random) -> dict[str, Habit]:
    """Each minute the monitor pings every host, opens each service of the servers and asks by SNMP."""
    monitor = network.of_kind("monitor")[0]
    hosts = [host for host in network.hosts if host is not monitor]
    shut = [host for host in network.of_kind("pc") if not host.always_on]
    absent = network.prefix | int(random.integers(201, 219))
    services = [
        (host, port) for host in hosts if host.kind.endswith("server") for port in sorted(host.open_ports)
    ]
    servers, ports = ends([host for host, _ in services]), np.array([port for _, port in services])
    rows = ends(hosts)
    away = np.array([host in shut for host in hosts])
    pings, phase = int(random.integers(1, 4)), random.random()

    def ping(now: Slice) -> None:
        base = every(now.random, now.start, now.end, 60, phase=phase)
        asleep = not 8 <= hour_of_day(now.start) < 18
        who = np.tile(np.arange(len(hosts)), len(base))
        begin = np.repeat(base, len(hosts)) + who * int(random_pause) + spread_ms(now.random, len(who), 0, 3)
        outage = _outages(now, len(hosts))[who]
        missing = (outage > 0) & (begin >= outage) & (begin < outage + 4 * 60 * SECOND)
        silent = missing | (away[who] & asleep) | (now.random.random(len(who)) < 0.001)
        for number in range(pings):
            time = begin + number * SECOND
            packets.echo(now.tape, time, monitor.ends, rows.at(who), reply=False, length=98)
            good = np.flatnonzero(~silent)
            back = time[good] + spread_ms(now.random, len(good), 0.15, 2.5)
            packets.echo(now.tape, back, rows.at(who[good]), monitor.ends, reply=True, length=98)

    def poll(now: Slice) -> None:
        base = every(now.random, now.start, now.end, 60, phase=phase) + 7 * SECOND
        which = np.tile(np.arange(len(ports)), len(base))
        begin = np.repeat(base, len(ports)) + which * 210_000
        connections = connect(now.random, begin, monitor.ends, servers.at(which), ports[which])
        talk(now.tape, now.random, connections, PROBE, Fate(dead=0.001, refused=0.001))

    def ask(now: Slice) -> None:
        targets = ends(network.of_kind("printer", "telephone", "gateway"))
        base = every(now.random, now.start, now.end, 60, phase=phase) + 31 * SECOND
        which = np.tile(np.arange(len(targets.ip)), len(base))
        _snmp(now, np.repeat(base, len(targets.ip)) + which * 40_000, monitor.ends, targets.at(which))

    def away_server(now: Slice) -> None:
        """A machine outside that was switched off long ago and is still polled."""
        time = every(now.random, now.start, now.end, 300, spread_s=1, phase=phase)
        connections = connect(now.random, time, monitor.ends, network.outside(np.array([gone])), 443)
        unanswered(now.tape, now.random, connections)

    random_pause = random.uniform(5_000, 120_000)
    gone = int(random.integers(60 << 24, 90 << 24))
    return {
        "ping": ping,
        "poll": poll,
        "ask": ask,
        "away server": away_server,
        "absent": arp_for_absent(monitor, absent, 60, random),
    }


def misfits(network: Network, random: Random) -> dict[str, Habit]:
    """What is wrong in every office: drives of machines that are gone, forgotten addresses, late answers."""
    pcs, gateway = network.of_kind("pc"), network.gateway
    chosen = random.permutation(len(pcs))
    gone, old = network.prefix | int(random.integers(221, 250)), int(random.integers(60 << 24, 90 << 24))
    found: dict[str, Habit] = {}
    for place in range(int(random.integers(1, 4))):
        host = pcs[int(chosen[place])]
        found[f"gone drive {place}"] = arp_for_absent(host, gone, random.uniform(40, 400), random)
    forgetful, period = pcs[int(chosen[-1])], random.uniform(25, 180)
    port = int(random.choice([443, 1_433, 5_222, 8_883]))

    def forgotten(now: Slice) -> None:
        time = every(now.random, now.start, now.end, period, spread_s=4)
        connections = connect(now.random, time, forgetful.ends, network.outside(np.array([old])), port)
        sent = unanswered(now.tape, now.random, connections, tries=3)
        told = np.sort(sent)[:: int(now.random.integers(2, 5))]
        packets.unreachable(
            now.tape,
            told + 3_000,
            gateway.ends,
            forgetful.ends,
            code=packets.HOST,
            proto=packets.TCP,
            sport=now.random.integers(32_768, 61_000, len(told)),
            dport=port,
            length=74,
        )

    def late(now: Slice) -> None:
        """Answers that come when the asking program has gone: the host tells the name server."""
        time = poisson(now.random, now.start, now.end, 9)
        who = ends(pcs).at(now.random.integers(0, len(pcs), len(time)))
        sport = now.random.integers(49_152, 65_535, len(time))
        packets.udp(now.tape, time, gateway.ends, who, sport=53, dport=sport, payload=120)
        packets.unreachable(
            now.tape,
            time + 400,
            who,
            gateway.ends,
            code=packets.PORT,
            proto=packets.UDP,
            sport=53,
            dport=sport,
            length=162,
        )

    return found | {"forgotten": forgotten, "late answers": late}


def _outages(now: Slice, hosts: int) -> Ints:
    """For each host when it stops answering for four minutes within this hour; 0: it does not."""
    out = now.random.random(hosts) < 0.004
    return np.where(out, now.start + now.random.integers(0, HOUR, hosts), 0)


def of_telephones(network: Network, random: Random) -> dict[str, Habit]:
    """Telephones register every minute with a provider outside; a few calls a day, 50 packets/s each way."""
    provider = network.outside(np.array([int(random.integers(80 << 24, 90 << 24))]))
    found: dict[str, Habit] = {}
    for host in network.of_kind("telephone"):
        phase, calls = random.random(), random.uniform(0.05, 0.35)
        found[f"{host.name} line"] = _line(host, provider, phase, calls)
    return found


def _line(host: Host, provider: Ends, phase: float, calls: float) -> Habit:
    def habit(now: Slice) -> None:
        random, tape = now.random, now.tape
        time = every(random, now.start, now.end, 60, spread_s=1, phase=phase)
        for src, dst, delay in ((host.ends, provider, 0), (provider, host.ends, 21_000)):
            packets.udp(tape, time + delay, src, dst, sport=5_060, dport=5_060, payload=480)
        if not 8 <= hour_of_day(now.start) < 18:
            return
        begun = poisson(random, now.start, now.end, calls)
        lasting = lognormal(random, 110, 0.9, len(begun), 1_500)
        row = np.repeat(np.arange(len(begun)), lasting * 50)
        at = begun[row] + 3 * SECOND + within(lasting * 50) * 20_000
        ports = random.integers(8_000, 10_000, len(begun)) * 2
        media = random.integers(5_000, 32_000, len(begun)) * 2
        for src, dst, sport, dport in (
            (host.ends, provider, ports, media),
            (provider, host.ends, media, ports),
        ):
            jitter = spread_ms(random, len(at), 0, 4)
            packets.udp(tape, at + jitter, src, dst, sport=sport[row], dport=dport[row], payload=172)

    return habit
