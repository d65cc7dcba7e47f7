"""The messages between the network apps: alerts, decisions, commands and confirmations.

    kitsune ──Alert──► firewall ──Decision──► p4runtime_ctrl ──Confirmation──► firewall, reports
    any app ──TableCommand──► p4runtime_ctrl ──Confirmation──► that app
    operators ──Instruction──► firewall ──Answer──► operators

Every message travels as the value of a DUE item: `to_value()` makes the map, `from_value()` checks one that
was received.  Times are capture time, integer nanoseconds since the epoch (UTC).

Received values are untrusted: they are decoded before any other code uses them, and decoders raise nothing
but `MessageError` (`apps.intake`).
"""

import ipaddress
import re
from collections.abc import Mapping
from typing import Annotated, Any, Final, Literal, Self

import msgspec
from msgspec import Meta

from apps.intake import Cause as Cause  # noqa: PLC0414 - part of the contract that is imported from here
from apps.intake import Intake as Intake  # noqa: PLC0414 - part of the contract that is imported from here
from apps.intake import MessageError as MessageError  # noqa: PLC0414 - part of the contract that is imported from here
from apps.intake import as_map
from apps.intake import one_line as one_line  # noqa: PLC0414 - part of the contract that is imported from here
from due import Engine, Item

LONGEST_BLOCK_S: Final = 30 * 86_400
"""The longest block that people may ask for."""
LATEST_NS: Final = 1 << 62
"""No time of a message is later (the year 2116), so that lengths of time can be added to it."""
Time = Annotated[int, Meta(ge=0, le=LATEST_NS)]
Number = Annotated[int, Meta(ge=0, le=(1 << 63) - 1)]
Port = Annotated[int, Meta(ge=0, le=65_535)]
Name = Annotated[str, Meta(max_length=256, pattern=r"^[^\x00-\x1f\x7f]*\Z")]
"""An identifier; no control characters, since it is shown and logged."""
Text = Annotated[str, Meta(max_length=65_536)]
"""Words for people; `one_line` before it is logged."""
Words = Annotated[str, Meta(max_length=4_096)]
"""Shorter, since it becomes a part of other texts."""
Rate = Annotated[float, Meta(ge=0, le=1e18)]

_MAC: Final = re.compile(r"[0-9a-fA-F]{2}(:[0-9a-fA-F]{2}){5}")
_PAGE: Final = 5_000
_WRITERS: Final = {"sonata": "sonata_adapter", "firewall_kept": "firewall"}
"""App segments of keys that are not the name of the app that writes them."""


def address_in(text: object, what: str) -> str:
    """Read an IP address.

    Args:
        text: IPv4 or IPv6 address as text.
        what: where it comes from, for the error message.

    Returns:
        The address in its canonical spelling.

    Raises:
        MessageError: it is not an IP address.
    """
    try:
        return str(ipaddress.ip_address(text if isinstance(text, str) else ""))
    except ValueError:
        raise MessageError("range", f"{what}: {str(text)[:80]!r} is not an IP address") from None


Role = Literal["host", "gateway", "dns", "dhcp", "multicast"]
Action = Literal["block", "unblock", "protect", "unprotect", "meter", "unmeter"]
TargetKind = Literal["ip", "mac"]
State = Literal["installed", "exists", "removed", "expired", "failed", "pending"]
"""Of a decision at an enforcer; `pending`: it keeps the decision, and carries it out as soon as it can."""


def writer_of(key: str) -> str:
    """The app that may write a key `network.<kind>.<app>.…`.

    Args:
        key: a key, with or without specs.

    Returns:
        The app id; empty if the key has fewer than three segments.
    """
    parts = key.partition(":")[0].split(".")
    named = parts[2] if len(parts) > 2 else ""
    return _WRITERS.get(named, named)


def sender_of(item: Item) -> str:
    """The app that wrote an item, which must be the one named in its key: `network.<kind>.<app>.…`.

    Args:
        item: a received item.

    Returns:
        The app's id.

    Raises:
        MessageError: another app wrote the item.
    """
    if item.app_id != writer_of(item.key):
        raise MessageError("sender", f"{item.key}: written by {item.app_id}, which is not the app of the key")
    return item.app_id


def read_latest(engine: Engine, query: Mapping[str, Any], since: int, most: int) -> list[Item]:
    """Read the latest matching items from the archive, page by page.

    Args:
        engine: of the app that asks.
        query: query in MongoDB's dialect.
        since: only items written after this time, ns since the epoch.
        most: number of items at most.

    Returns:
        Items, oldest first.
    """
    pages: list[list[Item]] = []
    left, before = most, (1 << 63) - 1
    while left > 0:
        asked = min(_PAGE, left)
        page = engine.get({**query, "timestamp": {"$gt": since, "$lt": before}}, limit=asked)
        if len(page) == asked and page[0].timestamp != page[-1].timestamp:
            # others of the oldest moment may be left: all of that moment come with the next page
            before = page[0].timestamp + 1
            page = [item for item in page if item.timestamp >= before]
        elif page:
            before = page[0].timestamp
        pages.append(page)
        left -= len(page)
        if not page or before <= since:
            break
    return [item for page in reversed(pages) for item in page]


class Message(msgspec.Struct, frozen=True, kw_only=True):
    """Base of all messages: checked when received, plain maps when sent."""

    def to_value(self) -> dict[str, Any]:
        """The message as a map of plain values, as `due.write` takes it.

        Returns:
            Field name to value.
        """
        value = msgspec.to_builtins(self)
        assert isinstance(value, dict)  # noqa: S101 - a Struct always becomes a map
        return value

    @classmethod
    def from_value(cls, value: object) -> Self:
        """Read a message from the value of an item.

        Args:
            value: a decoded value.

        Returns:
            The checked message.

        Raises:
            MessageError: the value is no such message; the text names the wrong field.
        """
        plain = as_map(value, cls.__name__)
        try:
            message = msgspec.convert(plain, cls)
        except (msgspec.ValidationError, RecursionError, OverflowError) as error:
            raise MessageError("fields", f"{cls.__name__}: {error}") from None
        message.check()
        return message

    @classmethod
    def from_item(cls, item: Item) -> Self:
        """Read the message in an item that the app of its key wrote.

        Args:
            item: a received item.

        Returns:
            The checked message.

        Raises:
            MessageError: another app wrote the item, or its value is no such message.
        """
        sender_of(item)
        return cls.from_value(item.value)

    def check(self) -> None:
        """Check what the types of the fields do not express; the base class checks nothing.

        Raises:
            MessageError: a field has an impossible value.
        """


class Sender(Message, frozen=True, kw_only=True):
    """Who sent a frame, as the switch saw it."""

    switch: Name
    port: Port
    mac: Name
    """Lower case, colons."""
    ip: Name = ""
    """IPv4 dotted or IPv6 compressed; empty for frames without an address."""

    def check(self) -> None:
        """Check the MAC address and, unless empty, the IP address.

        Raises:
            MessageError: one of them is not an address.
        """
        if not _MAC.fullmatch(self.mac):
            raise MessageError("range", f"sender: {self.mac[:80]!r} is not a MAC address")
        if self.ip:
            address_in(self.ip, "sender")


class Alert(Message, frozen=True, kw_only=True):
    """A sender had one more anomalous second."""

    id: Name
    sender: Sender
    event_time: Time
    """End of the anomalous second."""
    first_packet: Number
    """Arrival number at the switch of the first packet at or above the threshold in this second."""
    packets: Number
    """Packets in this second for which the sender is responsible."""
    over: Number
    """How many of them scored at or above the threshold."""
    peak_score: float
    anomalous_seconds: Number
    """Anomalous seconds among the last ten, this one included."""
    rate: Rate
    """Packets per second for which the sender is responsible, in this second."""
    training_rate: Rate
    """The highest rate of any second of training; 0 for a sender never seen in training."""
    mac_addresses: Number
    """How many IP addresses were seen behind the sender's MAC."""
    role: Role = "host"
    """Gateways, DNS, DHCP and multicast speakers alert but are not blocked unless configured."""
    reason: Words

    def check(self) -> None:
        """Check the sender.

        Raises:
            MessageError: an address is invalid.
        """
        self.sender.check()


class Target(Message, frozen=True, kw_only=True):
    """What a block matches: an address, or a MAC on a port of the switch."""

    kind: TargetKind
    address: Name
    port: Port | None = None

    def check(self) -> None:
        """Check that the address fits `kind`: an IP address or prefix, or a MAC address.

        Raises:
            MessageError: it does not.
        """
        if self.kind == "mac":
            if not _MAC.fullmatch(self.address):
                raise MessageError("range", f"target: {self.address[:80]!r} is not a MAC address")
            return
        try:
            ipaddress.ip_network(self.address)
        except ValueError:
            raise MessageError(
                "range", f"target: {self.address[:80]!r} is not an IP address or prefix"
            ) from None


class Exhibit(Message, frozen=True, kw_only=True):
    """An archived item that supports a decision."""

    key: Annotated[str, Meta(max_length=4096)]
    timestamp: Number
    """`timestamp` of the item in Data Archives, so that it can be found again."""
    summary: Text


class Ground(Message, frozen=True, kw_only=True):
    """A kind of evidence that a decision is based on: the unit in which false alarms are taught."""

    source: Name
    """`<app>.<source>` of the evidence."""
    sender: Sender | None = None
    victim: Name = ""
    """Where the evidence names no service, or accuses nobody by name."""
    service: Annotated[str, Meta(max_length=32)] = ""
    """`tcp/445`, `udp/ephemeral`; empty if the evidence is about no single service."""
    nats: Annotated[float, Meta(ge=0, le=1e12)] = 0.0
    """What it had added when the decision was made."""

    def check(self) -> None:
        """Check the sender.

        Raises:
            MessageError: an address is invalid.
        """
        if self.sender is not None:
            self.sender.check()


MOST_GROUNDS: Final = 8

FloodKind = Literal["udp", "udp_from", "udp_to", "tcp", "syn", "icmp"]
"""Datagrams; those from a port, as reflectors send them; those to a port; TCP segments to a port that are no SYNs; SYNs
to all ports but some; and echo requests."""
MOST_OPEN_PORTS: Final = 16
"""Ports that a rate limit of SYNs leaves alone."""
MOST_SPARED: Final = 64
"""Sources that a rate limit names; evidence names no more."""


class RateLimit(Message, frozen=True, kw_only=True):
    """The rate at which packets of one kind may reach a victim; packets above it are dropped.

    Source: RFC 8955 (FlowSpec), `traffic-rate-packets`.
    """

    kind: FloodKind
    port: Port | None = None
    """The source port of `udp_from`, the destination port of `udp_to` and `tcp`; None for others."""
    open_ports: Annotated[tuple[Port, ...], Meta(max_length=MOST_OPEN_PORTS)] = ()
    """Destination ports that `syn` does not limit: services of the victim; empty for others."""
    rate: Annotated[int, Meta(ge=1, le=1 << 31)]
    """Packets per second of all sources together that may pass."""
    spared: Annotated[tuple[Name, ...], Meta(max_length=MOST_SPARED)] = ()
    """Sources that training knows: beyond the limit each of them has `spared_rate` of its own."""
    spared_rate: Annotated[int, Meta(ge=1, le=1 << 31)] = 1
    """Packets per second."""

    def check(self) -> None:
        """Check that the kind has its ports, and the addresses of spared sources.

        Raises:
            MessageError: it has none, or one too many; or an address is invalid.
        """
        if (self.port is None) != (self.kind in ("udp", "syn", "icmp")):
            raise MessageError("fields", f"rate limit of {self.kind}: port {self.port} does not fit")
        if self.open_ports and self.kind != "syn":
            raise MessageError("fields", f"rate limit of {self.kind}: it has no open ports")
        for source in self.spared:
            address_in(source, "rate limit")

    @property
    def words(self) -> str:
        """What it matches, in words."""
        return {
            "udp": "UDP",
            "udp_from": f"UDP from port {self.port}",
            "udp_to": f"UDP to port {self.port}",
            "tcp": f"TCP to port {self.port} but SYNs",
            "syn": f"SYNs{self._but_open_ports}",
            "icmp": "ICMP echo requests",
        }[self.kind]

    @property
    def _but_open_ports(self) -> str:
        if not self.open_ports:
            return ""
        ports = ", ".join(map(str, self.open_ports))
        return f" to ports other than {ports}"


class Decision(Message, frozen=True, kw_only=True):
    """What the firewall wants the switch to do, and why."""

    id: Name
    action: Action
    switch: Name
    target: Target
    reason: Text
    evidence: Annotated[tuple[Exhibit, ...], Meta(max_length=1000)] = ()
    event_time: Time
    expires: Time
    """0 = never."""
    level: Annotated[int, Meta(ge=0, le=1000)] = 0
    """Escalation step: 0 for a first offence."""
    dry_run: bool = False
    first_packet: Number = 0
    """Arrival number of the packet that led to the decision."""
    grounds: Annotated[tuple[Ground, ...], Meta(max_length=MOST_GROUNDS)] = ()
    """The evidence that added up to it, the strongest first; empty where something else decided."""
    limit: RateLimit | None = None
    """What `meter` and `unmeter` are about: a kind of packets towards the target; None for other actions."""
    training_rate: Rate | None = None
    """Packets per second of the blocked sender in training, 0 where a block does not depend on it; None: not known."""
    host: Name = ""
    """The address behind a blocked MAC, if it is known."""

    def check(self) -> None:
        """Check target, grounds and rate limit.

        Raises:
            MessageError: an address is invalid, or a rate limit is missing or one too many.
        """
        self.target.check()
        for ground in self.grounds:
            ground.check()
        if (self.limit is not None) != (self.action in ("meter", "unmeter")):
            raise MessageError("fields", f"{self.action} of {self.target.address}: limit does not fit")
        if self.limit is not None:
            self.limit.check()
            if self.target.kind != "ip" or self.target.port is not None:
                raise MessageError("fields", "a rate limit's target is an IP address or prefix")

    @property
    def doing(self) -> str:
        """The action in words, `would …` where it is a dry run."""
        words = {"meter": "rate limit", "unmeter": "lift rate limit"}.get(self.action, self.action)
        return f"would {words}" if self.dry_run else words

    @property
    def what(self) -> str:
        """What it is about, in words: the target, its port, and the packets of a rate limit."""
        port = "" if self.target.port is None else f" port {self.target.port}"
        return f"{self.target.address}{port}" + (f" ({self.limit.words})" if self.limit is not None else "")


class FalseAlarm(Message, frozen=True, kw_only=True):
    """`network.false_alarm.firewall.<change>`: what an operator has taught about a decision, or revoked."""

    id: Name
    """The decision's."""
    grounds: Annotated[tuple[Ground, ...], Meta(max_length=MOST_GROUNDS)]
    """Evidence that counts less from now on."""
    event_time: Time
    """Capture time at which the operator said so, ns."""
    expires: Time
    """Capture time from which the evidence counts in full again, ns."""
    reason: Words = ""
    revoked: bool = False

    def check(self) -> None:
        """Check the grounds.

        Raises:
            MessageError: an address is invalid.
        """
        for ground in self.grounds:
            ground.check()


class Confirmation(Message, frozen=True, kw_only=True):
    """The outcome of a decision or command at the switch."""

    id: Name
    """The id of the decision or command."""
    switch: Name
    state: State
    action: Name
    target: Target | None = None
    handle: Text = ""
    """The entry as the switch knows it: table and match, e.g. `ingress.block_mac[port=1,mac=..]`."""
    cause: Text = ""
    event_time: Time
    arrival: Number = 0
    """Arrival number of the newest packet that the controller had seen when the switch answered."""


class Instruction(Message, frozen=True, kw_only=True):
    """`network.instruction.<app>.firewall`: what an operator asks the firewall to do."""

    id: Name
    verb: Literal["block", "unblock", "allow", "disallow", "panic", "false_alarm", "revoke"]
    """`false_alarm` and `revoke` are accepted from operators only: the command line and the dashboard."""
    subject: Name = ""
    """An address or MAC to block; a decision's id or an address to unblock; an allow-list entry; the id of a decision
    that was a false alarm."""
    reason: Words = ""
    seconds: Annotated[int, Meta(ge=1, le=LONGEST_BLOCK_S)] = 600
    """Length of a block."""
    expires: int = 0
    """Wall time, ns since the epoch, after which it must not be carried out any more; 0 = never."""


class Answer(Message, frozen=True, kw_only=True):
    """`network.answer.firewall.<app>`: the outcome of an instruction."""

    id: Name
    """The instruction's."""
    done: bool
    text: Text


class TableUpdate(Message, frozen=True, kw_only=True):
    """One table update by name; checked by the controller against p4info."""

    kind: Literal["insert", "modify", "delete"]
    table: Name
    match: Annotated[dict[str, Any], Meta(max_length=64)] = {}
    """Field name to value: int, str address, `[value, mask]`, `[value, prefix length]` or `[low, high]`."""
    action: Name = ""
    params: Annotated[dict[str, Any], Meta(max_length=64)] = {}
    priority: Annotated[int, Meta(ge=0, le=(1 << 31) - 1)] = 0
    idle_timeout_ns: Time = 0


class TableCommand(Message, frozen=True, kw_only=True):
    """`network.p4_command.<app>.<switch>`: any table update, confirmed under the same id."""

    id: Name
    updates: Annotated[tuple[TableUpdate, ...], Meta(max_length=20_000)]
    requests: Annotated[tuple[dict[str, Any], ...], Meta(max_length=1_024)] = ()
    """Packet requests, each as under `network.telemetry.<app>.<name>`: those that end do so before the updates, the
    others begin or change after them."""
