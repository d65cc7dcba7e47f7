"""What the network apps say to each other: alerts, decisions, commands and confirmations.

    kitsune ──Alert──► firewall ──Decision──► p4runtime_ctrl ──Confirmation──► firewall, reports
    any app ──TableCommand──► p4runtime_ctrl ──Confirmation──► that app
    people ──Instruction──► firewall ──Answer──► people

Every message travels as the value of a DUE item: `to_value()` makes the map, `from_value()` checks
one that came from the wire.  Times are capture time, integer nanoseconds since the epoch (UTC).
"""

from typing import Any, Literal, Self

import msgspec

Role = Literal["host", "gateway", "dns", "dhcp", "multicast"]
Action = Literal["block", "unblock", "protect", "unprotect"]
TargetKind = Literal["ip", "mac"]
State = Literal["installed", "exists", "removed", "expired", "failed"]


class Message(msgspec.Struct, frozen=True, kw_only=True):
    """Base of all messages: checked on the way in, plain maps on the way out."""

    def to_value(self) -> dict[str, Any]:
        """The message as a map of plain values, fit for `due.write`."""
        value = msgspec.to_builtins(self)
        assert isinstance(value, dict)  # noqa: S101 - a Struct always becomes a map
        return value

    @classmethod
    def from_value(cls, value: object) -> Self:
        """Read a message from a DUE value; raises `msgspec.ValidationError` naming the wrong field."""
        return msgspec.convert(value, cls)


class Sender(Message, frozen=True, kw_only=True):
    """Who sent a frame, as the switch saw it."""

    switch: str
    port: int
    mac: str
    """Lower case, colons."""
    ip: str = ""
    """IPv4 dotted or IPv6 compressed; empty for frames without an address."""


class Alert(Message, frozen=True, kw_only=True):
    """A sender was anomalous for one more second of capture time (a 'hot' second)."""

    id: str
    sender: Sender
    event_time: int
    """End of the hot second."""
    first_packet: int
    """Arrival number at the switch of the first packet over the line in this second."""
    packets: int
    """Packets charged to the sender in this second."""
    over: int
    """How many of them scored over the line."""
    peak_score: float
    hot_seconds: int
    """Hot seconds among the last ten, this one included."""
    rate: float
    """Packets a second charged to the sender in this second."""
    training_rate: float
    """The highest rate of any second of training; 0 for a sender never seen in training."""
    mac_addresses: int
    """How many IP addresses were seen behind the sender's MAC."""
    role: Role = "host"
    """Gateways, DNS, DHCP and multicast speakers alert but are not blocked unless configured."""
    reason: str


class Target(Message, frozen=True, kw_only=True):
    """What a block matches: an address, or a MAC on a port of the switch."""

    kind: TargetKind
    address: str
    port: int | None = None


class Evidence(Message, frozen=True, kw_only=True):
    """An archived item that a decision rests on."""

    key: str
    timestamp: int
    """`timestamp` of the item in Data Archives, so that it can be found again."""
    summary: str


class Decision(Message, frozen=True, kw_only=True):
    """What the firewall wants the switch to do, and why."""

    id: str
    action: Action
    switch: str
    target: Target
    reason: str
    evidence: tuple[Evidence, ...] = ()
    event_time: int
    expires: int
    """0 = never."""
    level: int = 0
    """Escalation step: 0 for a first offence."""
    dry_run: bool = False
    first_packet: int = 0
    """Arrival number of the packet that tipped the scales."""


class Confirmation(Message, frozen=True, kw_only=True):
    """What became of a decision or command in the switch."""

    id: str
    """The id of the decision or command."""
    switch: str
    state: State
    action: str
    target: Target | None = None
    handle: str = ""
    """The entry as the switch knows it: table and match, e.g. `ingress.block_mac[port=1,mac=..]`."""
    cause: str = ""
    event_time: int
    arrival: int = 0
    """Arrival number of the newest packet that the controller had seen when the switch answered."""


class Instruction(Message, frozen=True, kw_only=True):
    """`network.instruction.<app>.firewall`: what a person wants of the firewall."""

    id: str
    verb: Literal["block", "unblock", "allow", "disallow", "panic"]
    subject: str = ""
    """An address or MAC to block; a decision's id or an address to unblock; an allow-list entry."""
    reason: str = ""
    seconds: int = 600
    """Length of a block."""


class Answer(Message, frozen=True, kw_only=True):
    """`network.answer.firewall.<app>`: what became of an instruction."""

    id: str
    """The instruction's."""
    done: bool
    text: str


class TableUpdate(Message, frozen=True, kw_only=True):
    """One table update by name; checked by the controller against p4info."""

    kind: Literal["insert", "modify", "delete"]
    table: str
    match: dict[str, Any] = {}
    """Field name to value: int, str address, `[value, mask]`, `[value, prefix length]` or `[low, high]`."""
    action: str = ""
    params: dict[str, Any] = {}
    priority: int = 0
    idle_timeout_ns: int = 0


class TableCommand(Message, frozen=True, kw_only=True):
    """`network.p4_command.<app>.<switch>`: any table update, confirmed under the same id."""

    id: str
    updates: tuple[TableUpdate, ...]
