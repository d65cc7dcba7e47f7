"""The entries of a rate limit.

limit_over     its slot: drops and counts what is over it
limit_spared   its slot and a source: a rate of its own, for each source that the decision names
limit          the packets and their meter; where they come from a port, later fragments too, which have no ports;
               before a limit of SYNs, open ports with a meter that nothing exceeds
"""

import ipaddress
from typing import Any, Final

from apps.messages import RateLimit, TableUpdate, Target
from apps.p4runtime_ctrl.errors import EntryError
from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
from apps.p4runtime_ctrl.state.desired_state import DELETE, INSERT, Change
from p4rt import p4runtime

LIMIT: Final = "ingress.limit"
OVER: Final = "ingress.limit_over"
SPARED: Final = "ingress.limit_spared"
SLOTS: Final = 256
_PRIORITY: Final = 1_000
_FRAGMENTS: Final = 1
"""Plus the slot, so that two limits of one victim have an entry each."""
_OPEN_PRIORITY: Final = _PRIORITY + 1
_UNLIMITED: Final = 1 << 31
"""Packets a second of an open port."""
_TCP, _UDP, _ICMP, _ICMPV6 = 6, 17, 1, 58
_SYN, _ACK = 0x02, 0x10
_ECHO, _ECHO_V6 = 8, 128
_LATER: Final = 2

LimitKey = tuple[str, str, int | None]
"""Address or prefix of the victim, kind and port."""


def key_of(target: Target, limit: RateLimit) -> LimitKey:
    """What distinguishes a rate limit from others; raises `EntryError` if the target is no address or prefix."""
    return str(_network(target)), limit.kind, limit.port


def limit_entries(
    program: ProgramInfo, target: Target, limit: RateLimit, slot: int, kind: Any = "insert"
) -> list[Any]:
    """The entries, in the order of inserting: the last is the limit itself."""
    victim = _network(target)
    over = program.entry(_named(kind, OVER, {"slot": slot}, "drop_over"))
    spared = [_spared(program, kind, slot, source, limit) for source in limit.spared]
    limits = []
    for match, priority, rate in reversed(_matches(victim, limit, slot)):
        entry = program.entry(
            TableUpdate(
                kind=kind,
                table=LIMIT,
                match=match,
                action="" if kind == "delete" else "limit_rate",
                params={} if kind == "delete" else {"slot": slot},
                priority=priority,
            )
        )
        limits.append(_metered(entry, kind, rate))
    return [over, *spared, *limits]


def limiting(program: ProgramInfo, target: Target, limit: RateLimit, slot: int) -> list[Change]:
    """Changes that set a rate limit; its `limit` entry comes last, when all that it needs is there."""
    return [Change(INSERT, entry) for entry in limit_entries(program, target, limit, slot)]


def lifting(program: ProgramInfo, target: Target, limit: RateLimit, slot: int) -> list[Change]:
    """Changes that lift a rate limit; its `limit` entry first."""
    return [
        Change(DELETE, entry) for entry in reversed(limit_entries(program, target, limit, slot, "delete"))
    ]


def _matches(victim: Any, limit: RateLimit, slot: int) -> list[tuple[dict[str, Any], int, int]]:
    """Matches, priorities and rates, the limit itself first."""
    fits: dict[str, Any] = {"is_ipv4": [int(victim.version == 4), 1]}
    if victim.prefixlen:
        fits["dst"] = [str(victim.network_address), str(victim.netmask)]
    if limit.kind == "icmp":
        echo = (_ICMP, _ECHO) if victim.version == 4 else (_ICMPV6, _ECHO_V6)
        return [(fits | {"protocol": [echo[0], 0xFF], "icmp_type": [echo[1], 0xFF]}, _PRIORITY, limit.rate)]
    if limit.kind == "tcp":
        ports = {"dport": [limit.port, 0xFFFF], "tcp_flags": [0, _SYN]}
        return [(fits | {"protocol": [_TCP, 0xFF]} | ports, _PRIORITY, limit.rate)]
    if limit.kind == "syn":
        syns = fits | {"protocol": [_TCP, 0xFF], "tcp_flags": [_SYN, _SYN | _ACK]}
        spared = [(syns | {"dport": [port, 0xFFFF]}, _OPEN_PRIORITY, _UNLIMITED) for port in limit.open_ports]
        return [(syns, _PRIORITY, limit.rate), *spared]
    datagrams = fits | {"protocol": [_UDP, 0xFF]}
    if limit.kind == "udp":
        return [(datagrams, _PRIORITY, limit.rate)]
    port = {"sport" if limit.kind == "udp_from" else "dport": [limit.port, 0xFFFF]}
    fragments = datagrams | {"fragment": [_LATER, 0x3]}
    return [(datagrams | port, _PRIORITY, limit.rate), (fragments, _FRAGMENTS + slot, limit.rate)]


def _spared(program: ProgramInfo, kind: Any, slot: int, source: str, limit: RateLimit) -> Any:
    match = {"slot": slot, "is_ipv4": int(ipaddress.ip_address(source).version == 4), "src": source}
    return _metered(program.entry(_named(kind, SPARED, match, "spare_source")), kind, limit.spared_rate)


def _named(kind: Any, table: str, match: dict[str, Any], action: str) -> TableUpdate:
    return TableUpdate(kind=kind, table=table, match=match, action="" if kind == "delete" else action)


def _metered(entry: Any, kind: Any, rate: int) -> Any:
    """A second's worth of packets may come at once."""
    if kind != "delete":
        entry.meter_config.CopyFrom(p4runtime.MeterConfig(cir=rate, cburst=rate, pir=rate, pburst=rate))
    return entry


def _network(target: Target) -> Any:
    if target.kind != "ip":
        raise EntryError(f"rate limit towards {target.address}: the victim is an IP address or prefix")
    try:
        return ipaddress.ip_network(target.address)
    except ValueError:
        raise EntryError(
            f"rate limit towards {target.address!r}: that is not an IP address or prefix"
        ) from None
