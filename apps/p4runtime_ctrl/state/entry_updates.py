"""Decisions and commands → `EntryUpdate`s: the changes to a switch that carry one out, and their owner."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Final

from apps.messages import Decision, RateLimit, TableCommand, TableUpdate, Target
from apps.p4runtime_ctrl.errors import EntryError
from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
from apps.p4runtime_ctrl.state import guard, limits
from apps.p4runtime_ctrl.state.blocks import table_update
from apps.p4runtime_ctrl.state.desired_state import DELETE, INSERT, MODIFY, Change, entry_key, table_id
from apps.p4runtime_ctrl.state.guard import GuardSettings, Service
from apps.p4runtime_ctrl.state.limits import LimitKey

_KINDS: Final = {"insert": INSERT, "modify": MODIFY, "delete": DELETE}


@dataclass(frozen=True, slots=True)
class Owner:
    """The decision or command behind an entry, for confirmations."""

    id: str
    action: str
    target: Target | None = None
    event_time: int = 0
    """Time of the decision, capture time in ns."""


def owner_of(decision: Decision) -> Owner:
    return Owner(decision.id, decision.action, decision.target, decision.event_time)


@dataclass(frozen=True)
class EntryUpdate:
    """Changes that belong together; confirmations name the last insert or the first delete."""

    owner: Owner
    changes: tuple[Change, ...]
    service: Service | None = None
    limit: LimitKey | None = None

    @property
    def main(self) -> Change:
        """The change that confirmations name for the update."""
        return self.changes[0] if self.changes[0].kind == DELETE else self.changes[-1]

    @cached_property
    def keys(self) -> set[bytes]:
        return {entry_key(change.entry) for change in self.changes}


class EntryUpdates:
    """Makes `EntryUpdate`s for one program, and assigns the slots of protected services and of rate limits.

    `reserved` are tables that no command may touch.
    """

    def __init__(self, program: ProgramInfo, settings: GuardSettings, reserved: Iterable[int]) -> None:
        self._program = program
        self._settings = settings
        self._reserved = frozenset(reserved)
        self._slots: dict[Service, int] = {}
        self._limits: dict[LimitKey, int] = {}
        """Slots of rate limits."""
        self._metered = program.table(guard.KNOWN_SOURCES).id if guard.KNOWN_SOURCES in program.names else 0

    @property
    def guards(self) -> bool:
        """Whether any service is protected."""
        return bool(self._slots)

    def of_decision(self, decision: Decision) -> EntryUpdate:
        """Raises `EntryError` or `ProgramError` for a decision that cannot be carried out."""
        owner = owner_of(decision)
        if decision.action in ("block", "unblock"):
            return EntryUpdate(owner, (self._change(table_update(decision, self._program)),))
        if decision.limit is not None:
            return self._limit(owner, decision.target, decision.limit)
        service = guard.service_of(decision.target)
        if decision.action == "protect":
            changes = guard.protection(self._program, service, self._slot(service), self._settings)
        else:
            changes = guard.release(self._program, service, last_of_host=not self._others(service))
            self._slots.pop(service, None)
        return EntryUpdate(owner, tuple(changes), service)

    def of_command(self, command: TableCommand) -> tuple[list[EntryUpdate], list[tuple[Owner, str]]]:
        """One `EntryUpdate` for each update that fits the program; owner and reason of those that do not."""
        updates: list[EntryUpdate] = []
        refused: list[tuple[Owner, str]] = []
        for update in command.updates:
            owner = Owner(command.id, update.kind)
            try:
                updates.append(EntryUpdate(owner, (self._checked(update),)))
            except EntryError as error:
                refused.append((owner, str(error)))
        return updates, refused

    def own_changes(self, update: EntryUpdate) -> list[Change]:
        """The changes of an update that no other one needs."""
        if update.service is None or not self._others(update.service):
            return list(update.changes)
        host = entry_key(guard.host_entry(self._program, update.service[0]))
        return [change for change in update.changes if entry_key(change.entry) != host]

    def give_up(self, update: EntryUpdate) -> None:
        """The switch refused the update: free its slot."""
        if update.owner.action == "protect" and update.service is not None:
            self._slots.pop(update.service, None)
        if update.owner.action == "meter" and update.limit is not None:
            self._limits.pop(update.limit, None)

    def _limit(self, owner: Owner, target: Target, limit: RateLimit) -> EntryUpdate:
        key = limits.key_of(target, limit)
        if owner.action == "meter":
            if key not in self._limits:
                taken = set(self._limits.values())
                free = next((slot for slot in range(limits.SLOTS) if slot not in taken), None)
                if free is None:
                    raise EntryError(f"{limits.SLOTS} rate limits are in force already; lift one first")
                self._limits[key] = free
            changes = limits.limiting(self._program, target, limit, self._limits[key])
        elif key in self._limits:
            changes = limits.lifting(self._program, target, limit, self._limits.pop(key))
        else:
            raise EntryError(f"no rate limit of {limit.words} towards {target.address} is in force")
        return EntryUpdate(owner, tuple(changes), limit=key)

    def _others(self, service: Service) -> bool:
        """Whether another service of its host is protected."""
        return any(each[0] == service[0] and each != service for each in self._slots)

    def _slot(self, service: Service) -> int:
        if service not in self._slots:
            taken = set(self._slots.values())
            free = next((slot for slot in range(guard.SLOTS) if slot not in taken), None)
            if free is None:
                raise EntryError(f"{guard.SLOTS} services are protected already; release one first")
            self._slots[service] = free
        return self._slots[service]

    def _change(self, update: TableUpdate) -> Change:
        return Change(_KINDS[update.kind], self._program.entry(update))

    def _checked(self, update: TableUpdate) -> Change:
        change = self._change(update)
        if table_id(change.entry) in self._reserved:
            raise EntryError(
                f"{update.table}: this table belongs to the classifier, which all requests share; request packets instead"
            )
        if change.kind != DELETE and table_id(change.entry) == self._metered:
            change.entry.meter_config.CopyFrom(self._settings.known.config())
        return change
