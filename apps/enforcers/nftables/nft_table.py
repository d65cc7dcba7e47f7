"""Our table in the kernel: written in transactions, read back, made anew when somebody has changed it.  I/O."""

import logging
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Final, Literal

from apps.enforcers.desired_blocks import DesiredBlock
from apps.enforcers.enforcer import EnforcerAway, HeldCount
from apps.enforcers.nftables.nft_program import NftProgram, TransactionRefused
from apps.enforcers.nftables.ruleset import (
    Element,
    TableListing,
    TablePlan,
    element_of,
    elements_of,
    listing_in,
    outermost,
)

AtEnd = Literal["keep", "remove"]
_NONE: Final = HeldCount()

log = logging.getLogger(__name__)


class NftTable:
    """An `Enforcer`: one table of this network namespace.

    Args:
        plan: name and place of the table.
        program: runs nft.
        at_end: what becomes of the table when the app ends in order.
    """

    def __init__(self, plan: TablePlan, program: NftProgram, at_end: AtEnd = "keep") -> None:
        self._plan = plan
        self._nft = program
        self._at_end: AtEnd = at_end
        self._desired: dict[str, DesiredBlock] = {}
        self._allowed: tuple[str, ...] | None = None
        """None: history is unknown, and what stands is not to be made anew."""
        self._shape: str | None = None
        """As it was right after it was made; None: it is to be made."""
        self._before: dict[Element, HeldCount] = {}
        """What elements had counted before they were made anew."""

    def change(self, add: Sequence[DesiredBlock], remove: Sequence[DesiredBlock]) -> Mapping[str, str]:
        """Add and remove in one transaction; nothing is refused for good."""
        wanted = {**self._desired, **{desired_block.id: desired_block for desired_block in add}}
        for desired_block in remove:
            wanted.pop(desired_block.id, None)
        old, new = elements_of(self._desired.values()), elements_of(wanted.values())
        if self._allowed is None:
            self._amend(old, new, {element_of(desired_block.target) for desired_block in remove})
        elif self._shape is None:
            self._make(new)
        else:
            self._differ(old, new)
        self._desired = wanted
        self._before = {each: count for each, count in self._before.items() if each in new}
        return {}

    def allow(self, entries: Sequence[str]) -> None:
        """Make the table anew with these entries, at the next change: in the same transaction."""
        self._allowed = tuple(entries)
        self._shape = None

    def held(self, desired: Sequence[DesiredBlock]) -> Mapping[str, HeldCount]:
        """Read back.  Nothing stands in a table that lacks a rule: it is made anew with the next change."""
        listing = self._read()
        if listing is None or listing.shape != self._shape:
            if self._shape is not None:
                log.error("table inet %s was changed by somebody else; it is written again", self._plan.name)
            self._shape, self._desired = None, {}
            if not desired:
                self._make({})
            return {}
        wanted = elements_of(desired)
        standing = listing.elements
        held = {
            desired_block.id: self._count(element, standing[element])
            for desired_block in desired
            if (element := outermost(element_of(desired_block.target), wanted)) in standing
        }
        self._desired = {
            desired_block.id: desired_block for desired_block in desired if desired_block.id in held
        }
        if foreign := [each for each in standing if each not in wanted]:
            self._remove_foreign(foreign)
        return held

    def end(self, desired: Sequence[DesiredBlock]) -> None:
        """Leave the table, whose elements end by their time-outs, or remove it."""
        if self._at_end == "remove":
            try:
                self._nft.apply(self._plan.delete())
            except TransactionRefused as error:
                raise EnforcerAway(f"table inet {self._plan.name} could not be removed: {error}") from None
        else:
            log.info("table inet %s stays with %d blocks", self._plan.name, len(desired))

    def _count(self, element: Element, now: HeldCount) -> HeldCount:
        before = self._before.get(element, _NONE)
        return HeldCount(before.packets + now.packets, before.bytes + now.bytes)

    def _differ(self, old: Mapping[Element, int], new: Mapping[Element, int]) -> None:
        changed = {each: end for each, end in new.items() if old.get(each, -1) != end}
        gone = [each for each in old if each not in new]
        if again := [each for each in changed if each in old]:
            self._keep_counts(self._read(), again)
        # an outer prefix makes room for inner ones, and the other way round: removals come first
        commands = self._plan.change(changed, gone, old, time.time_ns())
        try:
            self._nft.apply(commands)
        except TransactionRefused as error:
            log.warning(
                "nftables refused a change: %s; the table is written again, in case somebody else changed it",
                error,
            )
            self._make(new)

    def _amend(
        self, old: Mapping[Element, int], new: Mapping[Element, int], lifted: Iterable[Element]
    ) -> None:
        """Add and remove in a table of which nobody knows yet what shall stand in it."""
        listing = self._read()
        if listing is None:
            self._make(new)
            return
        gone = [each for each in lifted if each in listing.elements and each not in new]
        lifted_here = set(gone)
        # a range, which only somebody else adds, is no network: it stays, too, until history is known
        left = {
            each: 0 for each in listing.elements if each not in lifted_here and not each[1].startswith("{")
        }
        every = {**left, **new}
        gone += [each for each in left if outermost(each, every) != each]
        changed = {
            each: end
            for each, end in new.items()
            if outermost(each, every) == each and (each not in left or old.get(each, -1) != end)
        }
        self._keep_counts(listing, [each for each in changed if each in left])
        try:
            # in one transaction, nft would refuse a prefix around another one that goes
            self._nft.apply(self._plan.change({}, gone, {}, time.time_ns()))
            self._nft.apply(self._plan.change(changed, (), left, time.time_ns()))
        except TransactionRefused as error:
            raise EnforcerAway(
                f"nftables refuses a change of table inet {self._plan.name}: {error}"
            ) from None

    def _make(self, elements: Mapping[Element, int]) -> None:
        listing = self._read()
        self._keep_counts(listing, listing.elements if listing is not None else ())
        self._shape = None
        try:
            self._nft.apply(self._plan.create(self._allowed or (), elements, time.time_ns()))
        except TransactionRefused as error:
            raise EnforcerAway(f"nftables refuses table inet {self._plan.name}: {error}") from None
        made = self._read()
        self._shape = made.shape if made is not None else None

    def _remove_foreign(self, elements: Sequence[Element]) -> None:
        log.error(
            "table inet %s: removed elements that somebody else added: %s", self._plan.name, elements[:10]
        )
        try:
            self._nft.apply(self._plan.change({}, elements, {}, time.time_ns()))
        except TransactionRefused:
            self._shape = None  # made anew with the next change or reading

    def _keep_counts(self, listing: TableListing | None, elements: Iterable[Element]) -> None:
        """These elements begin to count anew."""
        counted = listing.elements if listing is not None else {}
        for element in elements:
            if element in counted:
                self._before[element] = self._count(element, counted[element])

    def _read(self) -> TableListing | None:
        found = self._nft.table(self._plan.name)
        if found is None:
            return None
        try:
            return listing_in(found)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise EnforcerAway(f"table inet {self._plan.name} cannot be read: {error}") from None
