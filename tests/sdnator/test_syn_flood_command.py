"""`sdnator demo syn-flood`: misuse is one line, and a void run is a failure."""

import pytest

from sdnator import syn_flood_command
from sdnator.errors import BadInput, PipelineError
from sdnator.syn_flood import Second, SynFloodResult
from sdnator.syn_flood_command import syn_flood_command as command


@pytest.mark.parametrize(
    ("options", "why"), [({"spoofed": True, "hundred": True}, "exclude"), ({"switch": "x"}, "bmv2")]
)
def test_misuse_is_named(options, why):
    """Before anything is started."""
    with pytest.raises(BadInput, match=why):
        command(**options)


def test_table_and_outcome(monkeypatch, capsys):
    """A line a second, then the figures; a void run ends with an error."""

    def run(options, show):
        show(Second("with product, flood", 3, 13, 12, 32, 4711))
        return SynFloodResult(
            known_client_success=1.0, decisions=["protect 10.0.0.1: why"] * 7, void="it says nothing"
        )

    monkeypatch.setattr(syn_flood_command, "run_syn_flood", run)
    with pytest.raises(PipelineError, match="says nothing"):
        command()
    shown = capsys.readouterr().out
    assert "4,711" in shown
    assert "100.0%" in shown
    assert "2 further decisions" in shown
