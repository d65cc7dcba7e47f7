"""ARP packets → evidence → decisions: who claims the address of another, who is present, is blocked by MAC and port."""

from collections.abc import Callable, Collection
from typing import Literal

from apps.evidence import Evidence
from apps.firewall.arp.arp_bindings import ArpBindings, BindingConflict
from apps.firewall.arrivals import evidence_of
from apps.firewall.enforcement.announcer import Announcer
from apps.firewall.evidence.own_evidence import OwnEvidence
from apps.firewall.evidence.shared import shared_sender
from apps.firewall.policy.block_lifecycle import BlockLifecycle, OperatorNotice
from apps.firewall.policy.rules import AllowList
from apps.firewall.syn.syn_defence import EVERY_SWITCH
from apps.messages import Decision, Sender, Target
from due import Item, RecordBatch


class TheftHandler:
    """Blocks hosts that take over addresses, or reports them.

    Args:
        mode: `tell`: nobody is blocked.
        bindings: which address is whose.
        lifecycle: blocks in force.
        announcer: notices.
        own: writes what decides as evidence.
        allowed: the allow-list in force.
        switches: names of connected switches.
        publish: writes a decision.
    """

    def __init__(
        self,
        mode: Literal["off", "tell", "block"],
        bindings: ArpBindings,
        lifecycle: BlockLifecycle,
        announcer: Announcer,
        own: OwnEvidence,
        allowed: Callable[[], AllowList],
        switches: Collection[str],
        publish: Callable[[Decision], Decision],
    ) -> None:
        self._mode = mode
        self._bindings = bindings
        self._lifecycle = lifecycle
        self._announcer = announcer
        self._own = own
        self._allowed = allowed
        self._switches = switches
        self._publish = publish
        self._found = 0

    def arps(self, item: Item, batch: RecordBatch) -> None:
        """ARP packets of a switch."""
        for theft in self._bindings.add(batch):
            self._found += 1
            self._on_theft(theft, item)

    def health(self) -> dict[str, int]:
        """Counters for the operator and for Prometheus."""
        return {"arp_thefts": self._found, "bindings": len(self._bindings)}

    def _on_theft(self, theft: BindingConflict, item: Item) -> None:
        switch = next(iter(self._switches)) if len(self._switches) == 1 else EVERY_SWITCH
        addresses = self._bindings.addresses_of(theft.thief)
        nats = self._own.bound if theft.certain else 0.0
        evidence, news = self._own.found(theft_evidence(theft, switch, len(addresses), nats))
        thief = evidence.sender
        assert thief is not None  # noqa: S101 - theft_evidence names it
        target = Target(kind="mac", address=thief.mac, port=thief.port)
        spared = self._why_spared(evidence, target, addresses)
        blocked = any(block.decision.target == target for block in self._lifecycle.blocks.values())
        if news or not (spared or blocked):
            self._own.tell(evidence)
        if spared and (
            news or theft.thief.mac != theft.owner.mac
        ):  # a host that moves to and fro is told once
            self._announcer.say(
                OperatorNotice("arp", f"{evidence.text}; not blocked: {spared}", evidence.event_time)
            )
            if news and not evidence.supporting:
                self._own.spared(evidence, spared)
        elif not (spared or blocked):
            exhibits = (evidence_of(item, evidence.text),)
            self._publish(
                self._lifecycle.open(thief.switch, target, evidence.text, exhibits, evidence.event_time)
            )

    def _why_spared(self, evidence: Evidence, target: Target, addresses: Collection[str]) -> str:
        """Why the claimant of an address, who has others of its own, is not blocked; empty if it is."""
        if self._mode == "tell":
            return 'the setting `arp` is "tell"'
        if evidence.supporting:
            return (
                "the owner was not on this port in training, the claimant has the owner's MAC, "
                "or other hosts share the claimant's port"
            )
        if len(self._switches) != 1:
            return f"{len(self._switches)} switches are connected, and records do not say which"
        allow = self._allowed()
        if allow.covers_target(target) or any(allow.covers_address(each) for each in addresses):
            return "it is on the allow-list"
        cap = self._lifecycle.cap_reached(evidence.event_time)
        if cap:
            self._lifecycle.refuse(cap, target.address, evidence.event_time)
        return cap or ""


def theft_evidence(theft: BindingConflict, switch: str, addresses: int, nats: float) -> Evidence:
    """A claim of another's address as evidence.

    Args:
        theft: the claim, and that the owner is present.
        switch: where; `*` if it is not known.
        addresses: number of addresses that belong to the claimant.
        nats: what the claim proves by itself; 0 if it is not certain who the attacker is.
    """
    thief, owner = theft.thief, theft.owner
    return Evidence(
        id=f"firewall-spoofing-{theft.at}-{thief.mac:012x}-{theft.address}",
        kind="spoofing",
        source="spoofing",
        sender=shared_sender(Sender(switch=switch, port=thief.port, mac=thief.text)),
        forgeable=not theft.thief_alone,
        forged=True,
        supporting=not theft.certain,
        victims=(theft.address,),
        victim_count=1,
        service="arp",
        nats=nats,
        since=min(theft.claimed, theft.at),
        event_time=theft.at,
        packets=1,
        mac_addresses=addresses,
        text=f"{thief.text} on port {thief.port} claims {theft.address}, which belongs to {owner.text} on port {owner.port}, "
        "and that host is present",
    )
