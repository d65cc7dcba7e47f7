"""Packets of flows that a window has seen."""

import random

import numpy as np

from apps.sonata_adapter.host import key_tables as tables
from apps.sonata_adapter.host.columns import PacketColumns
from apps.sonata_adapter.host.flows import SeenFlows
from sdnator.testing.query_traffic import batches, office


def test_every_flow_of_a_window_is_there_and_few_packets_more(monkeypatch):
    """The first packet of each; a new window and forgetting begin anew.

    How many more depends on which flows meet in a slot, that is, on constants that are drawn at each start.
    """
    monkeypatch.setattr(
        tables, "_ODD", np.random.default_rng(1).integers(2**63, size=24, dtype=np.uint64) | 1
    )
    seen, rows = SeenFlows(), 0
    for number, batch in enumerate(batches(sorted(office(20, random.Random(3), long=True)), 500)):
        if number % 5 == 0:
            seen.begin(number)
            known = set()
        packets = PacketColumns(batch)
        bits, kept = packets.flows().tolist(), seen.new(packets).origin.tolist()
        fresh = {bit: row for row, bit in reversed(list(enumerate(bits))) if bit not in known}
        assert set(fresh.values()) <= set(kept)
        assert kept == sorted(kept)
        rows += len(kept) - len(fresh)
        known |= set(bits)
    assert rows < 50
    assert not len(seen.new(packets))
    seen.forget()
    assert len(seen.new(packets)) == len(set(bits))
