"""The SYN guard's entries: what protects a service in the switch, beside the program itself.

protect          the service: its slot, hold time, and the rate of SYNs that needs no challenge
accept meter     of the slot: what the service's backlog bears; above its first rate cookies begin
reflect meter    of the slot: how many cookies a second may go out
protected_hosts  its host: first fragments without a whole TCP header are dropped
guard_secrets    the secrets of the cookies, replaced in turn
"""

import ipaddress
from typing import Any, Final

import msgspec

from apps.messages import TableUpdate, Target
from apps.p4runtime_ctrl.desired_state import DELETE, INSERT, MODIFY, Change
from apps.p4runtime_ctrl.errors import EntryError
from apps.p4runtime_ctrl.p4info import Program
from p4rt import p4runtime

KNOWN_SOURCES: Final = "ingress.known_sources"
SLOTS: Final = 256
SECRET_WORDS: Final = ("even_k0", "even_k1", "odd_k0", "odd_k1")
_PROTECT: Final = "ingress.protect"
_HOSTS: Final = "ingress.protected_hosts"
_SECRETS: Final = "ingress.guard_secrets"
_ACCEPT: Final = "ingress.guard_accept_meter"
_REFLECT: Final = "ingress.guard_reflect_meter"

Service = tuple[str, int]
"""Address and TCP port."""


class Rate(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Packets a second, and how many at once; over the first pair is yellow, over the second red."""

    rate: int
    burst: int
    peak_rate: int = 0
    """0: equal to `rate`."""
    peak_burst: int = 0

    def config(self) -> Any:
        """As P4Runtime has it."""
        return p4runtime.MeterConfig(
            cir=self.rate,
            cburst=self.burst,
            pir=self.peak_rate or self.rate,
            pburst=self.peak_burst or self.burst,
        )


class GuardSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How protected services are guarded; the rates fit a backlog of 128 half-open connections."""

    unchallenged: Rate = Rate(rate=10, burst=32)
    """SYNs from unknown sources that pass while nothing is wrong; the first above starts the challenge."""
    hold_s: float = 10.0
    """How long the challenge goes on after the last SYN above that rate."""
    cookies: bool = True
    """Answer SYNs with cookies when repeated SYNs alone exceed the accepted rate."""
    accepted: Rate = Rate(rate=2, burst=32, peak_rate=4, peak_burst=64)
    """SYNs that get through a challenge: yellow begins cookies, red drops."""
    reflected: Rate = Rate(rate=1000, burst=100)
    """Cookies sent."""
    known: Rate = Rate(rate=20, burst=40)
    """SYNs of one known source; above it counts as unknown, since known addresses can be spoofed."""
    rotate_s: float = 60.0
    """Age at which a secret is replaced; a cookie lives 10 s."""


def service_of(target: Target) -> Service:
    """The service that a decision means; raises `EntryError` where it names none."""
    if target.kind != "ip" or target.port is None:
        raise EntryError(f"protect {target.address}: a service is an IP address and a TCP port")
    try:
        return str(ipaddress.ip_address(target.address)), target.port
    except ValueError:
        raise EntryError(f"protect {target.address!r}: that is no IP address") from None


def protection(program: Program, service: Service, slot: int, settings: GuardSettings) -> list[Change]:
    """What protects a service; the service's own entry comes last, so that nothing it needs is missing."""
    guard = {"slot": slot, "hold_us": int(settings.hold_s * 1e6), "cookies": int(settings.cookies)}
    entry = program.entry(
        TableUpdate(kind="insert", table=_PROTECT, match=_match(service), action="guard", params=guard)
    )
    entry.meter_config.CopyFrom(settings.unchallenged.config())
    return [
        Change(MODIFY, _meter(program, _ACCEPT, slot, settings.accepted)),
        Change(MODIFY, _meter(program, _REFLECT, slot, settings.reflected)),
        Change(INSERT, host_entry(program, service[0])),
        Change(INSERT, entry),
    ]


def release(program: Program, service: Service, *, last_of_host: bool) -> list[Change]:
    """What has to go with the protection of a service; its own entry first."""
    entry = program.entry(TableUpdate(kind="delete", table=_PROTECT, match=_match(service)))
    host = [Change(DELETE, host_entry(program, service[0], kind="delete"))] if last_of_host else []
    return [Change(DELETE, entry), *host]


def host_entry(program: Program, address: str, *, kind: Any = "insert") -> Any:
    match = {name: value for name, value in _match((address, 0)).items() if name != "dport"}
    return program.entry(TableUpdate(kind=kind, table=_HOSTS, match=match, action="drop_short_fragment"))


def secrets_entry(program: Program, current: int, words: tuple[int, ...]) -> Any:
    """The default action that holds the cookies' secrets: `current` is the one that new cookies use."""
    params = {"current": current, **dict(zip(SECRET_WORDS, words, strict=True))}
    return program.entry(TableUpdate(kind="modify", table=_SECRETS, action="set_secrets", params=params))


def _match(service: Service) -> dict[str, Any]:
    address, port = service
    return {"is_ipv4": int(ipaddress.ip_address(address).version == 4), "dst": address, "dport": port}


def _meter(program: Program, name: str, slot: int, rate: Rate) -> Any:
    return p4runtime.MeterEntry(
        meter_id=program.meter(name), index=p4runtime.Index(index=slot), config=rate.config()
    )
