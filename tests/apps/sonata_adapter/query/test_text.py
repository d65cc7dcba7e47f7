"""The text form says the same as the fluent form, and errors say where they are."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from apps.sonata_adapter.errors import QueryTextError
from apps.sonata_adapter.query.catalogue import CATALOGUE
from apps.sonata_adapter.query.expressions import (
    PACKET_FIELDS,
    BinaryOperation,
    Contains,
    Field,
    Not,
    Number,
    Within,
    text_of,
)
from apps.sonata_adapter.query.language import Filter, Query
from apps.sonata_adapter.query.text import parse_queries

NUMBERS = sorted(name for name, (kind, _) in PACKET_FIELDS.items() if kind in ("number", "mac"))
numbers = st.recursive(
    st.one_of(st.builds(Field, st.sampled_from(NUMBERS)), st.builds(Number, st.integers(0, 2**40))),
    lambda inner: st.builds(
        BinaryOperation, st.sampled_from(("+", "-", "*", "/", "%", "&", "|")), inner, inner
    ),
    max_leaves=6,
)
addresses = st.builds(
    Within,
    st.sampled_from((Field("ip.src"), Field("ip.dst"))),
    st.sampled_from(("10.0.0.0/8", "192.0.2.1/32", "2001:db8::/32", "::1/128", "0.0.0.0/0")),
)
conditions = st.recursive(
    st.one_of(
        st.builds(BinaryOperation, st.sampled_from(("==", "!=", "<", "<=", ">", ">=")), numbers, numbers),
        addresses,
        st.builds(Contains, st.binary(min_size=1, max_size=8)),
    ),
    lambda inner: st.one_of(
        st.builds(BinaryOperation, st.sampled_from(("and", "or")), inner, inner), st.builds(Not, inner)
    ),
    max_leaves=6,
)


@pytest.mark.parametrize("name", CATALOGUE)
def test_catalogue_survives_its_text(name):
    """Every query of the catalogue, written out and read again, is the same query."""
    query = CATALOGUE[name].query()
    (template,) = parse_queries(query.text())
    assert template.query() == query


@given(conditions)
def test_conditions_survive_their_text(condition):
    """Brackets are written exactly where they are needed."""
    text = f"query q:\n    filter {text_of(condition)}\n"
    (template,) = parse_queries(text)
    assert template.query().steps == (Filter(condition),)


@given(st.text(max_size=200))
def test_any_text_is_a_query_or_an_error_with_a_place(text):
    """Nothing else is ever raised."""
    try:
        parse_queries(text)
    except QueryTextError as error:
        place = (error.line, error.column)
    else:
        place = (1, 1)
    assert place >= (1, 1)


@pytest.mark.parametrize(
    ("text", "line", "column", "what"),
    [
        ("", 1, 1, "no query"),
        ("query q:\n", 1, 1, "no steps"),
        ("query q:\n  filter tcp.dprot == 1", 2, 3, "did you mean tcp.dport"),
        ("query q:\n  filter tcp.dport = 1", 2, 20, "expected the end of the line, found ="),
        ("query q:\n  filter tcp.dport ==", 2, 22, "expected a field or a number, found the end of the line"),
        ("query q:\n  filter tcp.dport", 2, 3, "filter needs a condition"),
        ("query q:\n  filter tcp.dport == 10.0.0.1/99", 2, 23, "not an address or prefix"),
        ("query q(window=3):\n  filter tcp.dport == 1", 1, 16, "not a duration"),
        ("query q(n=0):\n  filter tcp.dport == n", 1, 11, "whole number from 1"),
        ("query q:\n  map src = ip.src\n    distinct", 3, 5, "there is nothing beneath map"),
        ("query q:\n  reduce by dst: n = count()", 2, 3, "unknown field dst"),
        ("query q:\n  map a = ip.src\n  reduce by a: n = average(a)", 3, 20, "count(), sum"),
        ('query q:\n  map a = ip.src\n  filter payload contains "x"', 3, 3, "packets only"),
        ("query q:\n  foo", 2, 3, "expected filter, map"),
        (
            "query q:\n  gate dst = ip.dst: count() >= 3 where udp.sport == 53",
            2,
            1,
            "no steps behind its gate",
        ),
        (
            "query q:\n  gate dst = ip.dst: count() > 3 where udp.sport == 53\n  distinct",
            2,
            30,
            "expected '>='",
        ),
        (
            "query q:\n  gate dst = ip.dst: count() >= 0 where udp.sport == 53\n  distinct",
            2,
            33,
            "out of bounds",
        ),
        (
            "query q:\n  gate dst = ip.dst: count() >= foo where udp.sport == 53\n  distinct",
            2,
            33,
            "expected a whole number, found foo",
        ),
        (
            "query q:\n  gate dst = ip.dst: count() >= 3 where udp.sport\n  distinct",
            2,
            3,
            "needs a condition",
        ),
        (
            "query q:\n  gate dst = ip.dst: count() >= 3 where udp.sport == 53\n  map a = ip.src\n  distinct",
            2,
            3,
            "makes dst",
        ),
        ("query q:\n  filter a $ 1", 2, 12, "'$' is not allowed"),
        ("query q:\n  distinct\nquery q:\n  distinct", 2, 3, "distinct needs a map"),
    ],
)
def test_errors_say_line_and_column(text, line, column, what):
    """A reader finds the place at once."""
    with pytest.raises(QueryTextError) as caught:
        parse_queries(text, "my.sonata")
    assert what in str(caught.value)
    assert (caught.value.line, caught.value.column) == (line, column)
    assert str(caught.value).startswith(f"my.sonata:{line}:{column}:")


def test_parameters_become_numbers_of_the_key():
    """A parameter has its default, and keys may give another value."""
    (template,) = parse_queries(
        "query big(window=500ms, most=7):\n  map dst = ip.dst\n  reduce by dst: n = count()\n  filter n > most\n"
    )
    assert template.query().window_ms == 500
    assert "n > 7" in template.query().text()
    assert "n > 9" in template.query({"most": 9}).text()


def test_join_stands_beneath():
    """The other side of a join is indented further."""
    (template,) = parse_queries(
        """
query open(window=2s):
    filter tcp.flags == SYN
    map dst = ip.dst
    reduce by dst: syns = count()
    join left on dst with:
        filter tcp.flags == FIN  # either side closes
        map dst = ip.src
        reduce by dst: fins = count()
    map dst, count = syns - fins
    filter count >= 2
"""
    )
    expected = CATALOGUE["incomplete_flows"].query({"window": 2000, "threshold": 2})
    assert template.query() == Query("open", 2000, expected.steps)
