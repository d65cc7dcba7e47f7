"""`sdnator demo syn-flood`: misuse is one line, and a void run is a failure."""

import json

import pytest

from sdnator.cli import syn_flood_command
from sdnator.cli.syn_flood_command import syn_flood_command as command
from sdnator.demos.syn_flood.demo import Second, SynFloodResult
from sdnator.errors import BadInput, PipelineError

KERNEL = {
    "tcp_syncookies": 0,
    "tcp_max_syn_backlog": 128,
    "somaxconn": 128,
    "tcp_synack_retries": 2,
    "tcp_no_metrics_save": 1,
}


@pytest.mark.parametrize(
    ("options", "why"),
    [({"spoofed": True, "hundred": True}, "cannot be combined"), ({"switch": "x"}, "bmv2")],
)
def test_misuse_is_named(options, why):
    """Before anything is started."""
    with pytest.raises(BadInput, match=why):
        command(**options)


def test_table_and_outcome(monkeypatch, capsys):
    """What the harness sets, a line a second, then the figures; a void run ends with an error."""

    def run(options, told):
        told.kernel(KERNEL)
        told.second(Second("with the product", 3, 13, 12, 32, 4711, "protect 10.3.0.3"))
        return SynFloodResult(
            known_client_success=1.0, decisions=["protect 10.3.0.3: why"] * 7, void="it says nothing"
        )

    monkeypatch.setattr(syn_flood_command, "run_syn_flood", run)
    with pytest.raises(PipelineError, match="says nothing"):
        command()
    shown = capsys.readouterr().out
    assert "backlog 128, somaxconn 128, SYN cookies 0, tcp_no_metrics_save 1" in shown
    assert "after 1 and 3 s" in shown
    assert "4,711  protect 10.3.0.3" in shown
    assert "100.0%" in shown
    assert "2 further decisions" in shown


def test_json_and_report(monkeypatch, capsys, tmp_path):
    """One object on standard output; the same beside the picture."""

    def run(options, told):
        told.kernel(KERNEL)
        return SynFloodResult(sent=7, kernel=KERNEL)

    monkeypatch.setattr(syn_flood_command, "run_syn_flood", run)
    command(as_json=True)
    assert json.loads(capsys.readouterr().out)["sent"] == 7
