"""benchmarks.syn_flood: what innocent traffic leads to, with the firewall fed as it is in the pipeline."""

from benchmarks.syn_flood_innocent import decisions_on, generated_day


def test_a_minute_of_benign_traffic_blocks_nobody():
    assert decisions_on(generated_day(60, 1))["block"] == 0


def test_a_flood_among_it_is_decided():
    """Seven minutes of the generated network have a server that is gone: it is guarded."""
    assert decisions_on(generated_day(420, 1))["protect"] > 0
