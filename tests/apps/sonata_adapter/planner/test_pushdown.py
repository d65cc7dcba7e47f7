"""Counts at which a key may become a result: as high as no result is missed."""

import pytest

from apps.sonata_adapter.planner.pushdown import Difference, candidates, difference
from apps.sonata_adapter.query.catalogue import CATALOGUE
from apps.sonata_adapter.query.dataflow import compile_query
from apps.sonata_adapter.query.language import Query, count, field, ip, tcp


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


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("syn_flood", Difference((1, 1, -1), 3)),
        ("incomplete_flows", Difference((1, -1), 1)),
        ("dns_tunnel", Difference((1, -1), 40)),
        ("slowloris", None),
        ("zorro", None),
    ],
)
def test_which_queries_are_one_difference(name, found):
    """Those whose result is the threshold's own sum; the planner sees to whether the switch can count it."""
    assert difference(compile_query(CATALOGUE[name].query())) == found


def _ends(kind, *shown):
    syns = QUERY.filter(tcp.flags == 2).map(dst=ip.dst).reduce("dst", syns=count())
    ends = QUERY.filter(tcp.flags == 1).map(dst=ip.src).reduce("dst", ends=count())
    return syns.join(ends, "dst", kind=kind).map("dst", *shown, count=field("syns") - field("ends"))


QUERY = Query("ends", 3_000)


@pytest.mark.parametrize(
    ("query", "is_one"),
    [
        (_ends("left").filter(field("count") >= 2), True),
        (_ends("outer").filter(field("count") > 0), True),
        (_ends("inner").filter(field("count") >= 2), False),  # needs both
        (_ends("left", "syns").filter(field("count") >= 2), False),  # says more
        (_ends("left").filter(field("count") >= 0), False),  # hosts without any packet, too
        (_ends("left").filter(field("count") <= 5), False),
        (_ends("left").filter(field("count") + field("count") >= 5), False),  # a step of 2
    ],
)
def test_a_difference_is_all_that_a_result_depends_on(query, is_one):
    """Each key that the sum says is a result is one, and has nothing else to tell."""
    assert (difference(compile_query(query)) is not None) == is_one
