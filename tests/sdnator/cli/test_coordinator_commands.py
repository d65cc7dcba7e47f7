"""Apps, keys and flow as the Coordinator tells them, and the flow as the apps declare it."""

import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest
from typer.testing import CliRunner

from sdnator.app_catalogue import ENFORCERS, OURS
from sdnator.cli.coordinator_commands import declarations, declared_flows, draw
from sdnator.errors import BadInput, PipelineError
from tests.end_to_end.operator_app import app

FLOW = [
    {
        "producer": "maker",
        "consumer": "taker",
        "capability": "a.b.maker:window=*",
        "interest": "a.b.*",
        "delivery": "reliable",
        "frequency": None,
    }
]
ANSWERS = {
    "/flow": FLOW,
    "/apps": [{"app_id": "maker", "active": "1f", "epoch": 7, "states": {"active": 1}}],
    "/instances": [
        {
            "app_id": "maker", "instance_id": "1f", "state": "active", "silent_s": 0.25,
            "host": "here", "pid": 12, "written": 1234, "received": 0,
        }
    ],
    "/capabilities": [
        {"app_id": "maker", "key": "a.b.maker:window=*", "delivery": "reliable", "archive": "always"},
        {"app_id": "maker", "key": "a.c.maker", "delivery": "best_effort", "archive": "on_demand"},
    ],
    "/interests": [
        {"app_id": "taker", "key": "a.b.*"},
        {"app_id": "taker", "key": "x.y"},
        {"app_id": "coordinator", "key": "due.health.*"},
    ],
}  # fmt: skip


class Answering(BaseHTTPRequestHandler):
    def do_GET(self):
        answer = json.dumps(ANSWERS[self.path]).encode() if self.path in ANSWERS else b"<html>"
        self.send_response(200)
        self.end_headers()
        self.wfile.write(answer)

    def log_message(self, *_):
        pass


@pytest.fixture
def url(monkeypatch, tmp_path) -> Iterator[str]:
    """An API with known answers; no pipeline runs."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:1")
    server = HTTPServer(("127.0.0.1", 0), Answering)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    thread.join()
    server.server_close()


def run(*words):
    done = CliRunner().invoke(app, list(words), catch_exceptions=False)
    assert done.exit_code == 0
    return done.stdout


def test_apps_with_their_instances(url):
    head, row = run("apps", "--url", url).splitlines()
    assert head.split()[:3] == ["app", "instance", "state"]
    assert row.split() == ["maker", "1f", "active", "12", "on", "here", "1,234", "0", "0.2", "s", "7"]
    assert json.loads(run("apps", "--url", url, "--json"))["apps"] == ANSWERS["/apps"]


def test_keys_with_makers_and_takers_and_what_nobody_makes(url):
    shown = run("keys", "--url", url)
    assert "maker     reliable     always     taker      a.b.maker:window=*" in shown
    assert "maker     best_effort  on_demand  -          a.c.maker" in shown
    assert shown.splitlines()[-1] == "taker      x.y"
    assert json.loads(run("keys", "--url", url, "--json"))["interests"] == ANSWERS["/interests"]


def test_flow_of_a_running_coordinator(url):
    assert "  a.b.maker:… ══► taker" in run("flow", "--url", url)
    assert json.loads(run("flow", "--url", url, "--json")) == {"source": url, "flow": FLOW}


def test_flow_without_a_pipeline_is_what_the_apps_declare(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    shown = run("flow")
    for app_id in OURS:
        assert f"\n{app_id}\n" in shown
    assert json.loads(run("flow", "--json"))["source"] == "declarations"


def test_the_loop_is_closed_in_what_the_apps_declare():
    """Packets to Kitsune, alerts to the firewall, decisions to the controller: found by matching alone."""
    arrows = {(one["producer"], one["consumer"]) for one in declared_flows()}
    assert {("p4runtime_ctrl", "kitsune"), ("kitsune", "firewall"), ("firewall", "p4runtime_ctrl")} <= arrows
    assert set(declarations()) == {*OURS, *ENFORCERS}


def test_nothing_to_draw_is_said():
    assert "no data flows" in draw([])


def test_no_coordinator_is_one_clear_error(url):
    with pytest.raises(PipelineError, match=r"no Coordinator answers at http://127\.0\.0\.1:1/apps"):
        run("apps", "--url", "http://127.0.0.1:1")
    with pytest.raises(PipelineError, match="sdnator up"):
        run("apps")
    with pytest.raises(BadInput, match="--url"):
        run("keys", "--url", "file:///etc/passwd")
    with pytest.raises(PipelineError, match="no Coordinator answers"):
        run("flow", "--url", f"{url}/elsewhere")
