"""The dialect means what MongoDB's manual says, wrong queries are explained, translations never lose a match."""

import datetime as dt
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from due.drivers.query import parse
from due.drivers.query_tree import Condition
from due.errors import InvalidKey, InvalidQuery
from due.messages import Item, RecordBatch

T0 = 1_700_000_000_000_000_000


def item(value: Any = None, **fields: Any) -> Item:
    defaults: dict[str, Any] = {
        "key": "a.b:f=1",
        "timestamp": T0,
        "event_time": T0,
        "app_id": "app",
        "instance_id": "i",
        "sequence": 5,
    }
    return Item(value=value, **(defaults | fields))


@pytest.mark.parametrize(
    ("query", "value", "matches"),
    [
        ({"value": 5}, 5, True),
        ({"value": 5}, 5.0, True),
        ({"value": 1}, True, False),
        ({"value": "5"}, 5, False),
        ({"value": None}, None, True),
        ({"value.a": None}, {}, True),
        ({"value.a": None}, {"a": 1}, False),
        ({"value.a": {"$exists": True}}, {"a": None}, True),
        ({"value.a": {"$exists": False}}, {"a": None}, False),
        ({"value": {"$gt": 3}}, 4, True),
        ({"value": {"$gt": 3}}, "4", False),
        ({"value": {"$gt": 3, "$lt": 5}}, 4, True),
        ({"value": {"$gt": 3}}, float("nan"), False),
        ({"value": {"$lte": float("nan")}}, float("nan"), True),
        ({"value": float("nan")}, float("nan"), True),
        ({"value": {"$ne": float("nan")}}, float("nan"), False),
        ({"value": {"$not": {"$gt": 3}}}, "text", True),
        ({"value": {"$gt": "a"}}, "b", True),
        ({"value": {"$gte": b"b"}}, b"b", True),
        ({"value": {"$gt": False}}, True, True),
        ({"value": [1, 2]}, [1, 2], True),
        ({"value": 2}, [1, 2], True),
        ({"value": {"$gt": 1}}, [0, 2], True),
        ({"value": {"$ne": 2}}, [1, 2], False),
        ({"value.1": 2}, [1, 2], True),
        ({"value.a": 1}, [{"a": 1}, {"a": 2}], True),
        ({"value.a.b": 1}, {"a": {"b": 1}}, True),
        ({"value": {"$size": 2}}, [1, 2], True),
        ({"value": {"$in": [1, None]}}, None, True),
        ({"value": {"$nin": [1, 2]}}, 3, True),
        ({"value": {"a": 1, "b": 2}}, {"b": 2, "a": 1}, True),
        ({"value": {"a": 1}}, {"a": 1, "b": 2}, False),
        ({"value": {"$regex": "^b"}}, "abc", False),
        ({"value": {"$regex": "B", "$options": "i"}}, "abc", True),
        ({"value": re.compile("c$")}, ["x", "abc"], True),
        ({"value.x": {"$gt": 8}}, RecordBatch({"x": np.arange(10)}), True),
        ({"value": {"$gt": 9}}, np.arange(10), False),
        ({"value": {"$lt": dt.datetime(2024, 1, 1, tzinfo=dt.UTC)}}, np.datetime64("2023-12-31", "ns"), True),
        ({"value": {"$eq": dt.datetime(2024, 1, 1)}}, dt.datetime(2024, 1, 1, tzinfo=dt.UTC), True),  # noqa: DTZ001
        ({"$or": [{"value": 1}, {"value": 2}]}, 2, True),
        ({"$nor": [{"value": 1}, {"value": 2}]}, 2, False),
        ({"$and": [{"value": {"$gt": 1}}, {"$or": [{"value": 3}, {"value": 2}]}]}, 2, True),
        ({"$nor": [{"value": 2, "sequence": 6}]}, 2, True),
        ({"value": {"$not": {"$gt": 1, "$lt": 3}}}, 2, False),
        ({"value": {"$not": {"$gt": 1, "$lt": 3}}}, 3, True),
    ],
)
def test_what_a_query_means(query: dict[str, Any], value: Any, matches: bool) -> None:
    parsed = parse(query)
    assert parsed.matches(item(value)) is matches
    assert parsed.matches_metadata(item()) or not matches


@pytest.mark.parametrize(
    ("query", "matches"),
    [
        ({"dataKey": "a.b"}, True),
        ({"dataKey": "a.*"}, True),
        ({"dataKey": "a.b:f=2"}, False),
        ({"dataKey": {"$in": ["x", "**"]}}, True),
        ({"dataKey": {"$ne": "a.b"}}, False),
        ({"dataKey": {"$regex": "f=1$"}}, True),
        ({"timestamp": T0}, True),
        ({"timestamp": {"$gt": T0}}, False),
        ({"timestamp": {"$not": {"$gt": T0}}}, True),
        ({"eventTime": {"$lte": np.datetime64(T0, "ns")}}, True),
        ({"appId": "app", "instanceId": {"$ne": "j"}}, True),
        ({"sequence": {"$in": [4, 5]}}, True),
        ({"sequence": {"$nin": [4, 5]}}, False),
        ({"sequence": {"$exists": True}}, True),
        ({"appId": {"$exists": False}}, False),
        ({}, True),
    ],
)
def test_what_a_query_means_on_metadata(query: dict[str, Any], matches: bool) -> None:
    parsed = parse(query)
    assert parsed.matches(item()) is matches
    assert not parsed.uses_value


@pytest.mark.parametrize(
    ("query", "complaint"),
    [
        ([], "mapping"),
        ({"colour": 1}, "colour"),
        ({"timestamp.x": 1}, "timestamp.x"),
        ({5: 1}, "5"),
        ({"$where": "x"}, r"\$where"),
        ({"$or": []}, r"\$or takes a list"),
        ({"$and": [1]}, "1 is not one"),
        ({"value": {"$near": 1}}, r"\$near"),
        ({"value": {"$gt": 1, "b": 2}}, "do not mix"),
        ({"value": {"$in": 5}}, "take a list"),
        ({"value": {"$gt": None}}, "compares numbers"),
        ({"value": {"$gt": [1]}}, "compares numbers"),
        ({"value": {"$size": -1}}, "count"),
        ({"value": {"$not": 5}}, r"\$not takes"),
        ({"value": {"$regex": "("}}, "regular expression"),
        ({"value": {"$regex": "a", "$options": "q"}}, r"\$options 'q'"),
        ({"timestamp": "yesterday"}, "datetime or int"),
        ({"timestamp": 1.5}, "datetime or int"),
        ({"timestamp": 2**63}, "datetime or int"),
        ({"timestamp": True}, "datetime or int"),
        ({"timestamp": {"$regex": "1"}}, "is a number"),
        ({"timestamp": {"$size": 1}}, "counts the elements"),
        ({"sequence": "1"}, "64 bits"),
        ({"appId": 5}, "compare with text"),
        ({"dataKey": 5}, "compare with text"),
        ({"dataKey": {"$gt": "a"}}, "no meaning on keys"),
    ],
)
def test_wrong_queries_are_explained(query: Any, complaint: str) -> None:
    with pytest.raises(InvalidQuery, match=complaint):
        parse(query)


def _nested(operator: str, depth: int) -> dict[str, Any]:
    query: dict[str, Any] = {"$eq": 1} if operator == "$not" else {"value": 1}
    for _ in range(depth):
        query = {operator: query} if operator == "$not" else {operator: [query]}
    return {"value": query} if operator == "$not" else query


@pytest.mark.parametrize(
    ("query", "complaint"),
    [
        (_nested("$not", 5000), "levels"),
        (_nested("$and", 5000), "levels"),
        (_nested("$nor", 5000), "levels"),
        ({"value": {"$in": list(range(30_000))}}, "elements"),
        ({"$or": [{"value": 1}] * 30_000}, "elements"),
        ({"value": "x" * 2_000_000}, "characters"),
        ({"value": {"$regex": "a" * 1001}}, "characters"),
        ({"value": {"$regex": r"(a)\1"}}, "linear time"),
        ({"value": {"$regex": "(?=a)"}}, "linear time"),
        ({"value": {"$regex": "(((a{99}){99}){99})"}}, "linear time"),
        ({"value": re.compile("a b", re.VERBOSE)}, "only I, M and S"),
        ({"value": re.compile(b"a")}, "take text"),
    ],
)
def test_queries_have_bounds(query: Any, complaint: str) -> None:
    with pytest.raises(InvalidQuery, match=complaint):
        parse(query)


@pytest.mark.timeout(20)
def test_a_regular_expression_takes_time_by_the_length_of_the_text_only() -> None:
    """A backtracking matcher would be at it until the end of days."""
    assert not parse({"value": {"$regex": r"^((\w|\.)+)+!$"}}).matches(item("a." * 100_000))
    assert parse({"dataKey": {"$regex": r"^((\w|\.)+)+$"}}).matches(item(key="a." * 100 + "b"))


_SCALARS = (
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9) | st.binary(max_size=4)
)
_WORDS = ["$and", "$or", "$nor", "$not", "$eq", "$gt", "$in", "$regex", "$options", "$size", "$exists"]
_FIELDS = [
    "value",
    "value.1",
    "value.²",
    "value.a." + "9" * 5000,
    "dataKey",
    "timestamp",
    "appId",
    "sequence",
]
_VALUES = st.recursive(
    _SCALARS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=2), inner, max_size=3),
)
_QUERIES = st.dictionaries(
    st.sampled_from(_FIELDS + _WORDS),
    st.recursive(
        _SCALARS,
        lambda inner: (
            st.lists(inner, max_size=3)
            | st.dictionaries(st.sampled_from(_WORDS + _FIELDS), inner, max_size=3)
        ),
    ),
    max_size=3,
)


@given(_QUERIES, _VALUES)
def test_whatever_is_asked_is_answered_or_refused(query: dict[str, Any], value: Any) -> None:
    try:
        parsed = parse(query)
    except (InvalidQuery, InvalidKey):
        return
    assert parsed.matches(item(value)) in (True, False)


@given(_VALUES, _VALUES, st.sampled_from(["$eq", "$gt", "$lte", "$in"]))
def test_any_value_compares_with_any_operand(value: Any, operand: Any, operator: str) -> None:
    try:
        parsed = parse({"value": {operator: operand}})
    except InvalidQuery:
        return
    assert parsed.matches(item(value)) in (True, False)


def test_a_malformed_key_is_named() -> None:
    with pytest.raises(InvalidKey) as raised:
        parse({"dataKey": {"$in": ["a.b", "a..b"]}})
    assert raised.value.key == "a..b"


def test_sql_has_no_text_of_the_user() -> None:
    hostile = "x') OR 1=1 --"
    parsed = parse(
        {"appId": hostile, "value": hostile, "$or": [{"instanceId": hostile}, {"value.a'": hostile}]}
    )
    text, parameters = parsed.to_sql(lambda _: [7], {})
    assert hostile not in text
    assert parameters == ["[7]"]


def test_sql_bounds_are_widened_by_the_span() -> None:
    text, parameters = parse({"timestamp": {"$gte": 100, "$lt": 200}}).to_sql(lambda _: [], {"timestamp": 30})
    assert text == "((last_time >= ? AND first_time >= ?) AND (first_time <= ?))"
    assert parameters == [100, 70, 200]


def test_mongo_gets_one_flat_document_where_it_can() -> None:
    query = {
        "dataKey": "a.b",
        "timestamp": {"$gte": 100},
        "appId": "x",
        "value.n": {"$gt": 3},
        "value.q": {"$ne": 1},
    }
    filtered = parse(query).to_mongo(lambda _: ["a.b"], {"timestamp": 30})
    assert filtered == {
        "dataKey": {"$eq": "a.b"},
        "lastTimestamp": {"$gte": 100},
        "timestamp": {"$gte": 70},
        "appId": {"$eq": "x"},
        "$and": [{"$or": [{"value.n": {"$gt": 3}}, {"payload": {"$exists": True}}]}],
    }


def test_an_impossible_query_stays_impossible() -> None:
    impossible: list[dict[str, Any]] = [
        {"$nor": [{}]},
        {"timestamp": {"$in": []}},
        {"sequence": {"$exists": False}},
    ]
    for query in impossible:
        parsed = parse(query)
        assert not parsed.matches(item())
        assert parsed.to_sql(lambda _: [], {})[0].strip("()") == "0"
        assert parsed.to_mongo(lambda _: [], {}) == {"dataKey": {"$in": []}}


json_like = st.recursive(
    st.one_of(
        st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=3), st.binary(max_size=3)
    ),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.dictionaries(
            st.one_of(
                st.sampled_from(["$and", "$or", "$not", "$in", "value", "timestamp", "dataKey"]),
                st.text(max_size=3),
            ),
            inner,
            max_size=3,
        ),
    ),
    max_leaves=8,
)


@given(json_like)
def test_any_input_is_either_understood_or_refused(query: Any) -> None:
    try:
        parsed = parse(query)
    except (InvalidQuery, InvalidKey):
        return
    assert parsed.matches(item({"a": [1, {"b": 2}]})) in (True, False)
    parsed.to_sql(lambda _: [1], {})
    parsed.to_mongo(lambda _: ["a"], {})


def test_conditions_that_every_result_meets() -> None:
    parsed = parse({"dataKey": "a", "$or": [{"dataKey": "b"}, {"value": 1}]})
    (condition,) = parsed.conditions("dataKey")
    assert isinstance(condition, Condition)
    assert condition.operand.text == "a"
