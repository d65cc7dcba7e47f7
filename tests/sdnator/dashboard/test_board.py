"""Whatever comes in, the board keeps the newest, bounded, and counts what it saw."""

import numpy as np
from msgspec import structs

from apps.messages import Alert, Confirmation, Decision, Sender, Target
from sdnator.dashboard.board import (
    ALERTS_KEPT,
    BINS,
    DECISIONS_KEPT,
    INCIDENTS_KEPT,
    NAMES_KEPT,
    Board,
)
from tests.sdnator.incidents.samples import life


def scored(*scores):
    values = np.array(scores)
    return {
        "count": len(scores),
        "over": int((values >= 1).sum()),
        "max": float(values.max()),
        "score": values,
    }


def decision(number, action="block", address="192.0.2.1"):
    return Decision(
        id=str(number), action=action, switch="s1", target=Target(kind="ip", address=address),
        reason="", event_time=number, expires=0,
    )  # fmt: skip


def on(switch, one):
    return Decision(**({name: getattr(one, name) for name in one.__struct_fields__} | {"switch": switch}))


def alert(number):
    return Alert(
        id=str(number), sender=Sender(switch="s1", port=1, mac="02:00:00:00:00:01"), event_time=number,
        first_packet=0, packets=1, over=1, peak_score=2.0, anomalous_seconds=1, rate=1.0, training_rate=1.0,
        mac_addresses=1, reason="",
    )  # fmt: skip


def test_scores_are_gathered_in_slices_of_time():
    board = Board(history_s=240.0)
    board.score(scored(0.1, 0.3), 100.0)
    board.score(scored(2.0), 100.5)
    board.score(scored(0.5), 101.5)
    first, second = board.scores.bins
    assert (first.count, first.over, first.highest, round(first.total, 3)) == (3, 1, 2.0, 2.4)
    assert (second.count, second.over) == (1, 0)
    assert board.scores.rate(101.6, 2.0) == 2.0


def test_everything_is_bounded():
    board = Board(history_s=24.0)
    for number in range(2_000):
        board.score(scored(0.1), number * 0.2)
        board.alert(alert(number))
        board.decide([decision(number, address=f"10.0.{number // 250}.{number % 250}")])
        board.confirm(
            Confirmation(id=str(number), switch="s1", state="installed", action="block", event_time=0)
        )
        board.switch({"switch": f"s{number}"})
        board.healthy(f"app{number}", {}, float(number))
    assert len(board.scores.bins) == BINS
    assert len(board.alerts) == ALERTS_KEPT
    assert len(board.decisions) == len(board.answers) == DECISIONS_KEPT
    assert len(board.switches) == len(board.health) == NAMES_KEPT
    assert board.counts["alerts"] == 2_000


def test_the_latest_decision_of_a_target_holds():
    board = Board()
    board.decide([decision(1), decision(2, address="192.0.2.2"), decision(3, "unblock")])
    assert [each.id for each in board.standing()] == ["2"]
    board.decide([decision(4)])
    assert [each.id for each in board.standing()] == ["4", "2"]


def test_a_decision_for_every_switch_stands_once():
    """A switch that comes later is told by itself."""
    board = Board()
    general = on("*", decision(1, "protect"))
    board.decide([general, on("s1", general)])
    longer = Decision(**{name: getattr(general, name) for name in general.__struct_fields__} | {"expires": 9})
    assert board.standing() == [general]
    board.decide([longer])
    assert board.standing() == [longer]
    other = on("s1", decision(2))
    board.decide([other])
    assert board.standing() == [other, longer]


def test_what_is_lifted_for_every_switch_is_lifted_for_each():
    """Also for one whose decision came before the general one."""
    board = Board()
    board.switch({"switch": "s1"})
    board.decide([decision(1, "protect"), decision(2, "protect", address="192.0.2.2")])
    board.decide([on("*", decision(3, "unprotect"))])
    assert [each.id for each in board.standing()] == ["2"]


def test_rates_follow_from_two_looks_and_a_new_instance_begins_at_none():
    board = Board()

    def look(written, now):
        instances = [
            {"app_id": "a", "instance_id": "1", "state": "active", "written": written, "received": 0}
        ]
        board.coordinated([{"app_id": "a", "states": {"active": 1}}], instances, [], now)

    look(100, 10.0)
    assert board.rates == {}
    look(150, 12.0)
    assert board.rates == {"a": (25.0, 0.0)}
    look(0, 14.0)
    assert board.rates == {"a": (0.0, 0.0)}


def test_rates_of_keys_follow_from_what_two_instances_say_of_themselves():
    board = Board()

    def say(instance, now, **keys):
        board.healthy("a", {"engine": {"instance": instance, "keys": keys}}, now)

    say("1", 10.0, x=100, y=7)
    say("2", 10.0, x=1_000)
    assert board.rates_by_key() == {}
    say("1", 12.0, x=150, y=7, new=5)
    say("2", 11.0, x=1_010)
    assert board.rates_by_key() == {"a": {"x": 35.0, "y": 0.0}}
    here = [{"app_id": "a", "instance_id": "1", "state": "active", "written": 0, "received": 0}]
    board.coordinated([], here, [], 12.0)
    assert board.rates_by_key()["a"]["x"] == 25.0, "who is gone writes nothing"


def test_apps_that_came_and_went_are_no_news_but_missing_parts_are():
    board = Board()
    apps = [{"app_id": name, "states": {"offline": 1}} for name in ("observe-1", "kitsune")]
    board.coordinated(apps, [], [], 1.0)
    assert [app["app_id"] for app in board.present()] == ["kitsune"]


def test_the_line_is_kitsunes_own():
    board = Board()
    assert board.threshold() is None
    board.healthy("kitsune", {"app": {"threshold": 1.25}}, 1.0)
    assert board.threshold() == 1.25


def test_a_topic_that_changes_gets_another_number():
    board = Board()
    before = board.versions["alerts"]
    board.alert(alert(1))
    assert board.versions["alerts"] != before
    assert board.versions["scores"] == 0


def test_parts_that_keep_dying_are_told_and_those_that_run_are_not():
    board = Board()
    health = {"state": "degraded", "cause": "kitsune was killed by SIGKILL", "restarts": 4}
    board.supervised({"kitsune": health, "firewall": {"state": "running", "cause": ""}})
    assert board.degraded == "kitsune is degraded: kitsune was killed by SIGKILL"
    board.supervised({})
    assert board.degraded == ""


def test_an_incident_is_one_row_as_last_reported():
    """Parts of another disappear, and open ones stay when there are too many."""
    board, (opened, *_, over) = Board(), life()
    board.incident(opened)
    assert board.open_incidents() == 1
    board.incident(over)
    assert (list(board.incidents), board.open_incidents()) == ([over.id], 0)
    board.incident(structs.replace(over, joined="another"))
    assert not board.incidents
    board.incident(opened)
    for number in range(2 * INCIDENTS_KEPT):
        board.incident(structs.replace(over, id=str(number)))
    assert len(board.incidents) == INCIDENTS_KEPT
    assert opened.id in board.incidents
