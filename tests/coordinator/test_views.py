"""Every DUE value has a JSON form that strict readers take."""

import datetime as dt
import json
from typing import Any

import numpy as np
import pytest

from coordinator import views
from due import Item, RecordBatch


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (None, None),
        (True, True),
        (2**63 - 1, 2**63 - 1),
        (1.5, 1.5),
        (float("nan"), "nan"),
        (float("-inf"), "-inf"),
        ("text", "text"),
        (b"\x00\xff", {"$bytes": "AP8="}),
        (dt.datetime(2024, 2, 29, 12, tzinfo=dt.UTC), "2024-02-29T12:00:00+00:00"),
        (np.datetime64(5, "ns"), "1970-01-01T00:00:00.000000005"),
        ([1, [b"a"], {"x": float("inf")}], [1, [{"$bytes": "YQ=="}], {"x": "inf"}]),
        (np.array([[1, 2], [3, 4]], np.uint8), [[1, 2], [3, 4]]),
        (np.array([1.0, np.nan]), [1.0, "nan"]),
        (np.array([0], "datetime64[s]"), ["1970-01-01T00:00:00"]),
        (np.float32(0.5), 0.5),
        (RecordBatch({"a": np.arange(3), "b": np.array([b"x", b"y", b"z"])}), {"a": [0, 1, 2], "b": [{"$bytes": "eA=="}, {"$bytes": "eQ=="}, {"$bytes": "eg=="}]}),
    ],
)  # fmt: skip
def test_values(value: Any, shown: Any) -> None:
    assert views.value(value) == shown
    json.dumps(views.value(value), allow_nan=False)


def test_items_carry_the_names_that_queries_use() -> None:
    item = Item("a.b", 1, 2, 3, "app", "instance", 4)
    assert views.item(item) == {
        "dataKey": "a.b",
        "value": 1,
        "timestamp": 2,
        "eventTime": 3,
        "appId": "app",
        "instanceId": "instance",
        "sequence": 4,
    }
