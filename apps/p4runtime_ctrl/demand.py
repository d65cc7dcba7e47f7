"""What DUE's consumers want → requests to the classifier of a switch.

    network.packets.p4runtime_ctrl.<switch>.all       every packet: request `packets`, bit 255
    network.packets.p4runtime_ctrl.<switch>.<port>    packets of a port: request `port<n>`, bits 254 down
    network.packets.p4runtime_ctrl.<switch>.<name>    a request that an app offered under that name

A key with a wildcard in its last segment follows `all` only: the ports' keys hold the same packets.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from apps.messages import Message
from apps.p4runtime_ctrl.telemetry import EVERY_PACKET, Request
from due import Key

PREFIX: Final = "network.packets.p4runtime_ctrl"
ALL: Final = "all"
_PORT_BITS: Final = 55
"""Bits 200-254 are for ports; queries of other apps take 0-199."""


class Offer(Message, frozen=True, kw_only=True):
    """`network.telemetry.<app>.<name>`: packets that an app defines; copied while somebody observes them.

    A later offer under the same name takes its place; `active` False withdraws it.
    """

    name: str
    bit: int
    switch: str = ""
    """Empty: every switch."""
    conditions: dict[str, Any] = {}  # noqa: RUF012 - msgspec copies empty defaults
    copy: bool = True
    digest: bool = False
    active: bool = True

    def request(self) -> Request:
        return Request(
            name=self.name, bit=self.bit, conditions=self.conditions, copy=self.copy, digest=self.digest
        )


def requests_for(switch: str, wanted: Iterable[str], offers: Mapping[str, Offer]) -> dict[str, Request]:
    """Last segment of the key → request, for the keys that somebody wants of this switch."""
    keys = [Key.parse(text) for text in wanted]
    found: dict[str, Request] = {}
    if any(key.matches(Key.parse(f"{PREFIX}.{switch}.{ALL}")) for key in keys):
        found[ALL] = Request(name="packets", bit=EVERY_PACKET)
    ports = sorted({port for key in keys if (port := _port_of(key, switch)) is not None})
    for place, port in enumerate(ports[:_PORT_BITS]):
        conditions = {"ingress_port": port}
        found[str(port)] = Request(name=f"port{port}", bit=EVERY_PACKET - 1 - place, conditions=conditions)
    for offer in offers.values():
        if not offer.active or offer.switch not in ("", switch):
            continue
        if not offer.copy or _literal(keys, switch, offer.name):
            found[offer.name] = offer.request()
    return found


def _port_of(key: Key, switch: str) -> int | None:
    last = key.segments[-1]
    if not last.isdecimal() or not key.matches(Key.parse(f"{PREFIX}.{switch}.{last}")):
        return None
    return int(last)


def _literal(keys: Sequence[Key], switch: str, name: str) -> bool:
    return any(
        key.segments[-1] == name and key.matches(Key.parse(f"{PREFIX}.{switch}.{name}")) for key in keys
    )
