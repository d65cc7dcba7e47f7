"""What was said about somebody is remembered while it counts."""

from apps.sonata_adapter.evidence.watched_query import HALF_LIFE_US, SaidSoFar


def test_only_what_is_new_is_said() -> None:
    said = SaidSoFar()
    assert said.added(("10.0.0.1",), 5.0, 0) == 5.0
    assert said.added(("10.0.0.1",), 5.5, 1) == 0.0
    assert said.added(("10.0.0.1",), 5.5, HALF_LIFE_US) == 3.0


def test_whose_evidence_has_faded_is_forgotten() -> None:
    """A network meets ever new addresses; after hours nothing is left of what was said, however much it was."""
    said = SaidSoFar()
    for hour in range(48):
        for number in range(10):
            said.added((f"10.0.{hour}.{number}",), 1_000.0, hour * 6 * HALF_LIFE_US)
    assert len(said) == 30
    assert said.added(("10.0.0.0",), 1_000.0, 48 * 6 * HALF_LIFE_US) == 1_000.0
