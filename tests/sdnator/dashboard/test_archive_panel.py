"""The archive's table is for people: an incident is one row in words, everything else its item."""

from due import Item
from sdnator.dashboard.archive_panel import newest_reports, row
from tests.sdnator.incidents.samples import life


def test_an_incident_is_one_row_in_words():
    reports = [
        Item("network.incident.firewall.scan", one.to_value(), 10 + place, place, "firewall", "i", 1)
        for place, one in enumerate(life())
    ]
    other = Item("network.event.firewall.cap", {"id": reports[0].value["id"]}, 5, 1, "firewall", "i", 1)
    shown = newest_reports([other, *reports])
    assert shown == [other, reports[-1]]
    text = row(0, shown[-1])["value"]
    assert text.startswith("scan: 192.168.2.108 · ")
    assert text.endswith(" · 70 packets stopped")
    assert row(0, other)["value"].startswith('{"id"')


def test_an_incident_that_nobody_understands_is_shown_as_it_is():
    odd = Item("network.incident.firewall.scan", {"id": "x"}, 1, 1, "firewall", "i", 1)
    assert row(0, odd)["value"] == '{"id": "x"}'
