"""Joins at a window's end against nested loops."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from apps.sonata_adapter.host.key_tables import Column
from apps.sonata_adapter.host.relations import Relation
from apps.sonata_adapter.query.dataflow import PacketSource, TableJoin, WindowTable

rows = st.lists(st.tuples(st.integers(0, 5), st.integers(0, 3)), max_size=12)
_NOTHING = WindowTable(PacketSource(()), (), (), ())


def relation(pairs, name):
    columns: dict[str, Column] = {"k": (np.array([k for k, _ in pairs], dtype=np.int64),)}
    columns[name] = (np.array([v for _, v in pairs], dtype=np.int64),)
    return Relation(columns, len(pairs))


def joined(left, right, kind):
    found = relation(left, "a").apply(TableJoin(_NOTHING, ("k",), kind), relation(right, "b"))
    columns = [found.columns[name][0].tolist() for name in sorted(found.columns)]
    return sorted(zip(*columns, strict=True), key=lambda row: (row[-1], row))


def naive(left, right, kind):
    out: list[tuple[int, ...]] = []
    for key, value in left:
        partners = [other for there, other in right if there == key]
        if kind == "anti":
            out += [] if partners else [(value, key)]
        elif partners:
            out += [(value, other, key) for other in partners]
        elif kind != "inner":
            out.append((value, 0, key))
    if kind == "outer":
        keys = {key for key, _ in left}
        out += [(0, other, key) for key, other in right if key not in keys]
    return sorted(out, key=lambda row: (row[-1], row))


@given(rows, rows, st.sampled_from(("inner", "left", "outer", "anti")))
def test_joins_equal_nested_loops(left, right, kind):
    """Also where keys stand on one side only, or several times on either."""
    assert joined(left, right, kind) == naive(left, right, kind)
