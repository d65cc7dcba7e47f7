"""Known sources: the most recent ones, in step with the switch."""

from hypothesis import given
from hypothesis import strategies as st

from apps.firewall.evidence.known_sources import DAY, HANDSHAKES, KnownSources, in_batches
from due import Item


def handshake(source: str, at: int) -> Item:
    value = {"source": source, "service": "10.0.0.1", "port": 80, "at": at}
    return Item(HANDSHAKES, value, at, at, "sonata_adapter", "i", 1)


def test_most_recent_sources_are_kept():
    """A new handshake renews a source; the longest silent one makes room."""
    known = KnownSources(2)
    for at, source in enumerate(("10.0.0.1", "10.0.0.2", "10.0.0.1", "10.0.0.3")):
        known.learn(source, at)
    assert sorted(known) == ["10.0.0.1", "10.0.0.3"]


def test_old_handshakes_do_not_count():
    """Age is measured in capture time, from the newest handshake back, and the switch hears of it."""
    known = KnownSources(10, days=2)
    for source, at in (("10.0.0.1", 0), ("10.0.0.2", DAY)):
        known.learn(source, at)
    known.changes()
    known.learn("10.0.0.3", 3 * DAY)
    assert sorted(known) == ["10.0.0.2", "10.0.0.3"]
    assert [(each.kind, each.match["src"]) for each in known.changes()] == [
        ("delete", "10.0.0.1"), ("insert", "10.0.0.3"),
    ]  # fmt: skip


def test_at_first_nobody_is_known():
    known = KnownSources(10)
    assert (len(known), known.everything()) == (0, [])


def test_updates_name_the_table_and_the_family():
    """IPv6 sources are told from IPv4 ones of the same number."""
    known = KnownSources(10)
    known.learn("::1", 1)
    (update,) = known.changes()
    assert (update.kind, update.table, update.match) == (
        "insert", "ingress.known_sources", {"is_ipv4": 0, "src": "::1"},
    )  # fmt: skip
    assert known.changes() == []


@given(st.lists(st.tuples(st.integers(0, 9), st.booleans()), max_size=60), st.integers(1, 4))
def test_switch_follows(events, limit):
    """Applying all changes in order gives exactly what is known, with no insert or delete in vain."""
    known = KnownSources(limit)
    switch: set[str] = set()
    for at, (number, look) in enumerate(events):
        known.learn(f"10.0.0.{number}", at)
        for update in known.changes() if look else ():
            source = update.match["src"]
            assert (source in switch) == (update.kind == "delete")
            (switch.discard if update.kind == "delete" else switch.add)(source)
    for update in known.changes():
        (switch.discard if update.kind == "delete" else switch.add)(update.match["src"])
    assert switch == set(known)
    assert len(known) <= limit


def test_commands_are_cut():
    """A switch is not given thousands of entries in one command."""
    known = KnownSources(500)
    for number in range(450):
        known.learn(f"10.0.{number // 256}.{number % 256}", number)
    assert [len(batch) for batch in in_batches(known.everything())] == [200, 200, 50]
