"""All generated attacks: 31 to tune on and a second list, held back, with other numbers.

Whoever tunes decisions must not look at results of those with `held_back`.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

from benchmarks.decision_traffic import floods, intrusions, scans
from benchmarks.decision_traffic.network import Network
from benchmarks.decision_traffic.scene import Scene
from benchmarks.decision_traffic.traffic import Traffic
from benchmarks.decision_traffic.truth import AttackerIs, AttackSpec, AttackTruth, Kind, Remedy, told

_REMEDIES: Final[dict[AttackerIs, tuple[Remedy, ...]]] = {
    "known": ("block_sender", "block_address"),
    "new": ("block_sender", "block_address"),
    "outside": ("block_address",),
    "inside forging": ("block_sender",),
    "outside forging": (),
}
"""What helps by itself against each kind of attacker; `_spec` adds guard and meter."""


def _make(
    script: Callable[..., None],
    settings: dict[str, Any],
    remedies: tuple[Remedy, ...],
    spec: AttackSpec,
    network: Network,
    seed: int,
    start_s: float,
) -> tuple[Traffic, AttackTruth]:
    scene = Scene(spec, network, seed, start_s)
    script(scene, **settings)
    traffic = scene.tape.traffic()
    truth = told(
        traffic,
        spec,
        scene.ident,
        attackers=scene.attackers,
        victims=scene.victims,
        innocents=scene.innocents,
        remedies=remedies,
        forged=any(attacker.ip == 0 for attacker in scene.attackers),
    )
    return traffic, truth


def _spec(
    number: int,
    name: str,
    kind: Kind,
    attacker_is: AttackerIs,
    script: Callable[..., None],
    *more: Remedy,
    **settings: Any,
) -> AttackSpec:
    held_back = number >= _HELD_BACK
    needs = ("internet",) if attacker_is.startswith("outside") else ()
    remedies = (*_REMEDIES[attacker_is], *more)
    rate = float(settings.get("rate", 1.0 / float(settings.get("period_s", 1.0))))
    return AttackSpec(
        number=number,
        name=name,
        kind=kind,
        attacker_is=attacker_is,
        rate=rate,
        held_back=held_back,
        needs=needs,
        make=partial(_make, script, settings, remedies),
    )


_HELD_BACK: Final = 101
"""Numbers from here on are held back."""

ATTACKS: Final[Sequence[AttackSpec]] = (
    # scans of ports
    _spec(1, "syn scan, fast, newcomer", "scan", "new", scans.syn_scan, count=4_000, rate=1_000),
    _spec(2, "syn scan, medium, known host", "scan", "known", scans.syn_scan, count=1_500, rate=50),
    _spec(3, "syn scan, bursts, newcomer", "scan", "new", scans.syn_scan, count=2_000, rate=500, burst=(100, 1.5)),
    _spec(4, "syn scan, fast, outside", "scan", "outside", scans.syn_scan, "meter", count=3_000, rate=200),
    _spec(5, "syn scan, one in 5 s, newcomer", "scan", "new", scans.syn_scan, count=400, rate=0.2),
    _spec(6, "syn scan, one in 5 s, known host", "scan", "known", scans.syn_scan, count=400, rate=0.2),
    _spec(7, "udp scan, newcomer", "scan", "new", scans.udp_scan, count=3_000, rate=200),
    _spec(8, "ack scan, known host", "scan", "known", scans.ack_scan, count=5_000, rate=800),
    # scans of addresses
    _spec(9, "telnet scan, infected host", "scan", "known", scans.telnet_scan, count=2_000, rate=10),
    _spec(10, "icmp sweep, known host", "scan", "known", scans.ping_sweep, nets=3, rate=200, syn=False),
    _spec(11, "syn ping sweep, newcomer", "scan", "new", scans.ping_sweep, nets=2, rate=250, syn=True),
    _spec(12, "service scan of the lan, known host", "scan", "known", scans.many_hosts_scan, ports=(22, 80, 445, 3_389), rate=60),
    _spec(13, "arp scan, fast, newcomer", "scan", "new", scans.arp_scan, rate=256),
    _spec(14, "arp scan, slow, known host", "scan", "known", scans.arp_scan, rate=2, rounds=2),
    # spoofing
    _spec(15, "arp poisoning, newcomer", "spoofing", "new", intrusions.arp_poisoning, seconds=120, period_s=2.0, victims=1),
    _spec(16, "arp poisoning, known host", "spoofing", "known", intrusions.gratuitous_poisoning, seconds=120, period_s=2.0),
    _spec(17, "planted syn scan, own mac", "spoofing", "inside forging", scans.planted_scan, count=2_000, rate=200, steal_mac=False),
    _spec(18, "planted syn scan, stolen mac", "spoofing", "inside forging", scans.planted_scan, count=2_000, rate=200, steal_mac=True),
    # guessing
    _spec(19, "ssh guessing, outside", "guessing", "outside", intrusions.guessing, port=22, count=200, rate=2),
    _spec(20, "ssh guessing, known host", "guessing", "known", intrusions.guessing, port=22, count=200, rate=2),
    _spec(21, "ftp guessing, newcomer", "guessing", "new", intrusions.guessing, port=21, count=200, rate=4),
    # floods
    _spec(22, "syn flood, one source, known host", "flood", "known", floods.syn_flood, "guard", "meter", count=6_000, rate=300),
    _spec(23, "syn flood, forged, 300/s, outside", "flood", "outside forging", floods.forged_syn_flood, "guard", "meter", count=9_000, rate=300),
    _spec(24, "syn flood, forged, 3,000/s, outside", "flood", "outside forging", floods.forged_syn_flood, "guard", "meter", count=30_000, rate=3_000),
    _spec(25, "syn flood, forged by an infected host", "flood", "inside forging", floods.forged_syn_flood, "guard", "meter", count=6_000, rate=300),
    _spec(26, "udp flood, infected host", "flood", "known", floods.udp_flood, "meter", count=10_000, rate=500),
    _spec(27, "icmp flood, newcomer", "flood", "new", floods.icmp_flood, "meter", count=6_000, rate=400),
    _spec(28, "ack flood, forged, outside", "flood", "outside forging", floods.ack_flood, "meter", count=10_000, rate=1_000),
    _spec(29, "dns amplification", "flood", "outside forging", floods.dns_amplification, "meter", count=14_000, rate=7_000, servers=1_000),
    _spec(30, "slow infection", "scan", "known", intrusions.slow_infection, count=1_000, rate=0.14),
    _spec(31, "telnet guessing, known host", "guessing", "known", intrusions.guessing, port=23, count=150, rate=2),
    # held back
    _spec(101, "syn scan, 400/s, newcomer", "scan", "new", scans.syn_scan, count=2_500, rate=400),
    _spec(102, "syn scan, 25/s, known host", "scan", "known", scans.syn_scan, count=1_000, rate=25),
    _spec(103, "syn scan, bursts, known host", "scan", "known", scans.syn_scan, count=1_500, rate=800, burst=(40, 3.0)),
    _spec(104, "syn scan, 80/s, outside", "scan", "outside", scans.syn_scan, "meter", count=2_000, rate=80),
    _spec(105, "udp scan, known host", "scan", "known", scans.udp_scan, count=1_500, rate=60),
    _spec(106, "ack scan, newcomer", "scan", "new", scans.ack_scan, count=2_000, rate=150),
    _spec(107, "telnet scan, 25/s, infected host", "scan", "known", scans.telnet_scan, count=3_000, rate=25, inside=0.2),
    _spec(108, "icmp sweep, newcomer", "scan", "new", scans.ping_sweep, nets=2, rate=60, syn=False),
    _spec(109, "syn ping sweep, known host", "scan", "known", scans.ping_sweep, nets=4, rate=500, syn=True),
    _spec(110, "arp scan, 60/s, known host", "scan", "known", scans.arp_scan, rate=60),
    _spec(111, "arp poisoning, both ways, three hosts", "spoofing", "known", intrusions.arp_poisoning, seconds=90, period_s=1.0, victims=3),
    _spec(112, "planted udp scan", "spoofing", "inside forging", scans.planted_names, count=1_500, rate=150),
    _spec(113, "ssh guessing, newcomer, two servers", "guessing", "new", intrusions.guessing, port=22, count=240, rate=3, victims=2),
    _spec(114, "ssh guessing, 1/s, known host", "guessing", "known", intrusions.guessing, port=22, count=150, rate=1),
    _spec(115, "syn flood, one source, newcomer", "flood", "new", floods.syn_flood, "guard", "meter", count=8_000, rate=800),
    _spec(116, "syn flood, forged, 1,000/s, outside", "flood", "outside forging", floods.forged_syn_flood, "guard", "meter", count=15_000, rate=1_000, sources=2_000),
    _spec(117, "udp flood within the lan, newcomer", "flood", "new", floods.udp_flood, "meter", count=8_000, rate=800, payload=1_000, inside=True),
    _spec(118, "icmp flood, outside", "flood", "outside", floods.icmp_flood, "meter", count=8_000, rate=1_000, length=1_028),
    _spec(119, "ack flood, forged by an infected host", "flood", "inside forging", floods.ack_flood, "meter", count=6_000, rate=500),
    _spec(120, "dns amplification, 2,000/s", "flood", "outside forging", floods.dns_amplification, "meter", count=8_000, rate=2_000, servers=300),
)  # fmt: skip
"""Numbers 1 to 31 to tune on, 101 to 120 held back."""
