"""Why something is blocked, in five lines, whatever is known of it."""

import pytest
from msgspec import structs

from apps.messages import Decision, Exhibit, Target
from sdnator.blocks.decision_summary import five_lines
from tests.apps.firewall.incidents.samples import decision
from tests.sdnator.incidents.samples import life


def lines(first: Decision, last: Decision | None = None, **about) -> dict[str, str]:
    """The five lines by their names."""
    found = list(five_lines(first, last or first, about.get("incident")))
    assert len(found) == 5
    return dict(line.split(": ", 1) for line in found)


def test_a_decision_of_the_sequential_test():
    """Sum and bound, the largest contributions first, the remedy, its end, how to undo."""
    *_, confirmed = [each for each in life() if each.change == "confirmed"]
    found = lines(decision(), incident=confirmed)
    assert found["sum"] == "10.0 nats of evidence; the bound was 10.0"
    assert found["largest contributions"].startswith("strangers 6.0 nats (SYNs to 20 hosts")
    assert "; port_scan 4.0 nats" in found["largest contributions"]
    assert found["remedy"] == "blocked 5c:cf:7f:05:f2:c6 port 1 on s1"
    assert found["until"].startswith("1970-01-01 ")
    assert found["undo"].startswith("sdnator blocks remove d1; never again: sdnator allow add 5c:cf")


def test_a_lifted_one_needs_no_undoing():
    lifted = decision(701.0, action="unblock", reason="the block ran out")
    found = lines(decision(), lifted, incident=life()[-1])
    assert found["remedy"].endswith(", lifted: the block ran out")
    assert found["until"].endswith("it is lifted")
    assert found["undo"] == "nothing to undo"


@pytest.mark.parametrize(
    ("one", "contributions", "undo"),
    [
        (decision(evidence=()), "none, the settings name it", "sdnator blocks remove d1"),
        (
            decision(
                action="protect",
                evidence=(),
                expires=0,
                target=Target(kind="ip", address="10.0.0.1", port=22),
            ),
            "none, the settings name it",
            "take the service out of `guard`",
        ),
        (
            decision(
                evidence=(Exhibit(key="network.instruction.operator.firewall", timestamp=1, summary="4711"),)
            ),
            "4711",
            "sdnator blocks remove d1",
        ),
    ],
)
def test_a_decision_without_an_incident(one, contributions, undo):
    """By hand or by the settings: the reason and the exhibits say why."""
    found = lines(one)
    assert found["sum"] == "none, another rule decided: the sum has reached its bound"
    assert found["largest contributions"] == contributions
    assert found["undo"].startswith(undo)


def test_what_only_would_be_done_is_said_so():
    assert lines(structs.replace(decision(), dry_run=True))["remedy"].startswith("would block 5c:cf")
