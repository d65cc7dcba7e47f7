"""The charts show what the board has: no more points than slices, every app, every arrow."""

import json

from sdnator.dashboard.board import Bin
from sdnator.dashboard.charts import flow_chart, score_chart, score_points, threshold, top
from sdnator.dashboard.texts import number

FLOW = [
    {"producer": "kitsune", "consumer": "firewall", "interest": "network.anomaly.kitsune.alert"},
    {"producer": "kitsune", "consumer": "firewall", "interest": "network.anomaly.kitsune.score:a=1"},
    {"producer": "stranger", "consumer": "kitsune", "interest": "x.y"},
]


def test_points_are_highest_and_mean_of_slices_that_have_some():
    highest, mean = score_points([Bin(1.0, 2, 1, 3.0, 2.5), Bin(2.0), Bin(3.0, 1, 0, 0.0, 0.0)], 0.5)
    assert highest == [[1000, 2.5], [3000, 0.001]], "a logarithmic axis has no zero"
    assert mean == [[1000, 1.5], [3000, 0.001]]


def test_the_threshold_is_drawn_where_it_is_known():
    assert threshold(1.5)["data"] == [{"yAxis": 1.5}]
    assert threshold(None)["data"] == []
    json.dumps(score_chart())


def test_the_axis_ends_above_scores_and_threshold_even_without_scores():
    assert [top([], None), top([0.2], 1.0), top([33.0], 1.0), top([], 2_000.0)] == [10, 10, 100, 10_000]


def test_apps_are_nodes_and_what_they_tell_each_other_is_one_arrow():
    options = flow_chart([{"app_id": "firewall"}], FLOW, {"kitsune": (12.0, 3.0)}, {})
    series = options["series"][0]
    assert {node["name"] for node in series["data"]} == {"firewall", "kitsune", "stranger"}
    arrows = {(one["source"], one["target"]): one["tooltip"]["formatter"] for one in series["links"]}
    assert arrows.keys() == {("kitsune", "firewall"), ("stranger", "kitsune")}
    assert "network.anomaly.kitsune.score" in arrows["kitsune", "firewall"]
    assert any("12/s" in node["label"]["formatter"] for node in series["data"])
    json.dumps(options)


def test_an_arrow_has_the_rates_of_the_keys_that_go_along_it():
    rates = {
        "network.anomaly.kitsune.score": 40.0,
        "network.anomaly.kitsune.alert": 2.0,
        "due.health.kitsune": 1.0,
    }
    both = [*FLOW, {"producer": "kitsune", "consumer": "firewall", "interest": "network.anomaly.kitsune.*"}]
    first, _ = flow_chart([], both, {}, {"kitsune": rates})["series"][0]["links"]
    assert first["label"]["formatter"] == "42/s", "what two interests want goes once"
    told = first["tooltip"]["formatter"].split("<br>")
    assert told == [
        "kitsune → firewall",
        "network.anomaly.kitsune.* 42/s",
        "network.anomaly.kitsune.score 40/s",
        "network.anomaly.kitsune.alert 2/s",
    ]


HOSTILE = "<img src=x onerror=alert(1)>{b|x}"


def test_names_from_outside_are_no_markup():
    """ECharts takes a tooltip's text as HTML, and {…} in it and in labels as its own."""
    flow = [{"producer": HOSTILE, "consumer": "firewall", "interest": f"x.{HOSTILE}"}]
    series = flow_chart([{"app_id": HOSTILE}], flow, {}, {})["series"][0]
    tips = [one["tooltip"]["formatter"] for one in (*series["data"], *series["links"])]
    for tip in tips:
        bare = tip.replace("<br>", "")
        assert not {"<", ">", "{", "}", '"'} & set(bare)
    assert "&lt;img src=x onerror=alert(1)&gt;" in "".join(tips)
    for one in series["data"]:
        assert "{" not in one["label"]["formatter"]


def test_numbers_are_short():
    shown = [number(value) for value in (0, 0.25, 3, 3.5, 17.2, 9_999, 12_345, 2_300_000)]
    assert shown == ["0", "0.2", "3", "3.5", "17", "9,999", "12.3 k", "2.3 M"]
