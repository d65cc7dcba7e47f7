"""What enforcers hear and say: the contract between the firewall and everything that can stop packets.

    firewall ──Decision──────────────► every enforcer    network.block.firewall.*, network.block_prefix.firewall.*
    firewall ──AllowedEntries────────► every enforcer    network.allowed.firewall
    enforcer ──Confirmation──────────► firewall, page    network.confirmation.<enforcer>.<place>
    enforcer ──EnforcementReport─────► firewall, page    network.enforced.<enforcer>.<place>

An enforcer adds and removes blocks, lists what really stands (read back, not remembered), confirms each decision
under its id, and ends a block when it expires even without being told.  A *place* is where it does so: a switch, a host.
The P4Runtime controller speaks the same contract; its report is the state of the switch
(`network.switch.p4runtime_ctrl.<switch>`), and a block there ends by the firewall's word.
"""

from typing import Annotated, Final

from msgspec import Meta

from apps.messages import Message, Name, Number, Target, Text, Time

ENFORCED: Final = "network.enforced"
"""`<ENFORCED>.<enforcer>.<place>`"""
CONFIRMED: Final = "network.confirmation"
"""`<CONFIRMED>.<enforcer>.<place>`"""
ALLOWED: Final = "network.allowed.firewall"
SWITCHES: Final = "p4runtime_ctrl"
"""The enforcer that is always there: the controller of the switches."""
MOST_ENTRIES: Final = 20_000
MOST_HELD: Final = 65_536
"""Blocks that one enforcer holds at most."""


class AllowedEntries(Message, frozen=True, kw_only=True):
    """`network.allowed.firewall`: the whole allow-list, written at the start and whenever it changes."""

    entries: Annotated[tuple[Name, ...], Meta(max_length=MOST_ENTRIES)] = ()
    """Addresses, prefixes and MACs."""


class HeldBlock(Message, frozen=True, kw_only=True):
    """A block in force, as read back."""

    id: Name
    """The decision's."""
    target: Target
    packets: Number = 0
    """Packets that it has dropped; 0 where the enforcer does not count."""
    bytes: Number = 0


class EnforcementReport(Message, frozen=True, kw_only=True):
    """`network.enforced.<enforcer>.<place>`: what is in force there; written when it changes, and every ten seconds."""

    enforcer: Name
    place: Name
    working: bool
    problem: Text = ""
    """Why it does not work, or what was found and repaired; empty: nothing."""
    blocks: Annotated[tuple[HeldBlock, ...], Meta(max_length=MOST_HELD)] = ()
    waiting: Number = 0
    """Decisions that are not carried out yet."""
    restored: Number = 0
    """Blocks that somebody else had removed, and that were put back."""
    event_time: Time
    """Wall time, ns: enforcers see no packets."""


def place_text(enforcer: str, place: str) -> str:
    """Name an enforcer and its place for people.

    Args:
        enforcer: app id.
        place: where it carries out decisions.

    Returns:
        Both, such as `nftables gateway`.
    """
    return f"{enforcer} {place}"
