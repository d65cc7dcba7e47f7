"""Prometheus finds every endpoint in a file that is never half written."""

import json

import pytest

from sdnator.errors import BadInput
from sdnator.up.metrics_targets import write_targets


def test_one_group_a_part(tmp_path):
    file = tmp_path / "targets.json"
    write_targets(str(file), {"kitsune": "127.0.0.1:1", "coordinator": "127.0.0.1:2", "none": ""})
    assert json.loads(file.read_text()) == [
        {"targets": ["127.0.0.1:2"], "labels": {"job": "sdnator", "part": "coordinator"}},
        {"targets": ["127.0.0.1:1"], "labels": {"job": "sdnator", "part": "kitsune"}},
    ]
    assert list(tmp_path.iterdir()) == [file]


def test_a_file_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(BadInput, match=r"metrics\.targets"):
        write_targets(str(tmp_path / "none" / "targets.json"), {})
    write_targets("", {})
