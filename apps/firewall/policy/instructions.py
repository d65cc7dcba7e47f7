"""Instructions of operators: block, unblock, allow, disallow, panic, false alarm, revoke.  Pure."""

import ipaddress
from collections.abc import Callable, Iterable
from typing import Final

from apps.firewall.evidence.history import allowed_by
from apps.firewall.policy.block_lifecycle import BlockLifecycle
from apps.firewall.policy.false_alarms import FalseAlarms
from apps.firewall.policy.rate_limits import RateLimits
from apps.firewall.policy.rules import AllowList, is_mac
from apps.firewall.syn.syn_defence import EVERY_SWITCH, SynDefence
from apps.messages import Answer, Decision, Exhibit, Instruction, Target

_MOST_ENTRIES = 10_000
_MOST_PORT = 65_535
OPERATORS: Final = ("operator", "dashboard")
"""Apps that speak for people: the command line and the page."""
_TEACHING: Final = ("false_alarm", "revoke")
"""Verbs that weaken what is decided later, so that no other app may use them."""
Outcome = tuple[list[Decision], Answer]


class Desk:
    """Applies instructions to blocks, guards, rate limits, the allow-list and lessons; time is capture time in ns.

    Args:
        lifecycle: blocks in force.
        syn: guards in force.
        limits: rate limits in force.
        entries: the allow-list of the settings.
        lessons: what was called a false alarm.
        archived: looks a decision up that is not in force; None if there is none.
    """

    def __init__(
        self,
        lifecycle: BlockLifecycle,
        syn: SynDefence,
        limits: RateLimits,
        entries: Iterable[str],
        lessons: FalseAlarms,
        archived: Callable[[str], Decision | None] = lambda _: None,
    ) -> None:
        self._lifecycle = lifecycle
        self._syn = syn
        self._limits = limits
        self._lessons = lessons
        self._archived = archived
        self.entries = tuple(entries)
        self.allow = AllowList.parse(self.entries)

    def take_up(self, instructions: Iterable[Instruction]) -> None:
        """Restore the allow-list from before a restart; refused instructions are in the archive, too."""
        self._set_entries(tuple(filter(_is_entry, allowed_by(instructions, self.entries))))

    def carry_out(self, instruction: Instruction, evidence: Exhibit, now: int) -> Outcome:
        """Decisions to publish, and the answer; a refused instruction changes nothing."""
        try:
            decisions, text = getattr(self, f"_{instruction.verb}")(instruction, evidence, now)
        except ValueError as error:
            return [], Answer(id=instruction.id, done=False, text=str(error))
        return decisions, Answer(id=instruction.id, done=True, text=text)

    def take_back(self, decisions: Iterable[Decision]) -> None:
        """Forget blocks that could not be published: nobody carries them out."""
        for each in decisions:
            if each.action == "block":
                self._lifecycle.lift(each.id, each.event_time, "")

    def decided_before(self, instruction: Instruction, evidence: Exhibit) -> Answer | None:
        """The answer to an instruction whose block stands: the firewall was killed before it could answer."""
        if instruction.verb == "block":
            for block in self._lifecycle.blocks.values():
                if evidence in block.decision.evidence:
                    text = f"block {block.decision.id} of {instruction.subject}, decided before a restart"
                    return Answer(id=instruction.id, done=True, text=text)
        return None

    def _block(self, instruction: Instruction, evidence: Exhibit, now: int) -> tuple[list[Decision], str]:
        target = target_in(instruction.subject)
        if self.allow.covers_target(target):
            raise ValueError(
                f"{target.address} is on the allow-list, which always wins; take it off with `sdnator allow remove` first"
            )
        if len(self._lifecycle.blocks) >= self._lifecycle.rules.max_blocks:
            raise ValueError(
                f"{len(self._lifecycle.blocks)} blocks are in force (max_blocks); lift some first"
            )
        if self._lifecycle.matching(target.address):
            raise ValueError(f"{target.address} is already blocked")
        reason = f"by hand: {instruction.reason or 'no reason given'}"
        decision = self._lifecycle.open(
            EVERY_SWITCH, target, reason, (evidence,), now, seconds=instruction.seconds
        )
        return [decision], f"block {decision.id} of {target.address} for {instruction.seconds} s"

    def _unblock(self, instruction: Instruction, _: Exhibit, now: int) -> tuple[list[Decision], str]:
        found = self._lifecycle.matching(instruction.subject)
        others = self._syn.release(instruction.subject, now, "by hand")
        others += self._limits.release(instruction.subject, now, "by hand")
        if not found and not others:
            raise ValueError(
                f"no block, guard or rate limit has the id or address {instruction.subject}; "
                "see `sdnator blocks list`; guards that the settings name stay"
            )
        return self._lift(found, now, "by hand") + others, f"{len(found) + len(others)} lifted"

    def _false_alarm(self, instruction: Instruction, _: Exhibit, now: int) -> tuple[list[Decision], str]:
        """Undo a decision, and learn that its evidence means less."""
        name = instruction.subject
        found = self._lifecycle.matching(name)
        names = [each.id for each in found] or [name]
        if not found and (past := self._archived(name)) is not None:
            self._lessons.decided(past)
        elif not found and not self._syn.holds(name) and not self._limits.holds(name):
            raise ValueError(f"no decision has the id {name}; see `sdnator blocks list --all`")
        taught = [
            self._lessons.teach(each, grounds, now, instruction.reason)
            for each in names
            if (grounds := self._lessons.grounds_of(each))
        ]
        reason = "a false alarm"
        decisions = self._lift(found, now, reason) + self._syn.release(name, now, reason)
        decisions += self._limits.release(name, now, reason)
        kinds = sorted({ground.source for lesson in taught for ground in lesson.grounds})
        learnt = (
            f"{', '.join(kinds)} of this sender counts a tenth from now on"
            if kinds
            else "nothing is learnt, since no evidence was added up; `sdnator allow add` spares the sender"
        )
        return decisions, f"{len(decisions)} lifted; {learnt}"

    def _revoke(self, instruction: Instruction, _: Exhibit, now: int) -> tuple[list[Decision], str]:
        lesson = self._lessons.revoke(instruction.subject, now)
        kinds = sorted({ground.source for ground in lesson.grounds})
        return [], f"{', '.join(kinds)} counts in full again; the decision itself is not restored"

    def _panic(self, _: Instruction, __: Exhibit, now: int) -> tuple[list[Decision], str]:
        blocks = [block.decision for block in self._lifecycle.blocks.values()]
        decisions = self._lift(blocks, now, "panic: everything is lifted")
        decisions += self._syn.release_all(now, "panic: everything is lifted")
        decisions += self._limits.release_all(now, "panic: everything is lifted")
        return decisions, f"{len(decisions)} lifted; guards that the settings name stay"

    def _allow(self, instruction: Instruction, _: Exhibit, now: int) -> tuple[list[Decision], str]:
        if len(self.entries) >= _MOST_ENTRIES:
            raise ValueError(f"the allow-list has {_MOST_ENTRIES} entries; remove some, or name prefixes")
        self._set_entries((*self.entries, instruction.subject))
        blocks = [block.decision for block in self._lifecycle.blocks.values()]
        touched = [each for each in blocks if self.spares(each)]
        lifted = self._lift(touched, now, f"{instruction.subject} is on the allow-list now")
        blocks_lifted = "1 block" if len(lifted) == 1 else f"{len(lifted)} blocks"
        return lifted, f"{instruction.subject} is allowed; {blocks_lifted} lifted"

    def _disallow(self, instruction: Instruction, _: Exhibit, __: int) -> tuple[list[Decision], str]:
        if instruction.subject not in self.entries:
            raise ValueError(
                f"{instruction.subject} is not on the allow-list: {', '.join(self.entries) or 'empty'}"
            )
        self._set_entries(tuple(each for each in self.entries if each != instruction.subject))
        return [], f"{instruction.subject} is no longer allowed"

    def spares(self, decision: Decision) -> bool:
        """Whether the allow-list covers what a block matches, or the address of the host whose MAC it matches."""
        host = decision.host if decision.target.kind == "mac" else ""
        return self.allow.covers_target(decision.target) or (bool(host) and self.allow.covers_address(host))

    def _lift(self, decisions: Iterable[Decision], now: int, reason: str) -> list[Decision]:
        lifted = (self._lifecycle.lift(each.id, now, reason) for each in decisions)
        return [each for each in lifted if each is not None]

    def _set_entries(self, entries: tuple[str, ...]) -> None:
        self.allow = self._syn.allow = AllowList.parse(entries)
        self.entries = tuple(dict.fromkeys(entries))


def refused_as_late(instruction: Instruction, wall_ns: int) -> Answer | None:
    """The answer to an instruction that is too old; None if it may be carried out."""
    if not 0 < instruction.expires < wall_ns:
        return None
    late = (wall_ns - instruction.expires) / 1e9
    text = f"came {late:.0f} s after its end and was not carried out; ask again (are both clocks right?)"
    return Answer(id=instruction.id, done=False, text=text)


def refused_as_foreign(instruction: Instruction, app: str) -> Answer | None:
    """The answer to an app that wants to teach; None if it may say what it says."""
    if instruction.verb not in _TEACHING or app in OPERATORS:
        return None
    text = f"{app} may not say so: only operators can call something a false alarm, with `sdnator` or on the dashboard"
    return Answer(id=instruction.id, done=False, text=text)


def _is_entry(text: str) -> bool:
    try:
        AllowList.parse((text,))
    except ValueError:
        return False
    return True


def target_in(text: str) -> Target:
    """An address, prefix, MAC or MAC@PORT as a target; raises ValueError that names the valid forms."""
    mac, _, port = text.partition("@")
    if is_mac(mac) and (port.isdecimal() or text == mac):
        if port and int(port) > _MOST_PORT:
            raise ValueError(f"{text!r}: a port of a switch is a number up to {_MOST_PORT:,}")
        return Target(kind="mac", address=mac.lower(), port=int(port) if port else None)
    try:
        if "/" not in text:
            return Target(kind="ip", address=str(ipaddress.ip_address(text)))
        network = ipaddress.ip_network(text, strict=False)
    except ValueError:
        raise ValueError(f"{text!r} is not an IP address, prefix or MAC address") from None
    alone = network.num_addresses == 1
    return Target(kind="ip", address=str(network.network_address if alone else network))
