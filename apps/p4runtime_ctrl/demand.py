"""What DUE's consumers want → requests to the classifier of a switch, and where the packets go.

    network.packets.p4runtime_ctrl.<switch>.<which>   record batches: headers as columns
    network.frames.p4runtime_ctrl.<switch>.<which>    the frames themselves, as far as they are copied
    network.digests.p4runtime_ctrl.<switch>.<which>   reports of the switch's counting stages
    network.counts.p4runtime_ctrl.<switch>.<which>    differences over their threshold, after their window

    <which>: all       every packet: request `packets`, bit 255
             a port    packets of that port: request `port<n>`, bits 254 down
             a name    packets of a request that an app offered under that name

A key with a wildcard in its last segment follows `all` only: the others hold the same packets.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal

import msgspec

from apps.messages import Message
from apps.p4runtime_ctrl.coverage import FALLBACK
from apps.p4runtime_ctrl.telemetry import EVERY_PACKET, Request
from due import Key

Kind = Literal["packets", "frames", "digests", "counts"]
KINDS: Final[tuple[Kind, ...]] = ("packets", "frames", "digests", "counts")
APP: Final = "p4runtime_ctrl"
ALL: Final = "all"
_PORT_BITS: Final = 47
"""Bits 208-254 are for ports, 200-207 for what digests do not say; queries of other apps take 0-199."""


def key_of(kind: Kind, switch: str, which: str) -> str:
    """The key that data of a switch is published under."""
    return f"network.{kind}.{APP}.{switch}.{which}"


class Offer(Message, frozen=True, kw_only=True):
    """`network.telemetry.<app>.<name>`: packets that an app defines; sent while somebody observes them.

    A later offer under the same name takes its place; `active` False withdraws it.
    """

    name: str
    """One segment of a key."""
    bit: int
    """0 to 199, unlike that of any other offer."""
    switch: str = ""
    """Empty: every switch."""
    conditions: dict[str, Any] = {}  # noqa: RUF012 - msgspec copies empty defaults
    """As in `telemetry.Request`."""
    copy: bool = True
    """Packet-ins of the matching packets; else they only reach the counting stages, and their reports
    come under `network.digests` and `network.counts`."""
    digest: bool = False
    """A digest of every matching packet."""
    active: bool = True

    def request(self) -> Request:
        return Request(
            name=self.name, bit=self.bit, conditions=self.conditions, copy=self.copy, digest=self.digest
        )


@dataclass(frozen=True)
class Demand:
    """What one switch is to send, and who gets it."""

    requests: tuple[Request, ...] = ()
    routes: dict[Kind, dict[str, int]] = field(default_factory=dict)
    """Kind of data → last segment of the key → bit of the request whose packets go there."""

    def to(self, kind: Kind) -> dict[str, int]:
        return self.routes.get(kind, {})


def demand_for(
    switch: str, wanted: Iterable[str], offers: Mapping[str, Offer], *, by_digest: bool = False
) -> Demand:
    """The demand on one switch by the keys that somebody wants.

    `by_digest`: record batches are made from digests, and frames are copied only for who wants frames,
    or where the digest does not say all.
    """
    keys = [Key.parse(text) for text in wanted]
    named = sorted({key.segments[-1] for key in keys} - {"*", "**", ALL})
    ports = [name for name in named if name.isdecimal()][:_PORT_BITS]
    known = {ALL: Request(name="packets", bit=EVERY_PACKET)}
    for bit, port in enumerate(sorted(ports, key=int), start=EVERY_PACKET - len(ports)):
        known[port] = Request(name=f"port{port}", bit=bit, conditions={"ingress_port": int(port)})
    mine = {name: offer for name, offer in offers.items() if offer.active and offer.switch in ("", switch)}
    known |= {name: mine[name].request() for name in named if name in mine}

    routes: dict[Kind, dict[str, int]] = {}
    for kind in KINDS:
        routes[kind] = {
            which: request.bit for which, request in known.items() if _is_wanted(kind, switch, which, keys)
        }
    if by_digest:
        known = {which: _by_digest(request, routes, which) for which, request in known.items()}
    requests = {which: known[which] for kind in KINDS for which in routes[kind]}
    wanted_requests = [*requests.values(), *(FALLBACK if by_digest and routes["packets"] else ())]
    return Demand(tuple(sorted(wanted_requests, key=lambda request: -request.bit)), routes)


def _by_digest(request: Request, routes: Mapping[Kind, Mapping[str, int]], which: str) -> Request:
    digest = request.digest or which in routes["packets"]
    return msgspec.structs.replace(request, copy=which in routes["frames"], digest=digest)


def _is_wanted(kind: Kind, switch: str, which: str, keys: list[Key]) -> bool:
    concrete = Key.parse(key_of(kind, switch, which))
    # a wildcard in the last segment stands for `all` alone
    return any(key.matches(concrete) for key in keys if which in (ALL, key.segments[-1]))
