"""The desired state of one switch: its entries, who asked for them, and reconciliation.

    decisions, commands ─► entry_updates: changes ─► the desired state ─► Transport.write (southbound/session.py)

Everything that a switch should hold is kept here, whether it is connected or not.  While there is a `Transport`,
changes are written at once; after a lost connection `bring_up` reads the entries of the switch and writes the
difference.  It has no thread, clock or socket: the worker calls it from one thread.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from apps.messages import Confirmation, Decision, State, TableCommand
from apps.p4runtime_ctrl.errors import EntryError, P4InfoError, SwitchError
from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
from apps.p4runtime_ctrl.state import limits
from apps.p4runtime_ctrl.state.blocks import BLOCK_TABLES
from apps.p4runtime_ctrl.state.desired_state import (
    DELETE,
    INSERT,
    MODIFY,
    Change,
    EntrySet,
    deletion,
    difference,
    entry_body,
    entry_key,
    is_standing,
    table_id,
)
from apps.p4runtime_ctrl.state.entry_updates import EntryUpdate, EntryUpdates, Owner, owner_of
from apps.p4runtime_ctrl.state.guard import SECRET_WORDS, GuardSettings, secrets_entry
from apps.p4runtime_ctrl.state.mac_learning import GROUP, LearnSettings, MacLearning, new_senders, no_flood
from apps.p4runtime_ctrl.state.port_forwarding import wires_of
from apps.p4runtime_ctrl.telemetry.classifier import Classifier, TelemetryRequest

_OK, _NOT_FOUND, _EXISTS = 0, 5, 6
_MOST_CAUSE = 2_000
"""Most characters of an error text from a switch."""


@dataclass(frozen=True)
class UpdateOutcome:
    """The switch's answer to one update: a gRPC status code and its text."""

    code: int = _OK
    message: str = ""


class Transport(Protocol):
    """A connected switch.  Every method raises `SwitchError`."""

    def ensure_program(self) -> bool:
        """Load the program unless the switch has it; True if it was loaded (its tables are empty then)."""

    def ensure_copies(self) -> None:
        """Set up the clone session to the controller."""

    def ensure_digests(self) -> None:
        """Enable the digests of the program."""

    def ensure_group(self, group: int, ports: Sequence[int]) -> None:
        """Set up a multicast group of these ports."""

    def write(self, changes: Sequence[Change]) -> list[UpdateOutcome]:
        """One outcome for each change, in order; each succeeds or fails by itself."""

    def read_entries(self) -> Iterable[Any]:
        """All entries of all tables, without default actions."""

    def read_standing(self, entries: Iterable[Any]) -> Iterable[Any]:
        """The switch's values of these default actions and meter cells."""

    def read_counters(self, table_id: int) -> Iterable[Any]:
        """Entries of one table with their direct counters."""


@dataclass
class BringUp:
    """The changes that reconciliation made."""

    program_loaded: bool = False
    inserted: int = 0
    modified: int = 0
    removed: int = 0
    failed: dict[bytes, str] = field(default_factory=dict)
    confirmations: list[Confirmation] = field(default_factory=list)

    def __str__(self) -> str:
        parts = ["program loaded"] if self.program_loaded else []
        counts = {"inserted": self.inserted, "modified": self.modified, "removed": self.removed}
        parts += [f"{count} {what}" for what, count in counts.items() if count]
        parts += [f"{len(self.failed)} failed ({next(iter(self.failed.values()))})"] if self.failed else []
        return ", ".join(parts) or "nothing to change"


Clock = Callable[[], tuple[int, int]]
"""Capture time in ns and arrival number of the newest packet seen."""


class DesiredSwitch:
    """Desired state of the switch `name`.

    `forward` maps ingress to egress ports.  `fail` decides the order of reconciliation: open writes port
    forwarding first, so that traffic flows; closed writes it last, so that nothing passes unchecked.
    Raises `P4InfoError` if the program lacks what the controller needs.
    """

    def __init__(
        self,
        name: str,
        program: ProgramInfo,
        clock: Clock,
        *,
        forward: Mapping[int, int] | None = None,
        fail: Literal["open", "closed"] = "open",
        guard: GuardSettings | None = None,
        learn: LearnSettings | None = None,
    ) -> None:
        self.name = name
        self.program = program
        self.requests: tuple[TelemetryRequest, ...] | None = None
        """Telemetry requests; None until they are known: the switch's telemetry is then left as it is."""
        self.fail = fail
        self._clock = clock
        self._classifier = Classifier(program)
        self._entry_updates = EntryUpdates(program, guard or GuardSettings(), self._classifier.table_ids)
        self._blocks = {program.table(each).id: 0 for each in (*BLOCK_TABLES, limits.OVER)}
        self._over, self._limit = program.table(limits.OVER).id, program.table(limits.LIMIT).id
        self._forward = wires_of(program, forward or {})
        self._desired = EntrySet(self._forward)
        self.mac_learning = MacLearning(program, learn) if learn is not None else None
        """Learnt MAC addresses, if learning is on."""
        self._unlearnt = no_flood(program) if self.mac_learning is None else []
        for entry in new_senders(program, learn=self.mac_learning is not None):
            self._desired.put(entry)
        if self.mac_learning is not None:
            self._desired.put(self.mac_learning.flood())
        self._configured = tuple(self._desired)
        self._owners: dict[bytes, Owner] = {}
        self._unconfirmed: dict[bytes, EntryUpdate] = {}
        self._aged: dict[bytes, EntryUpdate] = {}
        """Of those the ones that were there when `age_unconfirmed` was called last."""
        self._refused: dict[bytes, EntryUpdate] = {}
        """Updates that the switch refused in part, and may still have the rest of: their slots are not free yet."""
        self._telemetry = EntrySet()
        self._secrets = (0, (0,) * len(SECRET_WORDS))

    @property
    def guards(self) -> bool:
        """Whether any service is protected."""
        return self._entry_updates.guards

    def restore(self, history: Iterable[Decision | TableCommand]) -> list[str]:
        """Build the desired state from history, oldest first; returns errors for what did not fit the program.

        Of a command's updates those are left out that the switch must have refused.  That goes by what the history
        has put there before: at a takeover the desired state already holds its end.
        """
        problems: list[str] = []
        there = EntrySet(self._configured)
        for each in history:
            if isinstance(each, TableCommand):
                problems += self._restore_command(each, there)
                continue
            if each.dry_run:
                continue
            try:
                self._replay(self._entry_updates.of_decision(each), there)
            except (EntryError, P4InfoError) as error:
                problems.append(f"decision {each.id}: {error}")
        return problems

    def _restore_command(self, command: TableCommand, there: EntrySet) -> list[str]:
        updates, refused = self._entry_updates.of_command(command)
        for update in [] if refused else updates:
            if _was_taken(update.main, there):
                self._replay(update, there)
        return [f"command {command.id}: {reason}" for _, reason in refused]

    def _replay(self, update: EntryUpdate, there: EntrySet) -> None:
        self._remember(update)
        for change in update.changes:
            if change.kind == DELETE:
                there.discard(change.entry)
            else:
                there.put(change.entry)

    def bring_up(self, transport: Transport) -> BringUp:
        """Read, compare, write the difference in one batch."""
        report = BringUp(program_loaded=transport.ensure_program())
        transport.ensure_copies()
        transport.ensure_digests()
        if self.mac_learning is not None:
            transport.ensure_group(GROUP, self.mac_learning.ports)
        standing = [entry for entry in self._desired if is_standing(entry)]
        standing += [entry for entry in self._classifier.entries(()) if is_standing(entry)]
        unlearnt = [entry for entry in self._unlearnt if entry not in self._desired]
        read = [entry for entry in transport.read_entries() if not entry.is_const]
        read += transport.read_standing(standing + unlearnt)
        for entry in unlearnt:  # an earlier controller may have configured flooding
            if entry in EntrySet(each for each in read if is_standing(each)):
                self._desired.put(entry)
        for learnt in self.mac_learning.adopt(read) if self.mac_learning is not None else ():
            self._desired.put(learnt)
        ids = self._classifier.table_ids
        present = EntrySet(entry for entry in read if table_id(entry) not in ids)
        telemetry = EntrySet(entry for entry in read if table_id(entry) in ids)
        changes = self._plan(present, telemetry)
        for change, outcome in zip(changes, transport.write(changes) if changes else [], strict=True):
            self._note(report, change, outcome)
        self._telemetry = telemetry if self.requests is None else self._classifier.entries(self.requests)
        self._free_slots(report)
        report.confirmations = self._confirm_pending(report, transport)
        return report

    def decide(self, decisions: Sequence[Decision], transport: Transport | None) -> list[Confirmation]:
        """Carry decisions out; dry runs are ignored and not confirmed."""
        updates: list[EntryUpdate] = []
        answers: list[Confirmation] = []
        for decision in decisions:
            if decision.dry_run:
                continue
            try:
                updates.append(self._entry_updates.of_decision(decision))
            except (EntryError, P4InfoError) as error:
                answers.append(self._confirmation(owner_of(decision), "failed", cause=str(error)))
        return answers + self._carry_out(updates, transport)

    def command(self, command: TableCommand, transport: Transport | None) -> list[Confirmation]:
        """Carry a command out: one confirmation for each of its updates, in order.

        A command with an update that does not fit the program is refused as a whole.
        """
        updates, refused = self._entry_updates.of_command(command)
        if refused:
            return [self._confirmation(owner, "failed", cause=reason) for owner, reason in refused]
        return self._carry_out(updates, transport)

    def fitting(self, requests: Sequence[TelemetryRequest]) -> tuple[list[TelemetryRequest], dict[str, str]]:
        """The telemetry requests that can be held together; those in force take precedence.

        Returns:
            Those that can be held, in their order; name to reason of the others.
        """
        in_force = {(each.name, each.bit): each.conditions for each in self.requests or ()}
        fit, left_out = self._classifier.fitting(
            sorted(requests, key=lambda each: in_force.get((each.name, each.bit)) != each.conditions)
        )
        return [each for each in requests if each in fit], left_out

    def want(self, requests: Sequence[TelemetryRequest], transport: Transport | None) -> list[str]:
        """Change the telemetry requests; returns what the switch refused.

        Raises `TelemetryError` or `EntryError` for requests that cannot be held: then nothing changes.
        """
        wanted = tuple(requests)
        kept = [request for request in wanted if request in (self.requests or ())]
        desired = self._classifier.entries(wanted)
        self.requests = wanted
        if transport is None:
            return []
        changes = self._classifier.transition(self._telemetry, desired, kept)
        outcomes = transport.write(changes) if changes else []
        self._telemetry = desired
        return [
            f"{self.program.describe(change.entry)}: {outcome.message}"
            for change, outcome in zip(changes, outcomes, strict=True)
            if outcome.code != _OK
        ]

    def learn(self, lists: Iterable[Any], transport: Transport) -> None:
        """Add entries for MAC addresses that the switch reports; a refused one is reported again."""
        if self.mac_learning is not None:
            self._write_learnt(self.mac_learning.learn(lists), transport)

    def change_secret(self, first: int, second: int, transport: Transport | None) -> None:
        """Replace the older of the two cookie secrets, and use it from now on."""
        current, words = self._secrets
        current = 1 - current
        words = (*words[:2], first, second) if current else (first, second, *words[2:])
        self._secrets = (current, words)
        entry = secrets_entry(self.program, current, words)
        self._desired.put(entry)
        if transport is not None:
            transport.write([Change(MODIFY, entry)])

    def expire(self, entries: Iterable[Any], transport: Transport) -> list[Confirmation]:
        """Delete entries that the switch reports as idle; those already gone are not confirmed twice."""
        idle = [entry for entry in entries if entry in self._desired]
        if self.mac_learning is not None:
            silent = [entry for entry in idle if self.mac_learning.owns(entry)]
            gone = [change for entry in silent for change in self.mac_learning.forget(entry)]
            self._write_learnt(gone, transport)
            idle = [entry for entry in idle if entry in self._desired]
        outcomes = transport.write([deletion(entry) for entry in idle]) if idle else []
        answers = []
        for entry, outcome in zip(idle, outcomes, strict=True):
            owner = self._owners.get(entry_key(entry), Owner("", "expire"))
            self._forget(entry)
            state: State = "expired" if outcome.code in (_OK, _NOT_FOUND) else "failed"
            answers.append(self._confirmation(owner, state, entry, cause=outcome.message or "idle"))
        return answers

    @property
    def blocks(self) -> int:
        """Entries that drop traffic."""
        return sum(self._blocks.values())

    @property
    def counted_tables(self) -> list[int]:
        """Tables with entries that drop traffic; and rate limits, which say what they let pass."""
        found = {table for table, blocks in self._blocks.items() if blocks}
        return sorted(found | {self._limit} if self._over in found else found)

    def readings(self, entries: Iterable[Any]) -> list[dict[str, Any]]:
        """Results of `read_counters` for these tables, with the decisions that the entries come from.

        `packets` are dropped ones; of a rate limit `seen` says how many it looked at.

        The only method that another thread may call: with many entries it takes long.
        """
        found = []
        seen: Counter[str] = Counter()
        """Packets that rate limits looked at, by decision."""
        for entry in entries:
            owner = self._owners.get(entry_key(entry))
            name = owner.id if owner else ""
            if entry.table_id == self._limit:
                seen[name] += entry.counter_data.packet_count
                continue
            reading = {
                "id": name,
                "handle": self.program.describe(entry),
                "packets": entry.counter_data.packet_count,
                "bytes": entry.counter_data.byte_count,
            }
            found.append(reading | {"seen": 0} if entry.table_id == self._over else reading)
        for reading in found:
            if "seen" in reading:  # the tables were read one after the other
                reading["seen"] = max(seen[reading["id"]], reading["packets"])
        return found

    @property
    def learning(self) -> dict[str, int]:
        """Counts of MAC learning; empty if it is off."""
        learning = self.mac_learning
        if learning is None:
            return {}
        return {
            "learnt": len(learning),
            "moved": learning.moved,
            "learn_refused": learning.refused,
            "learn_malformed": learning.malformed,
        }

    def forget_learnt(self) -> None:
        """Another controller learns from now on; what it has learnt is read from the switch again."""
        if self.mac_learning is not None:
            for change in self.mac_learning.forget_all():
                self._desired.discard(change.entry)

    def age_unconfirmed(self) -> None:
        """Forget which updates are to be confirmed, of those that were so at the last call; they stay desired."""
        left = {key: one for key, one in self._unconfirmed.items() if self._aged.get(key) is not one}
        self._unconfirmed, self._aged = left, dict(left)

    def withdraw(self, transport: Transport) -> None:
        """Fail closed: remove port forwarding before the controller ends."""
        if self.fail == "closed" and self._forward:
            transport.write([deletion(entry) for entry in self._forward])

    def _write_learnt(self, changes: list[Change], transport: Transport) -> None:
        for change in changes:
            if change.kind == DELETE:
                self._desired.discard(change.entry)
            else:
                self._desired.put(change.entry)
        outcomes = transport.write([_bare(change) for change in changes]) if changes else []
        bad = [change for change, said in zip(changes, outcomes, strict=True) if not _achieved(change, said)]
        if bad and self.mac_learning is not None:
            self.mac_learning.undo(bad)
            for change in bad:
                self._desired.discard(change.entry)

    def _plan(self, present: EntrySet, telemetry: EntrySet) -> list[Change]:
        wires = {entry_key(entry) for entry in self._forward}
        plain = difference(self._desired, present)
        forward = [change for change in plain if entry_key(change.entry) in wires]
        others = [change for change in plain if entry_key(change.entry) not in wires]
        packets: list[Change] = []
        if self.requests is not None:
            packets = self._classifier.transition(telemetry, self._classifier.entries(self.requests), kept=())
        return forward + others + packets if self.fail == "open" else others + packets + forward

    def _note(self, report: BringUp, change: Change, outcome: UpdateOutcome) -> None:
        if outcome.code != _OK:
            name = self.program.describe(change.entry)
            report.failed[entry_key(change.entry)] = f"{name}: {outcome.message}"
        elif change.kind == INSERT:
            report.inserted += 1
        elif change.kind == MODIFY:
            report.modified += 1
        else:
            report.removed += 1

    def _confirm_pending(self, report: BringUp, transport: Transport) -> list[Confirmation]:
        """Confirm postponed updates as done or failed."""
        pending, self._unconfirmed = self._unconfirmed, {}
        answers = []
        for key, update in pending.items():
            done: State = "removed" if update.main.kind == DELETE else "installed"
            cause = report.failed.get(key)
            state: State = "failed" if cause else done
            if cause and update.main.kind != DELETE:
                self._give_up(update, transport)
            text = cause or "done when the switch was connected again"
            answers.append(self._confirmation(update.owner, state, update.main.entry, cause=text))
        return answers

    def _remember(self, update: EntryUpdate) -> None:
        for change in update.changes:
            if change.kind == DELETE:
                self._forget(change.entry)
                continue
            if table_id(change.entry) in self._blocks and change.entry not in self._desired:
                self._blocks[table_id(change.entry)] += 1
            self._desired.put(change.entry)
            self._owners[entry_key(change.entry)] = update.owner

    def _forget(self, entry: Any) -> None:
        if self._desired.discard(entry) and table_id(entry) in self._blocks:
            self._blocks[table_id(entry)] -= 1
        self._owners.pop(entry_key(entry), None)

    def _carry_out(self, updates: Sequence[EntryUpdate], transport: Transport | None) -> list[Confirmation]:
        """In batches without repeated keys: P4Runtime leaves the order within a batch open."""
        answers: list[Confirmation] = []
        batch: list[EntryUpdate] = []
        taken: set[bytes] = set()
        for update in updates:
            if taken & update.keys:
                answers += self._write(batch, transport)
                batch, taken = [], set()
            batch.append(update)
            taken |= update.keys
        return answers + self._write(batch, transport)

    def _write(self, updates: list[EntryUpdate], transport: Transport | None) -> list[Confirmation]:
        if not updates:
            return []
        if transport is None:
            return [self._postpone(update, "the switch is not connected") for update in updates]
        try:
            outcomes = iter(transport.write([change for update in updates for change in update.changes]))
        except SwitchError as error:
            return [self._postpone(update, str(error)) for update in updates]
        each = [(update, [next(outcomes) for _ in update.changes]) for update in updates]
        return [self._conclude(update, said, transport) for update, said in each]

    def _postpone(self, update: EntryUpdate, cause: str) -> Confirmation:
        """Kept as desired; written and confirmed when the switch is connected again."""
        self._remember(update)
        self._unconfirmed[entry_key(update.main.entry)] = update
        text = f"{cause}; it is kept, and written when the switch is connected again"
        return self._confirmation(update.owner, "pending", update.main.entry, cause=text)

    def _conclude(
        self, update: EntryUpdate, outcomes: list[UpdateOutcome], transport: Transport
    ) -> Confirmation:
        main = update.main
        results = list(zip(update.changes, outcomes, strict=True))
        bad = [(change, outcome) for change, outcome in results if not _achieved(change, outcome)]
        if bad:
            taken = [change for change, outcome in results if _achieved(change, outcome)]
            new = [change for change in taken if change.entry not in self._desired]
            self._take_back(update, new, transport)
            return self._confirmation(update.owner, "failed", bad[0][0].entry, cause=bad[0][1].message)
        said = next(outcome for change, outcome in results if change is main)
        if main.kind == DELETE:
            self._remember(update)
            return self._confirmation(update.owner, "removed", main.entry, cause=said.message)
        if said.code == _EXISTS:
            return self._confirmation(
                update.owner, "exists", main.entry, cause=self._kept(update, said.message)
            )
        self._remember(update)
        return self._confirmation(update.owner, "installed", main.entry)

    def _give_up(self, update: EntryUpdate, transport: Transport) -> None:
        """What the switch has refused is not tried at each connection: nobody holds it to be in force."""
        changes = self._entry_updates.own_changes(update)
        for change in changes:
            self._forget(change.entry)
        self._take_back(update, changes if len(changes) > 1 else [], transport)

    def _take_back(self, update: EntryUpdate, taken: Sequence[Change], transport: Transport) -> None:
        """Delete what the switch has taken of a refused update; until that is gone nobody else gets its slot."""
        changes = [deletion(change.entry) for change in reversed(taken) if change.kind == INSERT]
        try:
            outcomes = transport.write(changes) if changes else []
        except SwitchError:
            outcomes = []
        if len(outcomes) < len(changes) or not all(map(_achieved, changes, outcomes)):
            self._refused[entry_key(update.main.entry)] = update
        elif update.main.entry not in self._desired:  # otherwise it was in force before
            self._entry_updates.give_up(update)

    def _free_slots(self, report: BringUp) -> None:
        """Reconciliation has removed what was left of refused updates, unless the switch refused that, too."""
        refused, self._refused = self._refused, {}
        for key, update in refused.items():
            if update.keys & report.failed.keys():
                self._refused[key] = update
            elif update.main.entry not in self._desired:
                self._entry_updates.give_up(update)

    def _kept(self, update: EntryUpdate, said: str) -> str:
        """The existing entry stays; returns the text for the confirmation."""
        held = self._desired.get(update.main.entry)
        if held is None:
            self._remember(update)
        elif entry_body(held) != entry_body(update.main.entry):
            return "it exists with another action or other parameters; use modify to change it"
        return said

    def _confirmation(
        self, owner: Owner, state: State, entry: Any | None = None, *, cause: str = ""
    ) -> Confirmation:
        event_time, arrival = self._clock()
        handle = self.program.describe(entry) if entry is not None else ""
        if state in ("failed", "pending") and handle and handle not in cause:
            cause = f"{handle}: {cause}"
        return Confirmation(
            id=owner.id,
            switch=self.name,
            state=state,
            action=owner.action,
            target=owner.target,
            handle=handle,
            cause=cause[:_MOST_CAUSE],
            event_time=event_time or owner.event_time,
            arrival=arrival,
        )


def _bare(change: Change) -> Change:
    return deletion(change.entry) if change.kind == DELETE else change


def _achieved(change: Change, outcome: UpdateOutcome) -> bool:
    """Whether the switch now has the state that the change asks for, even if it had it before."""
    also = {INSERT: _EXISTS, DELETE: _NOT_FOUND}.get(change.kind)
    return outcome.code in (_OK, also)


def _was_taken(change: Change, there: EntrySet) -> bool:
    """Whether a switch with these entries takes the change: it inserts none twice, and modifies none that is missing."""
    held = there.get(change.entry)
    if change.kind == INSERT:
        return held is None or held.idle_timeout_ns > 0  # that one may have expired meanwhile
    return change.kind == DELETE or held is not None or is_standing(change.entry)
