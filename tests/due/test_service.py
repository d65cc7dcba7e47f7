"""A service says when it is ready, reports its health, stops on a signal, and names wrong options in one line."""

import json
import os
import signal
import subprocess
import sys
import textwrap
import urllib.request
from pathlib import Path

import pytest

from tests.due.conftest import gone, wait_for

ROOT = Path(__file__).parents[2]
APP = """
import sys
import msgspec
from due import Capability, Interest
from due import service

INTERESTS = (Interest("svc.in"),)
CAPABILITIES = (Capability("svc.out", delivery="reliable"),)

class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    factor: int = 2

class Doubler:
    def __init__(self, engine, settings):
        self.engine, self.settings, self.ticks = engine, settings, 0
    def start(self):
        self.engine.observe("svc.in").subscribe(lambda i: self.engine.write("svc.out", i.value * self.settings.factor))
    def tick(self):
        self.ticks += 1
    def stop(self):
        self.engine.write("svc.out", "stopped")
    def health(self):
        return {"ticks": self.ticks}

sys.exit(service.run("doubler", Doubler, Settings, INTERESTS, CAPABILITIES))
"""


@pytest.fixture
def start(tmp_path, server):
    program = tmp_path / "app.py"
    program.write_text(textwrap.dedent(APP))
    started = []

    def run(*arguments):
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "DUE_DIRECTORY": str(tmp_path)}
        command = [sys.executable, str(program), "--updates", server.url, *arguments]
        started.append(
            subprocess.Popen(
                command, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
            )
        )
        return started[-1]

    yield run
    for process in started:
        process.kill()
        process.communicate()


def test_a_service_works_from_ready_to_sigterm(start, tmp_path, make_engine):
    settings = tmp_path / "settings.json"
    settings.write_text('{"factor": 3}')
    engine = make_engine("outside")
    out, health = [], []
    engine.observe("svc.out").subscribe(lambda item: out.append(item.value))
    engine.observe("due.health.doubler").subscribe(lambda item: health.append(item.value))
    process = start("--settings", str(settings), "--archive", f"sqlite://{tmp_path / 'a.db'}")
    ready = json.loads(process.stdout.readline())
    assert ready == {"ready": True, "app": "doubler", "pid": process.pid}
    engine.write("svc.in", 7)
    wait_for(lambda: out == [21])
    wait_for(lambda: health)
    assert health[0]["app"]["ticks"] > 0
    assert health[0]["engine"]["app"] == "doubler"
    process.send_signal(signal.SIGTERM)
    stdout, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    assert stdout == ""
    wait_for(lambda: out == [21, "stopped"])


def _fetch(address, path, host="localhost"):
    request = urllib.request.Request(f"http://{address}{path}", headers={"Host": host})
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with opener.open(request, timeout=60) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


def test_metrics_health_and_json_logs_are_served_where_asked_for(start, tmp_path):
    process = start(
        "--metrics",
        "127.0.0.1:0",
        "--log-format",
        "json",
        "--log",
        "debug",
        "--archive",
        f"sqlite://{tmp_path / 'a.db'}",
    )
    address = json.loads(process.stdout.readline())["metrics"]
    status, text = _fetch(address, "/metrics")
    assert status == 200
    assert "doubler_ticks{" in text
    assert "# TYPE due_written_items_total counter" in text
    status, text = _fetch(address, "/healthz")
    assert (status, json.loads(text)["status"], json.loads(text)["app"]) == (200, "ok", "doubler")
    assert _fetch(address, "/other")[0] == 404
    assert _fetch(address, "/metrics", host="evil.example")[0] == 400
    process.send_signal(signal.SIGTERM)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 0
    lines = [json.loads(line) for line in stderr.splitlines()]
    assert all(line["app"] == "doubler" and line["message"] for line in lines)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--metrics", "nonsense"], "HOST:PORT"),
        (["--metrics", "203.0.113.1:80"], "203.0.113.1:80"),
        (["--settings", "/nowhere.json"], "/nowhere.json"),
        (["--settings", "{folder}/wrong.json"], "factr"),
        (["--archive", "ftp://x"], "ftp://x"),
        (["--updates", "http://x"], "http://x"),
        (["--updates", "redis://127.0.0.1:1/0"], "127.0.0.1:1"),
    ],
)
def test_a_wrong_option_is_one_clear_line(start, tmp_path, arguments, text):
    (tmp_path / "wrong.json").write_text('{"factr": 3}')
    process = start(*(a.format(folder=tmp_path) for a in arguments))
    _, stderr = process.communicate(timeout=60)
    assert process.returncode in (1, 2)
    assert text in stderr
    assert "Traceback" not in stderr


def test_a_service_whose_starter_died_first_ends_at_once(start, monkeypatch):
    """Killed while the service was still importing, the starter would leave it for ever."""
    with subprocess.Popen([sys.executable, "-c", ""]) as gone:
        pass
    monkeypatch.setenv("DUE_PARENT", str(gone.pid))
    process = start()
    assert process.wait(60) == 0


def test_a_service_ends_with_its_parent(tmp_path, server):
    program = tmp_path / "app.py"
    program.write_text(textwrap.dedent(APP))
    code = (
        "import subprocess, sys, time\n"
        f"child = subprocess.Popen([sys.executable, {str(program)!r}, '--updates', {server.url!r}], stdout=subprocess.PIPE)\n"
        "child.stdout.readline()\n"
        "print(child.pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "DUE_DIRECTORY": str(tmp_path)}
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=environment
    ) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        parent.kill()
    wait_for(lambda: gone(child))
