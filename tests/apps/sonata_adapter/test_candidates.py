"""Counts at which a key may become a result: as high as no result is missed."""

import pytest

from apps.sonata_adapter.candidates import candidates
from apps.sonata_adapter.catalogue import CATALOGUE
from apps.sonata_adapter.dataflow import compile_query


@pytest.mark.parametrize(
    ("name", "values", "counts"),
    [
        # syns + syn_acks - acks >= 3: one of the two is at least 2
        ("syn_flood", {}, [2, 2, 0]),
        ("syn_flood", {"threshold": 101}, [51, 51, 0]),
        ("incomplete_flows", {"threshold": 7}, [7, 0]),
        # bytes >= 500 and bytes <= 90 * connections: more connections than the 5 that are asked for
        ("slowloris", {}, [6, 0]),
        ("slowloris", {"connections": 9}, [9, 0]),
    ],
)
def test_candidates(name, values, counts):
    """Conditions on one count make those on several stronger."""
    assert candidates(compile_query(CATALOGUE[name].query(values))) == counts
