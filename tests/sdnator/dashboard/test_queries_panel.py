"""What the page tells of queries, from the adapter's own answers."""

from apps.sonata_adapter.control import Control
from apps.sonata_adapter.plan_answer import asked_of, plan_answer, plan_key
from apps.sonata_adapter.query.catalogue import CATALOGUE
from sdnator.dashboard.queries_panel import operator_rows, plan_text, query_rows

KEY = "network.traffic_query.sonata.syn_flood:threshold=7"


def test_a_key_survives_the_question():
    """Colons, commas and addresses are encoded; a wildcard asks for nothing."""
    for key in (KEY, "network.traffic_query.sonata.ddos:dst=2001%3Adb8%3A%3A/32,window=2s"):
        assert asked_of(plan_key(key)) == key
    assert not asked_of("network.query_plan.sonata_adapter:of=*")


def test_states_are_told_apart():
    """Wanted, possible, refused, wildcard."""
    control = Control(CATALOGUE)
    assert "this is where it would run, beside 0" in plan_text([plan_answer(KEY, control, CATALOGUE)])
    control.want([KEY])
    told = plan_answer(KEY, control, CATALOGUE) | {"results": 0, "last_result": 0, "monotonic_s": 1.0}
    text = plan_text([told, told | {"monotonic_s": 2.0, "came": told["came"] | {"tuples": 30}}])
    assert text.startswith("In force")
    assert "30 a second" in text
    rows = operator_rows(told)
    assert {row["runs"] for row in rows} == {"switch"}
    assert any("both sides count in one cell" in row["why"] for row in rows)
    assert query_rows(control.health())[0]["runs"] == "switch"
    refused = plan_answer("network.traffic_query.sonata.ddos:window=x", control, CATALOGUE)
    assert plan_text([refused]).startswith("refused: ")
    follows = plan_answer("network.traffic_query.sonata.ddos:window=*", control, CATALOGUE)
    assert follows["state"] == "follows"


def test_a_plan_beside_others_changes_nothing():
    """Asking what would be done for a key leaves plan and switch alone."""
    control = Control(CATALOGUE)
    control.want([KEY])
    before = control.plan
    answer = plan_answer("network.traffic_query.sonata.zorro", control, CATALOGUE)
    assert (answer["state"], answer["in_switch"], answer["others"]) == ("possible", True, 1)
    assert {each["place"] for each in answer["operators"]} == {"switch", "host"}
    assert any("passed the gate" in each["why"] for each in answer["operators"])
    assert control.plan is before
