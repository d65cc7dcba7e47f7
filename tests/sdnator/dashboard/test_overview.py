"""The first page says in one sentence how things are, and tells an incident in order of time."""

import pytest

from apps.incidents import Incident, IncidentAction
from apps.messages import Sender
from apps.talkers import Talker, TopTalkers
from sdnator.dashboard.board import Board
from sdnator.dashboard.charts import score_points
from sdnator.dashboard.overview import asked_rows, health, port_rows, talker_rows, timeline

SECOND = 10**9
WELL = {
    "switch": "s1",
    "connected": True,
    "primary": True,
    "telemetry": ["packets"],
    "packet_in": 100,
    "lost": 0,
}


def board(**state):
    found = Board()
    found.switch(WELL | state, 1.0)
    found.coordinated([{"app_id": "kitsune", "states": {"active": 1}}], [], [], 1.0)
    return found


def test_all_is_well():
    assert health(board()).text == "Guarding 1 switch; no open incident; nothing lost."
    assert health(board()).level == "well"


@pytest.mark.parametrize(
    ("state", "level", "text"),
    [
        ({"primary": False}, "trouble", "Switch s1 is not under control."),
        ({"lost": 3}, "notice", "3 lost, see Machinery"),
        ({"mirror": True}, "well", "Watching copies of 1 switch"),
    ],
)
def test_what_is_not_well_is_said(state, level, text):
    found = health(board(**state))
    assert found.level == level
    assert text in found.text


def test_a_missing_part_and_training_are_said():
    found = board()
    found.coordinated([{"app_id": "firewall", "states": {"standby": 1}}], [], [], 2.0)
    assert health(found).text == "No instance of firewall is active."
    found = board()
    found.healthy("kitsune", {"app": {"model": {"packets": 43, "wanted": 100, "seconds_left": 180}}}, 2.0)
    assert "training 43 %, about 3 min left, and nobody is blocked before" in health(found).text


def test_an_enforcer_that_cannot_work_and_lost_events_are_said():
    """Nobody should believe that a host drops what it does not, or that the SIEM has been told."""
    found = board()
    idle = {"place": "gateway", "enforcing": True, "working": False, "problem": "no CAP_NET_ADMIN"}
    found.healthy("nftables", {"app": idle}, 2.0)
    told = health(found)
    assert told.level == "trouble"
    assert told.text == "Blocks are not carried out everywhere: nftables gateway: no CAP_NET_ADMIN."
    found.healthy("nftables", {"app": idle | {"working": True}}, 3.0)
    sinks = [{"name": "syslog", "delivered": 5, "lost": 2}, {"name": "eve_file", "delivered": 7, "lost": 0}]
    found.healthy("firewall", {"app": {"sinks": sinks}}, 3.0)
    told = health(found)
    assert (told.level, "2 events not delivered by syslog" in told.text) == ("notice", True)
    assert "eve_file" not in told.text


def test_commands_that_look_on_are_no_apps():
    """`observe` and the commands of an operator come and go; nothing is missing when they have gone."""
    found = board()
    watching = [
        {"app_id": "observe-12-000345", "states": {"active": 1}},
        {"app_id": "operator", "states": {}},
    ]
    found.coordinated([*found.apps, *watching], [], [], 2.0)
    assert [one["app_id"] for one in found.present()] == ["kitsune"]


def test_an_incident_is_told_in_order_of_time():
    action = IncidentAction(
        decision="d1", remedy="block", target="192.0.2.7", since=2 * SECOND, effective=3 * SECOND,
        state="in_force", places=("p4runtime_ctrl s1",), reason="scans",
    )  # fmt: skip
    incident = Incident(
        id="i1", kind="scan", change="decided", attacker_text="192.0.2.7", begun=SECOND, last=4 * SECOND,
        event_time=4 * SECOND, actions=(action,),
    )  # fmt: skip
    told = [line.split("  ", 1)[1] for line in timeline(incident)]
    assert told == ["first packet", "block 192.0.2.7: scans", "block 192.0.2.7 in force on p4runtime_ctrl s1"]


def test_what_is_asked_of_a_switch_and_what_it_sends():
    found = board()
    found.switch(WELL | {"packet_in": 300}, 3.0)
    (row,) = asked_rows(found)
    assert (row["target"], row["where"], row["reason"]) == (
        "s1: 1 request in force",
        "100 packet-ins/s",
        "packets",
    )


def test_rates_by_port_come_from_two_readings():
    first, second = {"port 1": (10, 1_000, 5)}, {"port 1": (30, 3_000, 9), "port 2": (1, 60, 0)}
    one, two = port_rows("s1", first, second, 2.0)
    assert (one["forwarded"], one["bits"], one["dropped"], one["total"]) == ("10", "8,000", "2", "9")
    assert two["forwarded"] == "-"


def test_silence_is_a_gap_in_the_chart():
    found = Board(history_s=120.0)
    for now in (100.0, 100.5, 110.0):
        found.score({"count": 1, "over": 0, "max": 0.5}, now)
    highest, _ = score_points(found.scores.bins, found.scores.width)
    assert [value for _, value in highest] == [0.5, 0.5, None, 0.5]


def test_top_talkers_are_rates_of_the_last_window_and_go_when_nothing_comes():
    found = board()
    for switch, octets in (("s1", 1_000), ("s2", 9_000)):
        sender = Sender(switch=switch, port=2, mac="02:00:00:00:00:01", ip="10.0.0.1")
        one = Talker(sender=sender, packets=10, bytes=octets)
        window = TopTalkers(
            switch=switch, since=0, event_time=2 * SECOND, packets=20, bytes=2 * octets, talkers=(one,)
        )
        found.talks(window, 5.0)
    rows = talker_rows(found, 6.0)
    assert [(one["from"], one["sender"], one["bits"], one["share"]) for one in rows] == [
        ("s2 port 2", "10.0.0.1", "36.0 k", "50%"),
        ("s1 port 2", "10.0.0.1", "4,000", "50%"),
    ]
    assert talker_rows(found, 60.0) == []
