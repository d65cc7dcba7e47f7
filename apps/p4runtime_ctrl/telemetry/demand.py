"""Interests of consumers → packet requests to a switch, and the keys for the packets.

    network.packets.p4runtime_ctrl.<switch>.<which>   record batches: headers as columns
    network.frames.p4runtime_ctrl.<switch>.<which>    the frames themselves, up to the copied length
    network.digests.p4runtime_ctrl.<switch>.<which>   reports of the switch's counting stages
    network.counts.p4runtime_ctrl.<switch>.<which>    differences over their threshold, after their window

    network.telemetry_counters.p4runtime_ctrl.<switch>   packets of each counting entry, every two seconds

    <which>: all       every packet: request `packets`, bit 255
             a port    packets of that port: request `port<n>`, bits 254 down
             a name    packets of a request that an app offered under that name

A key with a wildcard in its last segment follows `all` only: the others hold the same packets.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta

from apps.messages import Message, MessageError, Name
from apps.p4runtime_ctrl.errors import ControllerError
from apps.p4runtime_ctrl.telemetry.classifier import EVERY_PACKET, TelemetryRequest
from apps.p4runtime_ctrl.telemetry.coverage import FALLBACK
from due import Key

Kind = Literal["packets", "frames", "digests", "counts"]
KINDS: Final[tuple[Kind, ...]] = ("packets", "frames", "digests", "counts")
COUNTERS: Final = "telemetry_counters"
APP: Final = "p4runtime_ctrl"
ALL: Final = "all"
_LAST_PORT: Final = 511
"""Of v1model, whose ports have 9 bits."""
_PORT_BITS: Final = 47
"""Bits 208-254 are for ports, 200-207 for frames that digests do not cover; queries of other apps use 0-199."""
QUERY_BITS: Final = 200


def key_of(kind: Kind, switch: str, which: str) -> str:
    """The key under which data of a switch is published."""
    return f"network.{kind}.{APP}.{switch}.{which}"


class Offer(Message, frozen=True, kw_only=True):
    """`network.telemetry.<app>.<name>`: packets that an app defines; sent while somebody observes them.

    A later offer under the same name takes its place; `active` False withdraws it.
    """

    name: Annotated[Name, Meta(min_length=1)]
    """One segment of a key."""
    bit: Annotated[int, Meta(ge=0, lt=QUERY_BITS)]
    """0 to 199, unlike that of any other offer."""
    switch: Name = ""
    """Empty: every switch."""
    conditions: Annotated[dict[str, Any], Meta(max_length=32)] = {}  # noqa: RUF012 - msgspec copies empty defaults
    """As in `classifier.TelemetryRequest`."""
    copy: bool = True
    """Send packet-ins of the matching packets; otherwise they only reach the counting stages, and their reports
    come under `network.digests` and `network.counts`."""
    digest: bool = False
    """A digest of every matching packet."""
    by_stage: bool = False
    """A counting stage chooses the packets and copies them, not the classifier; there are no conditions."""
    active: bool = True

    def request(self) -> TelemetryRequest:
        return TelemetryRequest(
            name=self.name,
            bit=self.bit,
            conditions=self.conditions,
            copy=self.copy,
            digest=self.digest,
            by_stage=self.by_stage,
        )


class Offers(Mapping[str, Offer]):
    """Current packet requests of apps, by name: at most one for each bit.

    Args:
        fits: whether the classifier can hold a request; raises a `ControllerError` that says why not.
    """

    def __init__(self, fits: Callable[[TelemetryRequest], object]) -> None:
        self._offers: dict[str, Offer] = {}
        self._apps: dict[str, str] = {}
        self._fits = fits

    def __getitem__(self, name: str) -> Offer:
        return self._offers[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._offers)

    def __len__(self) -> int:
        return len(self._offers)

    def take(self, app: str, offer: Offer) -> None:
        """Replace an app's earlier offer of this name, or withdraw it.

        Raises `MessageError` if another app has the name or the bit, or the classifier cannot hold it.
        """
        if self._apps.get(offer.name, app) != app:
            raise MessageError(
                "sender",
                f"offer {offer.name} of {app}: {self._apps[offer.name]} already has an offer of this name",
            )
        if not offer.active:
            self._offers.pop(offer.name, None)
            self._apps.pop(offer.name, None)
            return
        taken = [
            name for name, other in self._offers.items() if other.bit == offer.bit and name != offer.name
        ]
        if taken:
            raise MessageError(
                "range", f"offer {offer.name} of {app}: bit {offer.bit} is taken by {taken[0]}"
            )
        try:
            self._fits(offer.request())
        except ControllerError as error:
            raise MessageError("fields", f"offer {offer.name} of {app}: {error}") from None
        self._offers[offer.name], self._apps[offer.name] = offer, app


@dataclass(frozen=True)
class Demand:
    """The packet requests of one switch, and the keys that their packets go to."""

    requests: tuple[TelemetryRequest, ...] = ()
    routes: dict[Kind, dict[str, int]] = field(default_factory=dict)
    """Kind of data → last segment of the key → bit of the request whose packets go there."""
    counters: bool = False
    """The counters of the counting stages are wanted, too."""

    def to(self, kind: Kind) -> dict[str, int]:
        return self.routes.get(kind, {})

    def only(self, requests: Iterable[TelemetryRequest]) -> "Demand":
        """What is left of it if only these of its requests are carried out."""
        kept = tuple(requests)
        bits = {request.bit for request in kept}
        routes = {
            kind: {which: bit for which, bit in to.items() if bit in bits} for kind, to in self.routes.items()
        }
        return replace(self, requests=kept, routes=routes)


def demand_for(
    switch: str,
    wanted: Iterable[str],
    offers: Mapping[str, Offer],
    *,
    by_digest: bool = False,
    last_port: int = _LAST_PORT,
) -> Demand:
    """The demand on one switch from the wanted keys.

    `by_digest`: record batches are made from digests, and frames are copied only for who wants frames,
    or if the digest is incomplete.  `last_port`: a key of a higher port gets no packets.
    """
    keys = [Key.parse(text) for text in wanted]
    data = [key for key in keys if key.segments[1:2] != (COUNTERS,)]
    named = sorted({key.segments[-1] for key in data} - {"*", "**", ALL})
    ports = [name for name in named if name.isdecimal() and int(name) <= last_port][:_PORT_BITS]
    known = {ALL: TelemetryRequest(name="packets", bit=EVERY_PACKET)}
    for bit, port in enumerate(sorted(ports, key=int), start=EVERY_PACKET - len(ports)):
        known[port] = TelemetryRequest(name=f"port{port}", bit=bit, conditions={"ingress_port": int(port)})
    mine = {name: offer for name, offer in offers.items() if offer.active and offer.switch in ("", switch)}
    known |= {name: mine[name].request() for name in named if name in mine}

    routes: dict[Kind, dict[str, int]] = {}
    for kind in KINDS:
        routes[kind] = {
            which: request.bit for which, request in known.items() if _is_wanted(kind, switch, which, data)
        }
    if by_digest:
        known = {which: _by_digest(request, routes, which) for which, request in known.items()}
    requests = {which: known[which] for kind in KINDS for which in routes[kind]}
    wanted_requests = [*requests.values(), *(FALLBACK if by_digest and routes["packets"] else ())]
    counters = Key.parse(f"network.{COUNTERS}.{APP}.{switch}")
    ordered = tuple(sorted(wanted_requests, key=lambda request: -request.bit))
    return Demand(ordered, routes, any(key.matches(counters) for key in keys))


def _by_digest(
    request: TelemetryRequest, routes: Mapping[Kind, Mapping[str, int]], which: str
) -> TelemetryRequest:
    if request.by_stage:
        return request
    digest = request.digest or which in routes["packets"]
    return msgspec.structs.replace(request, copy=which in routes["frames"], digest=digest)


def _is_wanted(kind: Kind, switch: str, which: str, keys: list[Key]) -> bool:
    concrete = Key.parse(key_of(kind, switch, which))
    # a wildcard in the last segment matches `all` only
    return any(key.matches(concrete) for key in keys if which in (ALL, key.segments[-1]))
