"""The SYN guard's entries for a protected service.

protect          the service: its slot, hold time, and the rate of SYNs that needs no challenge
accept meter     of the slot: SYNs that the service's backlog can hold; above its first rate cookies begin
reflect meter    of the slot: cookies per second that may be sent
protected_hosts  its host: first fragments without a complete TCP header are dropped
guard_secrets    the secrets of the cookies, replaced in turn
"""

import ipaddress
from typing import Any, Final

import msgspec

from apps.messages import TableUpdate, Target
from apps.p4runtime_ctrl.errors import EntryError
from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
from apps.p4runtime_ctrl.state.desired_state import DELETE, INSERT, MODIFY, Change
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
    """A two-rate meter in packets per second: above the first pair yellow, above the second red."""

    rate: int
    """Packets per second."""
    burst: int
    """Packets."""
    peak_rate: int = 0
    """Packets per second; 0: equal to `rate`."""
    peak_burst: int = 0
    """Packets; 0: equal to `burst`."""

    def config(self) -> Any:
        """The P4Runtime `MeterConfig`."""
        return p4runtime.MeterConfig(
            cir=self.rate,
            cburst=self.burst,
            pir=self.peak_rate or self.rate,
            pburst=self.peak_burst or self.burst,
        )


class GuardSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How protected services are guarded; the rates fit a backlog of 128 half-open connections."""

    unchallenged: Rate = Rate(rate=10, burst=32)
    """SYNs from unknown sources that pass unchallenged; the first one above starts the challenge."""
    hold_s: float = 10.0
    """Seconds for which the challenge continues after the last SYN above that rate."""
    cookies: bool = True
    """Answer SYNs with cookies when repeated SYNs alone exceed the accepted rate."""
    accepted: Rate = Rate(rate=2, burst=32, peak_rate=4, peak_burst=64)
    """SYNs that pass a challenge: yellow starts cookies, red drops."""
    reflected: Rate = Rate(rate=1000, burst=100)
    """SYN-ACKs with cookies that may be sent."""
    known: Rate = Rate(rate=20, burst=40)
    """SYNs of one known source; above this it counts as unknown, since known addresses can be spoofed."""
    rotate_s: float = 60.0
    """Seconds after which a secret is replaced; a cookie is valid for 10 s."""


def service_of(target: Target) -> Service:
    """The service of a decision; raises `EntryError` if it names none."""
    if target.kind != "ip" or target.port is None:
        raise EntryError(f"protect {target.address}: a service is an IP address and a TCP port")
    try:
        return str(ipaddress.ip_address(target.address)), target.port
    except ValueError:
        raise EntryError(f"protect {target.address!r}: that is not an IP address") from None


def protection(program: ProgramInfo, service: Service, slot: int, settings: GuardSettings) -> list[Change]:
    """Changes that protect a service; its `protect` entry comes last, when all that it needs is there."""
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


def release(program: ProgramInfo, service: Service, *, last_of_host: bool) -> list[Change]:
    """Changes that end the protection of a service; its `protect` entry first."""
    entry = program.entry(TableUpdate(kind="delete", table=_PROTECT, match=_match(service)))
    host = [Change(DELETE, host_entry(program, service[0], kind="delete"))] if last_of_host else []
    return [Change(DELETE, entry), *host]


def host_entry(program: ProgramInfo, address: str, *, kind: Any = "insert") -> Any:
    match = {name: value for name, value in _match((address, 0)).items() if name != "dport"}
    return program.entry(TableUpdate(kind=kind, table=_HOSTS, match=match, action="drop_short_fragment"))


def secrets_entry(program: ProgramInfo, current: int, words: tuple[int, ...]) -> Any:
    """The default action that holds the cookies' secrets: `current` is the one that new cookies use."""
    params = {"current": current, **dict(zip(SECRET_WORDS, words, strict=True))}
    return program.entry(TableUpdate(kind="modify", table=_SECRETS, action="set_secrets", params=params))


def _match(service: Service) -> dict[str, Any]:
    address, port = service
    return {"is_ipv4": int(ipaddress.ip_address(address).version == 4), "dst": address, "dport": port}


def _meter(program: ProgramInfo, name: str, slot: int, rate: Rate) -> Any:
    return p4runtime.MeterEntry(
        meter_id=program.meter(name), index=p4runtime.Index(index=slot), config=rate.config()
    )
