"""What enforcers share: waiting, refusing, giving up and standing back, with an enforcer that does as it is told."""

import threading
import time
from itertools import count

import pytest
from msgspec import structs

from apps.enforcement import AllowedEntries, EnforcementReport
from apps.enforcers.arrivals import allowed_in, decision_in
from apps.enforcers.desired_blocks import AllowedSenders
from apps.enforcers.enforcement_worker import EnforcementWorker, Spoken
from apps.enforcers.enforcer import EnforcerAway, HeldCount
from apps.messages import Confirmation, Decision, MessageError, Target
from due import Item
from sdnator.testing.waiting import wait_for
from tests.apps.hostile import NOW, carried, mutations

NUMBERS = count()


def block(address="192.0.2.1", *, seconds=600, action="block", **fields):
    now = time.time_ns()
    made = {"id": f"d{next(NUMBERS)}", "switch": "*", "reason": "", "event_time": now}
    expires = now + seconds * 10**9 if seconds else 0
    target = Target(kind="ip", address=address)
    return Decision(**{**made, "action": action, "target": target, "expires": expires, **fields})


class Obedient:
    """An enforcer that remembers, may be away, and may be slow."""

    def __init__(self):
        self.standing = {}
        self.changed = []
        self.away = ""
        self.gate = threading.Event()
        self.gate.set()

    def change(self, add, remove):
        self.gate.wait(60)
        if self.away:
            raise EnforcerAway(self.away)
        self.changed += [f"+{each.id}" for each in add] + [f"-{each.id}" for each in remove]
        self.standing |= {
            desired_block.id: desired_block
            for desired_block in add
            if desired_block.target.address != "192.0.2.66"
        }
        for desired_block in remove:
            self.standing.pop(desired_block.id, None)
        return {
            desired_block.id: "not this one"
            for desired_block in add
            if desired_block.target.address == "192.0.2.66"
        }

    def allow(self, entries):
        self.allowed = entries

    def held(self, desired):
        if self.away:
            raise EnforcerAway(self.away)
        return {
            desired_block.id: HeldCount() for desired_block in desired if desired_block.id in self.standing
        }

    def end(self, desired):
        self.ended = [desired_block.id for desired_block in desired]


class Told:
    """An enforcement worker, its enforcer, and what it says."""

    def __init__(self, *, archive=True, **options):
        self.enforcer = Obedient()
        self.said: list[Confirmation] = []
        self.reports: list[EnforcementReport] = []
        chosen = {"check_s": 0.05, "patience_s": 0.2, **options}
        names = ("app", "place")
        self.worker = EnforcementWorker(self.enforcer, names, self.said.append, self.reports.append, **chosen)
        if archive:
            self.worker.restore((), ())

    def tell(self, decision):
        self.worker.put(Spoken(decision, time.time_ns()))
        return decision

    def wait_for(self, decision, state):
        wait_for(lambda: [each.state for each in self.said if each.id == decision.id][-1:] == [state])


@pytest.fixture
def told():
    made = Told()
    made.worker.start()
    yield made
    made.worker.close()


def test_what_does_not_fit_into_the_queue_is_answered_and_counted():
    """Nobody waits for a slow enforcer."""
    told = Told(size=5)
    told.enforcer.gate.clear()
    told.worker.start()
    made = [told.tell(block(f"192.0.2.{n}")) for n in range(1, 40)]
    refused = told.worker.health()["refused_full"]
    assert refused >= len(made) - 5 - 5 - 1
    assert len([each for each in told.said if each.state == "failed"]) == refused
    told.enforcer.gate.set()
    wait_for(lambda: len(told.said) == len(made))
    told.worker.close()


def test_one_that_is_away_gets_it_later_or_fails(told):
    told.enforcer.away = "asleep"
    failed = told.tell(block())
    told.wait_for(failed, "failed")
    assert told.said[-1].cause == "asleep"
    told.enforcer.away = ""
    told.wait_for(told.tell(block()), "installed")
    assert told.worker.health()["problem"] == ""


def test_a_refusal_is_one_decision_s_alone(told):
    refused, made = told.tell(block("192.0.2.66")), told.tell(block())
    told.wait_for(refused, "failed")
    told.wait_for(made, "installed")
    assert set(told.enforcer.standing) == {made.id}


def test_a_block_ends_by_itself(told):
    made = told.tell(block(seconds=1))
    told.wait_for(made, "installed")
    told.wait_for(made, "expired")
    assert not told.enforcer.standing


@pytest.mark.parametrize(
    ("decision", "state", "cause"),
    [
        (block(action="unblock"), "removed", "was not in force"),
        (block(event_time=1, expires=2), "failed", "it had expired"),
    ],
)
def test_what_cannot_be_is_answered(told, decision, state, cause):
    told.worker.put(Spoken(decision, time.time_ns() - 10**9))
    told.wait_for(decision, state)
    assert cause in told.said[-1].cause


def test_a_limit_of_blocks_holds():
    told = Told(limit=2)
    told.worker.start()
    made = [told.tell(block(f"192.0.2.{n}")) for n in range(1, 4)]
    told.wait_for(made[2], "failed")
    assert len(told.enforcer.standing) == 2
    told.worker.close()


def test_without_history_only_what_is_told_is_changed():
    """What an earlier run has left stays until it is lifted; the report says that history is missing."""
    told = Told(archive=False)
    stays, lifted = block(), block("192.0.2.2")
    told.enforcer.standing = {each.id: each for each in (stays, lifted)}
    told.enforcer.held = told.enforcer.allow = None
    told.worker.start()
    new = told.tell(block("192.0.2.3"))
    told.wait_for(new, "installed")
    told.tell(structs.replace(lifted, action="unblock"))
    told.wait_for(lifted, "removed")
    assert told.enforcer.standing.keys() == {stays.id, new.id}
    assert told.enforcer.changed == [f"+{new.id}", f"-{lifted.id}"]
    assert not told.reports[-1].working
    assert "Data Archives" in told.worker.health()["problem"]
    told.worker.close()


def test_what_was_heard_is_newer_than_history():
    """A late answer of the archive brings back neither a lifted block nor an old end, and lifts what it knows."""
    told = Told(archive=False)
    told.worker.start()
    lifted, extended, ended = block(), block("192.0.2.2"), block("192.0.2.3")
    longer = structs.replace(extended, expires=extended.expires + 10**9)
    told.worker.put(("192.0.2.5",))
    for each in (structs.replace(lifted, action="unblock"), longer, ended):
        told.tell(each)
    for each, state in ((lifted, "removed"), (longer, "installed"), (ended, "installed")):
        told.wait_for(each, state)
    allowed, old = block("192.0.2.5"), block("192.0.2.6")
    history = (lifted, extended, structs.replace(ended, action="unblock"), allowed, old)
    told.worker.restore((), [Spoken(each, each.event_time, restored=True) for each in history])
    told.wait_for(old, "installed")
    told.wait_for(ended, "removed")
    told.wait_for(allowed, "failed")
    assert {each.id: each.decision for each in told.enforcer.standing.values()} == {
        longer.id: longer,
        old.id: old,
    }
    assert told.enforcer.allowed == ("192.0.2.5",)
    assert told.worker.health()["working"]
    told.worker.close()


def test_guards_and_dry_runs_are_none_of_its_business(told):
    told.tell(block(action="protect"))
    told.tell(block(dry_run=True))
    last = told.tell(block())
    told.wait_for(last, "installed")
    assert {each.id for each in told.said} == {last.id}


def test_at_the_end_what_waits_is_carried_out(told):
    made = [told.tell(block(f"192.0.2.{n}")) for n in range(1, 50)]
    told.worker.close()
    assert set(told.enforcer.ended) == {each.id for each in made}


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_dead_worker_is_noticed(told):
    """An error of the enforcer that is none of its errors ends the thread, and then the app."""
    told.enforcer.held = None
    wait_for(lambda: not told.worker._thread.is_alive())
    with pytest.raises(RuntimeError, match="has ended"):
        told.worker.check()


@pytest.mark.parametrize(
    ("entries", "address", "covered"),
    [
        (("192.0.2.0/24",), "192.0.2.9", True),
        (("192.0.2.9",), "192.0.2.0/24", True),
        (("2001:db8::/32",), "2001:db8::1", True),
        (("192.0.2.0/24",), "2001:db8::1", False),
        (("02:00:00:00:00:01",), "192.0.2.9", False),
    ],
)
def test_who_is_allowed(entries, address, covered):
    allowed = AllowedSenders()
    allowed.replace(entries)
    assert allowed.cover(Target(kind="ip", address=address)) == covered


def test_hostile_messages_raise_one_error():
    """Decisions and allow-lists alike."""
    cases = (
        ("network.block.firewall.ipv4", decision_in, block().to_value()),
        ("network.allowed.firewall", allowed_in, AllowedEntries(entries=("192.0.2.1",)).to_value()),
    )
    for key, decode, genuine in cases:
        decode(Item(key, genuine, NOW, NOW, "firewall", "i", 1))
        for value in (*mutations(genuine), {"entries": ["no address"]}):
            try:
                decode(Item(key, carried(value), NOW, NOW, "firewall", "i", 1))
            except MessageError:
                continue
        with pytest.raises(MessageError, match="not the app"):
            decode(Item(key, genuine, NOW, NOW, "kitsune", "i", 1))
