"""The table as commands of libnftables' JSON, and its listing.  Pure.

    table inet sdnator
      sets      allowed4 allowed6 allowed_mac      blocked4 blocked6 prefixes4 prefixes6 blocked_mac
      chains    input, forward: what is allowed is accepted, then what is blocked is dropped

Elements have the kernel's time-outs, rounded up to seconds, so that blocks end even if this app is dead.
`delete` of an element that has gone fails the whole transaction, so each is added just before it.

Source: libnftables-json(5).
"""

import ipaddress
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from apps.enforcers.desired_blocks import DesiredBlock
from apps.enforcers.enforcer import HeldCount
from apps.messages import Target

Command = dict[str, Any]
Element = tuple[str, str]
"""A set and a value."""

FAMILY: Final = "inet"
_SETS: Final = {
    "allowed4": ("ipv4_addr", ("interval",)),
    "allowed6": ("ipv6_addr", ("interval",)),
    "allowed_mac": ("ether_addr", ()),
    "blocked4": ("ipv4_addr", ("timeout",)),
    "blocked6": ("ipv6_addr", ("timeout",)),
    "prefixes4": ("ipv4_addr", ("interval", "timeout")),
    "prefixes6": ("ipv6_addr", ("interval", "timeout")),
    "blocked_mac": ("ether_addr", ("timeout",)),
}
_FIELDS: Final = {"4": ("ip", "saddr"), "6": ("ip6", "saddr"), "c": ("ether", "saddr")}
"""By the last letter of a set's name."""
_SECOND: Final = 1_000_000_000


@dataclass(frozen=True)
class TablePlan:
    """Name and place of the table."""

    name: str = "sdnator"
    hooks: tuple[str, ...] = ("input", "forward")
    priority: int = -10

    def create(self, allowed: Iterable[str], elements: Mapping[Element, int], now: int) -> list[Command]:
        """Commands that make the whole table anew, in one transaction.

        Args:
            allowed: the allow-list.
            elements: blocked ones with their ends, wall time in ns, 0 = none.
            now: wall time, ns.
        """
        table = {"family": FAMILY, "name": self.name}
        commands: list[Command] = [
            {"add": {"table": table}},
            {"delete": {"table": table}},
            {"add": {"table": table}},
        ]
        for name, (kind, flags) in _SETS.items():
            made: dict[str, Any] = {"family": FAMILY, "table": self.name, "name": name, "type": kind}
            if flags:
                made["flags"] = list(flags)
            if "timeout" in flags:
                made["stmt"] = [{"counter": None}]
            commands.append({"add": {"set": made}})
        for hook in self.hooks:
            commands += self._chain(hook)
        commands += self._allow(allowed)
        return commands + [self._add(each, end, now) for each, end in elements.items()]

    def change(
        self, add: Mapping[Element, int], remove: Iterable[Element], standing: Mapping[Element, int], now: int
    ) -> list[Command]:
        """Commands that add and remove blocked elements, in one transaction.

        Args:
            add: elements with their ends, wall time in ns, 0 = none.
            remove: elements.
            standing: those that may stand, with their ends.
            now: wall time, ns.
        """
        commands: list[Command] = []
        for each in remove:
            commands += [self._add(each, standing.get(each, 0), now), self._delete(each)]
        for each, end in add.items():
            if each in standing:
                commands += [self._add(each, standing[each], now), self._delete(each)]
            commands.append(self._add(each, end, now))
        return commands

    def delete(self) -> list[Command]:
        """Commands that remove the table, whether it is there or not."""
        table = {"family": FAMILY, "name": self.name}
        return [{"add": {"table": table}}, {"delete": {"table": table}}]

    def _chain(self, hook: str) -> list[Command]:
        at = {"family": FAMILY, "table": self.name}
        chain = {"name": hook, "type": "filter", "hook": hook, "prio": self.priority, "policy": "accept"}
        commands: list[Command] = [{"add": {"chain": at | chain}}]
        for name in _SETS:
            protocol, part = _FIELDS[name[-1]]
            left = {"payload": {"protocol": protocol, "field": part}}
            verdict = "accept" if name.startswith("allowed") else "drop"
            matched = {"match": {"op": "==", "left": left, "right": f"@{name}"}}
            commands.append({"add": {"rule": at | {"chain": hook, "expr": [matched, {verdict: None}]}}})
        return commands

    def _allow(self, entries: Iterable[str]) -> list[Command]:
        networks: list[Any] = []
        macs: set[str] = set()
        for entry in entries:
            try:
                networks.append(ipaddress.ip_network(entry, strict=False))
            except ValueError:
                macs.add(entry.lower())
        found: list[Command] = []
        for version in (4, 6):
            apart = ipaddress.collapse_addresses(each for each in networks if each.version == version)
            values = [_value(str(each)) for each in apart]
            found += [self._elements(f"allowed{version}", values)] if values else []
        return found + ([self._elements("allowed_mac", sorted(macs))] if macs else [])

    def _elements(self, name: str, values: Sequence[Any]) -> Command:
        return {
            "add": {"element": {"family": FAMILY, "table": self.name, "name": name, "elem": list(values)}}
        }

    def _add(self, element: Element, end: int, now: int) -> Command:
        name, text = element
        value = _value(text)
        if end:
            value = {"elem": {"val": value, "timeout": max(1, math.ceil((end - now) / _SECOND))}}
        return self._elements(name, [value])

    def _delete(self, element: Element) -> Command:
        name, text = element
        found = {"family": FAMILY, "table": self.name, "name": name, "elem": [_value(text)]}
        return {"delete": {"element": found}}


def element_of(target: Target) -> Element:
    """Where a target stands."""
    if target.kind == "mac":
        return "blocked_mac", target.address.lower()
    network = ipaddress.ip_network(target.address)
    alone = network.num_addresses == 1
    name = f"{'blocked' if alone else 'prefixes'}{network.version}"
    return name, str(network.network_address if alone else network)


def elements_of(desired: Iterable[DesiredBlock]) -> dict[Element, int]:
    """Elements that make all of these blocks stand, with their ends.

    Two decisions about one target are one element; of prefixes in each other the outermost stands, because
    intervals of a set must not overlap.
    """
    found: dict[Element, int] = {}
    for desired_block in desired:
        element = element_of(desired_block.target)
        before = found.get(element, -1)
        found[element] = 0 if 0 in (before, desired_block.until) else max(before, desired_block.until)
    inner = {element for element in found if outermost(element, found) != element}
    return {element: end for element, end in found.items() if element not in inner}


def outermost(element: Element, elements: Iterable[Element]) -> Element:
    """The element itself, or of these the largest prefix that contains it."""
    name, text = element
    if not name.startswith("prefixes"):
        return element
    network: Any = ipaddress.ip_network(text)
    around = [ipaddress.ip_network(other) for kind, other in elements if kind == name]
    largest = min(
        [network, *(each for each in around if network.subnet_of(each))], key=lambda one: one.prefixlen
    )
    return name, str(largest)


@dataclass(frozen=True)
class TableListing:
    """A table as it was read."""

    shape: str
    """Sets, chains and rules without elements and handles: differs if somebody has changed them."""
    elements: Mapping[Element, HeldCount]
    """Blocked ones."""


def listing_in(document: Mapping[str, Any]) -> TableListing:
    """Read `nft -j list table`; raises ValueError for what is none."""
    shape: list[str] = []
    elements: dict[Element, HeldCount] = {}
    parts = document.get("nftables")
    if not isinstance(parts, list):
        raise ValueError("not an nftables listing")  # noqa: TRY004 - as of other malformed ones
    for part in parts:
        for kind, one in part.items():
            if kind == "metainfo":
                continue
            held = one.pop("elem", []) if kind == "set" else []
            one.pop("handle", None)
            name = str(one.get("name", ""))
            if kind == "set" and name.startswith("allowed"):
                one["elem"] = sorted(map(str, held))
            else:
                elements |= {(name, text): count for text, count in map(_element_in, held)}
            shape.append(f"{kind} {sorted(one.items())}")
    return TableListing("\n".join(shape), elements)


def _element_in(listed: Any) -> tuple[str, HeldCount]:
    inner = listed.get("elem", {}) if isinstance(listed, dict) else {}
    value = inner.get("val", listed)
    counter = inner.get("counter") or {}
    if isinstance(value, dict) and "prefix" in value:
        value = f"{value['prefix']['addr']}/{value['prefix']['len']}"
    count = HeldCount(int(counter.get("packets", 0)), int(counter.get("bytes", 0)))
    return str(value), count


def _value(text: str) -> Any:
    address, slash, length = text.partition("/")
    if not slash:
        return text
    whole = int(length) == (32 if ":" not in address else 128)
    return address if whole else {"prefix": {"addr": address, "len": int(length)}}
