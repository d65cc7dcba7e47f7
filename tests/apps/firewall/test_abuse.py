"""Who forges addresses gets nobody innocent cut off and fills no memory; innocent traffic is left alone."""

import numpy as np
import pytest

from apps.firewall.arp.arp_bindings import ArpBindings
from apps.firewall.evidence.known_sources import KnownSources
from apps.firewall.policy.block_lifecycle import SECOND, BlockLifecycle
from apps.firewall.policy.rules import AllowList, Rules
from apps.firewall.syn.flood_evidence import Suspicion
from apps.firewall.syn.recent_syns import HOSTS, Surges
from apps.firewall.syn.services import TcpService
from apps.firewall.syn.syn_defence import SOURCES_SAMPLED, SynDefence
from apps.firewall.syn.syn_policy import SynRules
from apps.messages import Decision, Exhibit
from apps.packets import read_frames
from apps.sonata_adapter.host.handshake import Handshakes
from due import RecordBatch
from sdnator.capture.captures import Capture
from sdnator.capture.tshark_tsv import read_batches
from sdnator.datasets.mirai_like import MiraiLikeOptions, make
from tests.apps.firewall.alerts import alert
from tests.apps.firewall.desk import ALERT, ARP, HANDSHAKE, NOW, SYNS, Desk
from tests.apps.firewall.rows import arp, records, spoofed_syns
from tests.apps.firewall.syn.test_recent_syns import batch
from tests.apps.firewall.syn.test_syn_defence import decided
from tests.requirements import shared_data

WEB = TcpService("10.0.0.1", 80)
GATEWAY, RESOLVER, KNOWN, NEIGHBOUR = "10.0.0.254", "10.0.0.253", "10.3.0.7", "10.3.0.8"
WEB6, KNOWN6 = TcpService("fd00::1", 80), "fd03::7"
ATTACKER, HOST = 0x02_00_00_00_00_66, 0x02_00_00_00_00_07
ANY = Exhibit(key="k", timestamp=1, summary="a surge")


def defence(allow: tuple[str, ...] = (), known: int = 4000) -> SynDefence:
    return SynDefence(SynRules(), (), BlockLifecycle(Rules()), AllowList.parse(allow), KnownSources(known))


@pytest.mark.parametrize("forged", [GATEWAY, RESOLVER, KNOWN, "10.9.9.9", "fd00::254", KNOWN6, "fd09::9"])
def test_flood_in_somebodys_name(forged):
    """Gateway, DNS server, a known client, somebody allowed: guarded against, never blocked."""
    service = WEB6 if ":" in forged else WEB
    allow = (GATEWAY, RESOLVER, "10.9.0.0/16", "fd00::254", "fd09::/16")
    desk = Desk(rules=Rules(allow=allow), syn=SynRules(grace_ms=0, patience_ms=0))
    for known in (KNOWN, KNOWN6):
        desk.hand(HANDSHAKE, {"source": known, "service": service.address, "port": 80, "at": NOW})
    for _ in range(2):
        desk.hand(SYNS, batch(*[(NOW // 1000, forged, service.address, 80)] * 600))
        desk.service.tick()
    assert desk.guarded == [service.address]
    assert desk.blocked == []


@pytest.mark.parametrize(("prefix", "host"), [("10.3.0.", KNOWN), ("fd03::", KNOWN6)])
def test_flood_from_the_prefix_of_a_real_host(prefix, host):
    """Every address of it repeats, one of them is known: the prefix stays open, the service is guarded."""
    made = defence()
    service = WEB6 if ":" in prefix else WEB
    made.handshake(host, service, NOW)
    rows = [(1, f"{prefix}{n}", service.address, 80) for n in range(256) for _ in range(5)]
    made.recent.add(batch(*rows))
    (decision,) = decided(made, made.suspect(Suspicion(service.address, ANY, NOW, 0)))
    assert (decision.action, decision.target) == ("protect", service.target)


def test_prefix_where_nobody_lives_is_blocked_as_one():
    """Many neighbours misbehave: one entry."""
    made = defence()
    rows = [(1, f"10.4.0.{n}", WEB.address, 80) for n in range(256) for _ in range(5)]
    made.recent.add(batch(*rows))
    (decision,) = decided(made, made.suspect(Suspicion(WEB.address, ANY, NOW, 0)))
    assert (decision.action, decision.target.address) == ("block", "10.4.0.0/24")


def test_client_that_retries_is_not_blocked_with_the_flooders():
    """The backlog is full, so its SYNs get no answer either."""
    made = defence()
    rows = [(1, f"77.0.0.{n}", WEB.address, 80) for n in range(3) for _ in range(300)]
    rows += [(1, NEIGHBOUR, WEB.address, 80)] * 8
    made.recent.add(batch(*rows))
    blocked = decided(made, made.suspect(Suspicion(WEB.address, ANY, NOW, 0)))
    assert sorted(each.target.address for each in blocked) == ["77.0.0.0", "77.0.0.1", "77.0.0.2"]


def host_alert(port: int, mac: str, address: str, addresses: int = 5) -> dict[str, object]:
    sender = {"switch": "s1", "port": port, "mac": mac, "ip": address}
    return alert(anomalous_seconds=5, mac_addresses=addresses).to_value() | {"sender": sender}


def test_anomalies_in_somebodys_name():
    """One MAC with many addresses: what it forges is not blocked; on a port of its own, it is itself."""
    desk = Desk(rules=Rules(allow=(GATEWAY,)))
    desk.hand(HANDSHAKE, {"source": KNOWN, "service": WEB.address, "port": 80, "at": NOW})
    owner, thief = "02:00:00:00:00:07", "02:00:00:00:00:66"
    desk.hand(ARP, records([arp(0, 1, HOST, "10.0.0.7"), arp(1, 3, ATTACKER, "10.0.0.66")]))
    for address in (GATEWAY, KNOWN, "10.0.0.7"):
        desk.hand(ALERT, host_alert(3, thief, address))
    assert [(each.target.address, each.target.port) for each in desk.decisions] == [(thief, 3)]
    assert owner not in desk.blocked


def test_arp_in_somebodys_name():
    """The thief's port and MAC are blocked; from behind a shared port, or as an allowed station, nobody is."""
    minute = 60.0
    trained = [arp(0, 1, HOST, "10.0.0.7"), arp(1, 3, ATTACKER, "10.0.0.66"), arp(599, 1, HOST, "10.0.0.7")]
    theft = [arp(11 * minute, 3, ATTACKER, "10.0.0.7"), arp(11.1 * minute, 1, HOST, "10.0.0.7")]
    for allow, more, blocked in (
        ((), [], ["02:00:00:00:00:66"]),
        (("10.0.0.66",), [], []),
        ((), [arp(2, 3, 0x02_00_00_00_00_55, "10.0.0.55")], []),
    ):
        desk = Desk(rules=Rules(allow=allow))
        desk.hand(ARP, records([*trained, *more]))
        desk.hand(ARP, records(theft))
        assert desk.blocked == blocked
        assert desk.service.health()["arp_thefts"] == 1
        assert bool(desk.events) != bool(blocked)


def test_arp_in_the_gateways_name():
    """That the gateway is allowed does not help who claims its address: the thief's port and MAC are blocked."""
    desk = Desk(rules=Rules(allow=(GATEWAY,)))
    owner = [arp(each, 1, HOST, GATEWAY) for each in (0, 599)]
    desk.hand(ARP, records([owner[0], arp(1, 3, ATTACKER, "10.0.0.66"), owner[1]]))
    desk.hand(ARP, records([arp(660, 3, ATTACKER, GATEWAY), arp(661, 1, HOST, GATEWAY)]))
    assert [(each.target.address, each.target.port) for each in desk.decisions] == [("02:00:00:00:00:66", 3)]


def test_a_million_forged_sources():
    """State stays as it is bounded, and the decision is one guard."""
    made = defence()
    surges = Surges(100, 200)
    made.handshake(KNOWN, WEB, NOW)
    step, size = 13, 20_000
    decisions: list[Decision] = []
    for number in range(50):
        rows = spoofed_syns(
            size, WEB.address, 80, first=1 + number * size, start_us=number * size * step, step_us=step
        )
        made.recent.add(rows)
        for host, since, _ in surges.add(rows) if number % 5 == 0 else ():
            watch = made.suspect(Suspicion(host, ANY, NOW, since))
            assert len(watch.syns) <= SOURCES_SAMPLED
            decisions += decided(made, watch)
    assert [each.action for each in decisions] == ["protect"]
    assert len(made.recent) <= 2 * size
    assert len(made.known) == 1
    assert len(made._lifecycle.blocks) == 0
    assert surges.hosts == 1


def test_a_million_forged_victims():
    """Nor do destinations that nobody has."""
    surges = Surges(100, 200)
    for number in range(10):
        rows = spoofed_syns(100_000, WEB.address, 80, first=0, start_us=0, step_us=0)
        columns = {name: rows[name] for name in rows.columns}
        first = number * 100_000
        columns["ip_dst_lo"] = np.arange(first, first + 100_000, dtype=np.uint64)
        assert surges.add(RecordBatch(columns)) == []
        assert surges.hosts <= HOSTS + 100_000
    crowd = spoofed_syns(100, WEB.address, 80, first=0, start_us=200_000, step_us=0)
    assert [surge.host for surge in surges.add(crowd)] == [WEB.address]


def test_flash_crowd_is_no_flood():
    """Ten times the clients, each of which finishes; some only at their second SYN."""
    made = defence()
    rng = np.random.default_rng(7)
    clients = [f"198.18.{n // 250}.{n % 250}" for n in range(1000)]
    rows = []
    for number, client in enumerate(clients):
        at = 1_000_000 + 200 * number
        rows += [(at, client, WEB.address, 80)] * (2 if rng.random() < 0.05 else 1)
        made.handshake(client, WEB, (at + 30_000) * 1000)
    surges = Surges(100, 200)
    crowd = batch(*rows)
    made.recent.add(crowd)
    suspected = surges.add(crowd)
    assert suspected
    decisions = [
        each
        for host, since, _ in suspected
        for each in decided(made, made.suspect(Suspicion(host, ANY, NOW, since)))
    ]
    assert decisions == []


class Watchman:
    """The SYN logic over a capture, as the service has it, on capture time."""

    def __init__(self) -> None:
        self.defence = defence()
        self.handshakes = Handshakes()
        self.surges = Surges(SynRules().threshold, SynRules().window_ms)
        self.bindings = ArpBindings(training_s=600, settle_s=3600, contest_s=60)
        self.decisions: list[Decision] = []
        self.syns = 0

    def see(self, packets: RecordBatch, syns: RecordBatch) -> None:
        for done in self.handshakes.process(packets):
            self.defence.handshake(done.source, TcpService(done.service, done.port), done.at_us * 1000)
        assert not any(theft.certain for theft in self.bindings.add(packets.take(packets["arp_op"] > 0)))
        self.syns += len(syns)
        self.defence.recent.add(syns)
        for host, since, _ in self.surges.add(syns):
            self.decisions += decided(
                self.defence, self.defence.suspect(Suspicion(host, ANY, since + SECOND, since))
            )


def test_real_packets():
    """38 K of them; the table has no TCP flags, so at worst every packet to a service is a lonely SYN."""
    watchman = Watchman()
    for packets in read_batches(shared_data("kitsune/mirai_38k.tsv.gz"), 500):
        towards_service = (packets["tcp_dport"] >= 0) & (packets["tcp_dport"] < packets["tcp_sport"])
        watchman.see(packets, packets.take(towards_service & (packets["ip_proto"] == 6)))
    assert watchman.syns > 1000
    assert [each for each in watchman.decisions if each.action == "block"] == []


@pytest.mark.parametrize("seed", [1, 2])
def test_generated_benign_hour(seed, tmp_path):
    """With flags and handshakes."""
    path = tmp_path / "benign.pcap"
    make(MiraiLikeOptions(seed=seed, benign_seconds=900, attack_seconds=0), path)
    watchman = Watchman()
    with Capture(path) as capture:
        frames = list(capture)
    for start in range(0, len(frames), 500):
        some = frames[start : start + 500]
        numbers = np.arange(start, start + len(some))
        packets = read_frames(
            [frame.data for frame in some],
            lengths=[frame.length for frame in some],
            times_us=[frame.time_ns // 1000 for frame in some],
            ports=np.ones(len(some)),
            sequence=numbers,
            arrival=numbers,
        )
        watchman.see(packets, packets.take(packets["tcp_flags"] & 0x17 == 0x02))
    assert watchman.syns > 50
    assert watchman.decisions == []
