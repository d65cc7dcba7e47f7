"""The commands that docs/sonata.md shows for a running pipeline work with one."""

import re
import shlex
from pathlib import Path

from sdnator.capture.captures import CaptureWriter
from sdnator.testing.controller_run import ControllerRun
from sdnator.testing.query_traffic import mixed
from tests.end_to_end.command import sdnator

TEXT = (Path(__file__).resolve().parents[2] / "docs" / "sonata.md").read_text(encoding="utf-8")


def commands():
    blocks = re.findall(r"```console\n(.*?)```", TEXT, re.DOTALL)
    return [line.removeprefix("$ sdnator ") for block in blocks for line in block.splitlines()]


def test_commands_for_a_running_pipeline(tmp_path, monkeypatch):
    """Each runs to a good end; the query that the page spells out is registered on the way."""
    monkeypatch.setenv("SDNATOR_QUERIES", str(tmp_path / "queries"))
    query, *_ = re.findall(r"```text\n(.*?)```", TEXT, re.DOTALL)
    file = tmp_path / "my_scan.sonata"
    file.write_text(query)
    capture = tmp_path / "capture.pcap"
    with CaptureWriter(capture) as writer:
        for frame in mixed(["port_scan"], seconds=6):
            writer.write(frame.time_us * 1000, frame.data, frame.length)
    named = {"5s": "1s", "my_scan.sonata": str(file), "CAPTURE.pcap": str(capture)}
    with ControllerRun(tmp_path) as stage:
        stage.run("apps.sonata_adapter.service", {})
        stage.controller()
        where = {"observe": ["--updates", stage.server.url], "get": ["--archive", stage.archive]}
        api = stage.processes[0].wait_ready()["http"]
        switch = ["--url", api, "--switch", stage.target.address, "--insecure"]
        where["explain"] = [*where["observe"], *where["get"], *switch]
        for line in commands():
            words = [named.get(word, word) for word in shlex.split(line)]
            more = where.get(words[0], ["--archive", stage.archive] if "--since" in words else [])
            done = sdnator(*words, *more)
            assert done.returncode == 0, (line, done.stderr[-2000:])
