"""ARP packets → decisions: who claims an address that belongs to another, who is present, is blocked by MAC and port."""

from collections.abc import Callable, Collection
from typing import Literal

from apps.firewall.arp.arp_bindings import ArpBindings, BindingConflict
from apps.firewall.arrivals import evidence_of
from apps.firewall.enforcement.announcer import Announcer
from apps.firewall.policy.block_lifecycle import BlockLifecycle, OperatorNotice
from apps.firewall.policy.rules import AllowList
from apps.messages import Decision, Target
from due import Item, RecordBatch


class TheftHandler:
    """Blocks hosts that take over addresses, or reports them.

    Args:
        mode: `tell`: nobody is blocked.
        bindings: which address is whose.
        lifecycle: blocks in force.
        announcer: notices.
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
        allowed: Callable[[], AllowList],
        switches: Collection[str],
        publish: Callable[[Decision], Decision],
    ) -> None:
        self._mode = mode
        self._bindings = bindings
        self._lifecycle = lifecycle
        self._announcer = announcer
        self._allowed = allowed
        self._switches = switches
        self._publish = publish
        self.thefts = 0

    def arps(self, item: Item, batch: RecordBatch) -> None:
        """ARP packets of a switch."""
        for theft in self._bindings.add(batch):
            self.thefts += 1
            self._on_theft(theft, item)

    def _on_theft(self, theft: BindingConflict, item: Item) -> None:
        thief, owner = theft.thief, theft.owner
        summary = f"{thief.text} on port {thief.port} claims {theft.address}, which is {owner.text} on port {owner.port}"
        target = Target(kind="mac", address=thief.text, port=thief.port)
        spared = self._why_spared(theft, target)
        if spared:
            self._announcer.say(OperatorNotice("arp", f"{summary}; not blocked: {spared}", theft.at))
        elif not any(block.decision.target == target for block in self._lifecycle.blocks.values()):
            where, why = next(iter(self._switches)), f"{summary}, and is there"
            self._publish(self._lifecycle.open(where, target, why, (evidence_of(item, summary),), theft.at))

    def _why_spared(self, theft: BindingConflict, target: Target) -> str:
        """Why the claimant of an address is not blocked; empty if it is."""
        if self._mode == "tell":
            return 'the setting `arp` is "tell"'
        if not theft.certain:
            return "the owner was not present in training, or other hosts share the claimant's port"
        if len(self._switches) != 1:
            return f"{len(self._switches)} switches are connected, and records do not say which"
        allow = self._allowed()
        mine = self._bindings.addresses_of(theft.thief)
        if allow.covers_target(target) or any(allow.covers_address(each) for each in mine):
            return "it is on the allow-list"
        cap = self._lifecycle.cap_reached(theft.at)
        if cap:
            self._lifecycle.refuse(cap, target.address, theft.at)
        return cap or ""
