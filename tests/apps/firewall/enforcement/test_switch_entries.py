"""The firewall's own entries fit the program's tables."""

import pytest

from apps.firewall.enforcement.switch_entries import (
    LIMIT,
    AllowEntries,
    allow_update,
    is_prefix,
    prefix_update,
)
from apps.messages import TableCommand, Target
from sdnator.testing.product_program import program


@pytest.mark.parametrize(
    ("entry", "shown"),
    [
        ("10.0.0.1", "10.0.0.1"),
        ("10.0.0.0/8", "10.0.0.0"),
        ("2001:db8::/32", "2001:db8::"),
        ("02:00:00:00:00:AA", "02:00:00:00:00:aa"),
        ("0.0.0.0/0", "is_ipv4"),
    ],
)
def test_allowed_entries_are_entries_of_the_program(entry, shown):
    """As the controller makes them, after a trip over the wire."""
    update = allow_update(entry)
    command = TableCommand.from_value(TableCommand(id="c", updates=(update,)).to_value())
    made = program().entry(command.updates[0])
    assert made.priority > 0
    assert shown in program().describe(made)


@pytest.mark.parametrize("prefix", ["192.0.2.0/24", "2001:db8::/64"])
def test_blocked_prefixes_are_entries_of_the_program(prefix):
    """Inserted and deleted under the same match."""
    inserted, deleted = (program().entry(prefix_update(kind, prefix)) for kind in ("insert", "delete"))
    assert inserted.match == deleted.match
    assert inserted.priority == deleted.priority
    assert is_prefix(Target(kind="ip", address=prefix))
    assert not is_prefix(Target(kind="ip", address="192.0.2.1"))


def test_changes_of_the_allow_list():
    """What is new is inserted, what is gone deleted; a new switch gets everything."""
    entries = AllowEntries()
    assert [each.kind for each in entries.change(["10.0.0.1", "10.0.0.2"])] == ["insert", "insert"]
    assert entries.change(["10.0.0.1", "10.0.0.2"]) == []
    changed = entries.change(["10.0.0.2", "10.0.0.3"])
    assert [each.kind for each in changed] == ["delete", "insert"]
    assert len(entries.everything()) == 2


def test_entries_that_mean_the_same_are_one_in_the_table():
    """It stays until the last of them is gone."""
    entries = AllowEntries()
    both = ["10.0.0.1", "10.0.0.1/32", "02:00:00:00:00:AA", "02:00:00:00:00:aa"]
    assert [each.kind for each in entries.change(both)] == ["insert", "insert"]
    assert entries.change(both[1:]) == []
    assert entries.change(both[1::2]) == []
    assert [each.kind for each in entries.change([])] == ["delete", "delete"]


def test_table_has_room_for_so_many():
    """The others are heeded by decisions only, and counted."""
    entries = AllowEntries()
    assert len(entries.change([f"10.0.{n // 250}.{n % 250}" for n in range(LIMIT + 7)])) == LIMIT
    assert entries.left_out == 7
