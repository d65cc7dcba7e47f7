"""A service says when it is ready, reports its health, stops on a signal, and names wrong options in one line."""

import json
import os
import signal
import subprocess
import sys
import textwrap
import time
import urllib.request
from contextlib import closing
from pathlib import Path

import pytest

from due import NO_WAIT
from due.drivers.sqlite import SqliteArchive
from due.messages import Item
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

    def run(*arguments, **options):
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "DUE_DIRECTORY": str(tmp_path)}
        command = [sys.executable, str(program), "--updates", server.url, *arguments]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        started.append(subprocess.Popen(command, env=environment, text=True, **(pipes | options)))
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


def test_an_archive_that_was_replaced_is_let_go_though_the_app_has_nothing_to_ask(
    start, tmp_path, make_engine
):
    """Its space would be taken until the app's next read."""
    app = APP.replace("i.value * self.settings.factor", "len(self.engine.get('a.b')), [PUB_ONLY]")
    app = app.replace("Capability, Interest", "PUB_ONLY, Capability, Interest")
    (tmp_path / "app.py").write_text(app)
    with closing(SqliteArchive(f"sqlite://{tmp_path}/a.db")) as archive:
        archive.insert([Item("a.b", 1, 1, 1, "app", "i", 1)])
    out, engine = [], make_engine("outside")
    engine.observe("svc.out").subscribe(lambda item: out.append(item.value))
    process = start("--archive", f"sqlite://{tmp_path}/a.db")
    assert process.stdout.readline()
    engine.write("svc.in", 7)
    wait_for(lambda: out == [1])

    def held():
        links = [each.readlink() for each in Path(f"/proc/{process.pid}/fd").iterdir() if each.is_symlink()]
        return [str(each) for each in links if str(each).startswith(str(tmp_path / "old"))]

    for end in ("", "-wal", "-shm"):
        (tmp_path / f"a.db{end}").rename(tmp_path / f"old{end}")
    assert held()
    wait_for(lambda: not held())


def test_an_app_may_print_though_nobody_reads(start, tmp_path, make_engine):
    """More than a pipe holds; it goes where the log goes, and the app works on."""
    (tmp_path / "app.py").write_text(APP.replace("self.ticks += 1", "print('x' * 100_000, flush=True)"))
    health = []
    make_engine("outside").observe("due.health.doubler").subscribe(lambda item: health.append(item.value))
    with (tmp_path / "log").open("w") as log:
        process = start("--archive", f"sqlite://{tmp_path / 'a.db'}", stderr=log)
    assert json.loads(process.stdout.readline())["ready"]
    wait_for(lambda: health)
    process.send_signal(signal.SIGTERM)
    stdout, _ = process.communicate(timeout=60)
    assert (process.returncode, stdout) == (0, "")
    assert "x" * 100_000 in (tmp_path / "log").read_text()


def _fetch(address, path, host="localhost", token=""):
    rights = {"Authorization": f"Bearer {token}"} if token else {}
    request = urllib.request.Request(f"http://{address}{path}", headers={"Host": host} | rights)
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with opener.open(request, timeout=60) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


TOKEN = "a long enough token"  # noqa: S105


def token_file(folder):
    path = folder / "token"
    path.write_text(TOKEN + "\n")
    return path


def test_metrics_health_and_json_logs_are_served_where_asked_for(start, tmp_path):
    process = start(
        "--metrics",
        "127.0.0.1:0",
        "--metrics-token",
        str(token_file(tmp_path)),
        "--log-format",
        "json",
        "--log",
        "debug",
        "--archive",
        f"sqlite://{tmp_path / 'a.db'}",
    )
    address = json.loads(process.stdout.readline())["metrics"]
    assert [_fetch(address, "/metrics", token=token)[0] for token in ("", "x" * 20)] == [401, 401]
    status, text = _fetch(address, "/metrics", token=TOKEN)
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
        (["--metrics", "127.0.0.1:0", "--metrics-token", "/nowhere"], "/nowhere"),
        (["--metrics", "127.0.0.1:0", "--metrics-token", "/dev/null"], "16 to"),
        (["--metrics", "203.0.113.1:80"], "203.0.113.1:80"),
        (["--settings", "/nowhere.json"], "/nowhere.json"),
        (["--settings", "{folder}/wrong.json"], "factr"),
        (["--settings", "{folder}/deep.json"], "deep.json"),
        (["--settings", "{folder}/bytes.json"], "bytes.json"),
        (["--settings", "/dev/zero"], "/dev/zero"),
        (["--archive", "ftp://x"], "ftp://x"),
        (["--updates", "http://x"], "http://x"),
        (["--updates", "redis://127.0.0.1:1/0", "--engine", "{folder}/soon.json"], "127.0.0.1:1"),
    ],
)
def test_a_wrong_option_is_one_clear_line(start, tmp_path, arguments, text):
    (tmp_path / "wrong.json").write_text('{"factr": 3}')
    (tmp_path / "deep.json").write_text('{"factor": ' + "[" * 100_000)
    (tmp_path / "bytes.json").write_bytes(b'{"factor": "\xff"}')
    (tmp_path / "soon.json").write_text('{"connect_timeout": 0.2}')
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


BREAKABLE = (
    APP.replace('lambda i: self.engine.write("svc.out", i.value * self.settings.factor)', "self.handle")
    .replace(
        "    def tick(self):\n",
        """    def handle(self, item):
        if item.value == "die":
            raise SystemExit
        if item.value == "hang":
            time.sleep(3600)
        if item.value == "hang main":
            self.hang = True
    hang = False
    def tick(self):
        while self.hang:
            time.sleep(3600)
""",
    )
    .replace("import sys\n", "import sys, time\n", 1)
)


@pytest.fixture
def breakable(start, tmp_path, make_engine):
    """Starts the app with a pipe for its heartbeats: the process, its ready line, the pipe and a way to break it."""
    (tmp_path / "app.py").write_text(textwrap.dedent(BREAKABLE))
    reading, writing = os.pipe()
    os.set_inheritable(writing, True)

    def run(*arguments):
        process = start("--heartbeat-fd", str(writing), *arguments, close_fds=False)
        ready = json.loads(process.stdout.readline())
        engine = make_engine("outside")
        return process, ready, lambda what: engine.write("svc.in", what, [NO_WAIT])

    yield run, reading
    os.close(reading)
    os.close(writing)


def _beats(reading, seconds):
    """The bytes of so many seconds."""
    os.set_blocking(reading, False)
    came, end = b"", time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(0.05)
        try:
            came += os.read(reading, 100)
        except BlockingIOError:
            continue
    return came


def test_a_byte_about_every_second_says_that_all_threads_answer(breakable):
    run, reading = breakable
    run()
    wait_for(lambda: len(_beats(reading, 3.0)) >= 2)


@pytest.mark.parametrize("what", ["hang", "hang main"])
def test_a_service_that_hangs_writes_no_more_heartbeats(breakable, what):
    run, reading = breakable
    process, _, break_it = run()
    wait_for(lambda: _beats(reading, 0.1))
    break_it(what)
    wait_for(lambda: not _beats(reading, 3.0))
    assert process.poll() is None


def test_healthz_says_that_a_callback_takes_long(breakable):
    run, _ = breakable
    _, ready, break_it = run("--metrics", "127.0.0.1:0")
    break_it("hang")
    wait_for(lambda: json.loads(_fetch(ready["metrics"], "/healthz")[1])["status"] == "busy")
    status, text = _fetch(ready["metrics"], "/healthz")
    assert (status, json.loads(text)["dispatcher_s"] > 0) == (200, True)


def test_a_service_whose_dispatcher_dies_ends_with_a_word(breakable):
    run, _ = breakable
    process, _, break_it = run()
    break_it("die")
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "the thread due-dispatcher died" in stderr
    assert "SystemExit" in stderr


def test_a_heartbeat_descriptor_that_is_not_open_is_refused(start):
    process = start("--heartbeat-fd", "999")
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 2
    assert "--heartbeat-fd 999" in stderr
