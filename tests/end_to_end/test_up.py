"""A standing pipeline as its operator meets it: up, looked at from all sides, parts that die, down."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
import uuid
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from apps.kitsune.detector import Detector
from apps.kitsune.kept_model import KeptModel, models_aside, trained_for
from due.drivers.embedded_redis import EmbeddedServer, server_program
from sdnator.capture.interfaces import VethPair
from sdnator.errors import PipelineError
from sdnator.northbound import ask
from sdnator.up import running
from tests.apps.kitsune.test_hostile import mixed
from tests.apps.kitsune.test_kept_model import SMALL
from tests.end_to_end.test_bad_input import MARK, processes_of
from tests.requirements import optional_program, require_netns

SECONDS = 120
PARTS = {"updates", "coordinator", "switch", "p4runtime_ctrl", "kitsune", "sonata_adapter", "firewall"}
APPS = PARTS - {"updates", "switch"}


class Operator:
    """One user's shell: folders of his own, and a mark by which his processes are found."""

    def __init__(self, folder: Path) -> None:
        self.mark = uuid.uuid4().hex
        self.environment = os.environ | {
            "XDG_STATE_HOME": str(folder / "state"),
            "XDG_DATA_HOME": str(folder / "data"),
            "XDG_CONFIG_HOME": str(folder / "config"),
            MARK: self.mark,
        }

    def command(self, *words: str) -> list[str]:
        return [sys.executable, "-m", "tests.end_to_end.operator_app", *words]

    def run(self, *words: str, given: str = "") -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            self.command(*words),
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=SECONDS,
            check=False,
            input=given,
        )

    def figures(self, *words: str):
        done = self.run(*words, "--json")
        assert done.returncode == 0, done.stderr[-3000:]
        return json.loads(done.stdout)

    def well(self):
        """What status says as soon as all parts live and all apps are active, None before."""
        if not self._may_be_well():
            return None
        now = json.loads(self.run("status", "--json").stdout)
        states = {app: (now.get("apps") or {}).get(app, "").split(", ") for app in APPS}
        return now if now.get("well") and all("active" in each for each in states.values()) else None

    def _may_be_well(self) -> bool:
        """Asked of the run file and the Coordinator: a command at each look would slow down what is looked at."""
        found = running.find(Path(self.environment["XDG_STATE_HOME"]) / "sdnator")
        if found is None or any(one["state"] != "running" for one in found.health.values()):
            return False
        try:
            active = {app["app_id"] for app in ask(found.coordinator, "/apps") if "active" in app["states"]}
        except PipelineError:
            return False
        return active >= APPS

    def down(self) -> subprocess.CompletedProcess[str]:
        return self.run("down", "--timeout", str(SECONDS - 10))

    @contextmanager
    def up(self, *words: str, page: tuple[str, ...] = ("--no-dashboard",)):
        """A running pipeline and what it said of itself; without a terminal, as a service runs.

        SIGTERM ends it in order, unless the test has ended it otherwise.
        """
        # who runs the tests with nohup hands on that SIGHUP is ignored
        before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
        process = subprocess.Popen(
            self.command("up", "--json", *page, *words),
            env=self.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        signal.signal(signal.SIGHUP, before)
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            assert line, process.communicate()[1]
            yield process, json.loads(line)
        finally:
            running_still = process.poll() is None
            if running_still:
                process.terminate()
            _, error = process.communicate(timeout=SECONDS)
        if running_still:
            assert (process.returncode, "Traceback" in error) == (0, False), error


def until(condition, why=lambda: ""):
    """The first true answer; `why` says what is known where there is none."""
    deadline = time.monotonic() + SECONDS
    while time.monotonic() < deadline:
        if answer := condition():
            return answer
        time.sleep(0.1)
    raise AssertionError(f"did not come about in {SECONDS} s {why()}")


@pytest.fixture
def operator(tmp_path):
    return Operator(tmp_path)


@pytest.fixture(scope="module")
def standing(tmp_path_factory):
    """An operator whose pipeline runs, and what it said of itself."""
    operator = Operator(tmp_path_factory.mktemp("standing"))
    with operator.up() as (_, said):
        yield operator, said
    assert processes_of(operator.mark) == []


def test_all_parts_run_and_all_apps_are_active(standing):
    operator, said = standing
    found = until(operator.well)
    assert found["parts"].keys() == PARTS
    assert all(part["alive"] for part in found["parts"].values())
    assert {found["apps"][app] for app in APPS} == {"active"}
    assert found["pid"] == said["pid"]
    assert said["uncontrolled"] == ""
    assert "kitsune" in operator.run("status").stdout


def test_a_switch_that_is_not_there_is_named_at_the_start(operator):
    with operator.up("--switch", "127.0.0.1:1", "--insecure") as (_, said):
        assert said["uncontrolled"].startswith("s1: ")
        assert "127.0.0.1:1" in said["uncontrolled"]


def test_the_kept_model_is_taken_up_shown_and_thrown_away(operator):
    """Through `up`, `status` and `model`; with another length of training it stays beside."""
    state, config = (
        Path(operator.environment[f"XDG_{name}_HOME"]) / "sdnator" for name in ("STATE", "CONFIG")
    )
    path = running.model_file(state)
    config.mkdir(parents=True)
    (config / "sdnator.toml").write_text("[kitsune]\nfm_grace = 20\nad_grace = 200\n")
    detector = Detector(SMALL)
    detector.process(mixed(400), "s1")
    KeptModel(path, trained_for(SMALL, {"s1": ["embedded"]})).keep(detector)
    with operator.up() as (_, said):
        assert said["model"].startswith("using the kept model of")
        until(lambda: (operator.well() or {}).get("training", {}).get("done"))
        assert "model: trained until" in operator.run("status").stdout
        assert "training again, on the next 221 packets" in operator.run("model", "retrain").stdout
        until(lambda: "training 0 %, waiting for packets" in operator.run("model", "show").stdout)
        assert not path.exists()
    KeptModel(path, trained_for(SMALL, {"s1": ["embedded"]})).keep(detector)
    with operator.up("--train", "330") as (_, said):
        assert "it was trained with fm_grace=20, not 30" in said["model"]
    assert len(models_aside(path)) == 2


def test_a_second_one_is_refused(standing):
    operator, _ = standing
    done = operator.run("up")
    assert done.returncode == 1
    assert done.stdout == ""
    assert "sdnator down" in done.stderr
    assert "Traceback" not in done.stderr


def test_others_find_it_by_themselves(standing):
    """Apps, keys, flow, doctor, tables: without an address."""
    operator, _ = standing
    until(operator.well)
    assert {one["app_id"] for one in operator.figures("apps")["instances"]} >= APPS
    made = {one["key"] for one in operator.figures("keys")["capabilities"]}
    assert "network.anomaly.kitsune.alert" in made
    flow = until(lambda: operator.figures("flow")["flow"])
    assert ("kitsune", "firewall") in {(one["producer"], one["consumer"]) for one in flow}
    checks = {one["name"]: one for one in operator.figures("doctor")["checks"]}
    assert checks["pipeline"]["state"] == "ok"
    until(lambda: "ingress.telemetry_active" in operator.run("tables", "s1", "--json").stdout)
    entries = operator.figures("tables", "s1")["entries"]
    assert any(one["table"] == "ingress.telemetry_active" for one in entries)
    assert operator.figures("counters")["switch"] == "s1"
    done = operator.run("tables", "s2")
    assert (done.returncode, "has s1" in done.stderr) == (2, True)


def test_data_is_seen_as_it_comes_and_afterwards(standing):
    operator, _ = standing
    done = operator.run("observe", "due.health.kitsune", "--count", "2", "--json")
    items = [json.loads(line) for line in done.stdout.splitlines()]
    assert [item["appId"] for item in items] == ["kitsune", "kitsune"]

    def activated():
        past = operator.run("get", "due.event.coordinator", "--since", "1h", "--json")
        events = [json.loads(line)["value"] for line in past.stdout.splitlines()]
        return {one["app_id"] for one in events if one["event"] == "activated"}

    until(lambda: {"kitsune", "firewall"} <= activated())  # the archive is written behind the pipeline


def test_observing_ends_well_with_ctrl_c(standing):
    operator, _ = standing
    command = operator.command("observe", "due.health.*")
    with subprocess.Popen(
        command, env=operator.environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert "due.health." in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=SECONDS)
    assert process.returncode == 0
    assert " item" in error
    assert "Traceback" not in error


@pytest.mark.parametrize("part", ["kitsune", "coordinator", "updates", "p4runtime_ctrl"])
def test_a_part_that_dies_is_started_again(standing, part):
    """Under a new process id, which status knows; and the app is active again."""
    operator, _ = standing
    before = until(operator.well)["parts"][part]["pid"]
    os.kill(before, signal.SIGKILL)
    until(lambda: (now := operator.well()) and now["parts"][part]["pid"] != before)


def test_parts_that_hang_are_started_again(standing):
    """Each in its own way: an app, the server, the switch; stopped processes never end by themselves."""
    operator, _ = standing
    before = until(operator.well)["parts"]
    hung = ("firewall", "updates", "switch")
    for part in hung:
        os.kill(before[part]["pid"], signal.SIGSTOP)
    after = until(
        lambda: (
            (now := operator.well())
            and all(now["parts"][part]["pid"] != before[part]["pid"] for part in hung)
            and now
        )
    )
    assert "no heartbeat" in after["parts"]["firewall"]["cause"]
    assert "firewall was restarted" in operator.run("status").stdout


def test_the_switch_comes_back_at_its_address_and_nothing_else_is_touched(standing):
    """The controller finds it again, and puts back what was in it."""
    operator, _ = standing
    before = until(operator.well)
    assert operator.run("blocks", "add", "203.0.113.9", "--reason", "a test").returncode == 0
    until(lambda: "203.0.113.9" in operator.run("tables", "s1", "--table", "block_src").stdout)
    os.kill(before["parts"]["switch"]["pid"], signal.SIGKILL)
    restarts = before["parts"]["switch"]["restarts"]
    after = until(lambda: (now := operator.well()) and now["parts"]["switch"]["restarts"] > restarts and now)
    assert after["switch"]["address"] == before["switch"]["address"]
    for part in PARTS - {"switch", "p4runtime_ctrl"}:
        assert after["parts"][part]["pid"] == before["parts"][part]["pid"]
    until(lambda: "203.0.113.9" in operator.run("tables", "s1", "--table", "block_src").stdout)
    assert after["pid"] == before["pid"]


def test_an_app_that_keeps_dying_is_degraded_and_guards_nobody_less(standing):
    """Switch, controller and firewall run on; status says what is wrong and exits with 1."""
    operator, _ = standing
    before = until(operator.well)["parts"]

    def degraded():
        now = json.loads(operator.run("status", "--json").stdout)["parts"]
        if now["kitsune"]["alive"] and now["kitsune"]["state"] != "degraded":
            os.kill(now["kitsune"]["pid"], signal.SIGKILL)
        return now["kitsune"]["state"] == "degraded" and now

    after = until(degraded)
    for part in PARTS - {"kitsune"}:
        assert (after[part]["pid"], after[part]["state"]) == (before[part]["pid"], "running")
    done = operator.run("status")
    assert (done.returncode, "DEGRADED" in done.stdout) == (1, True)
    assert "the last death: kitsune was killed by SIGKILL" in done.stdout


def test_down_ends_everything_and_keeps_the_archive(operator):
    with operator.up() as (process, said):
        until(operator.well)
        done = operator.down()
        assert (done.returncode, done.stdout) == (0, f"stopped (process {said['pid']})\n")
        _, error = process.communicate(timeout=SECONDS)
        assert process.returncode == 0
        assert error.endswith("stopped; all processes have ended\n")
    assert processes_of(operator.mark) == []
    assert operator.run("status").returncode == 1
    assert operator.run("get", "due.event.coordinator", "--json").stdout.count("activated") >= len(APPS) - 1


def test_down_ends_one_that_is_still_starting(operator):
    with subprocess.Popen(
        operator.command("up"), env=operator.environment, stderr=subprocess.PIPE
    ) as process:
        until(lambda: "starting" in operator.run("status").stdout or process.poll() is not None)
        done = operator.down()
        _, error = process.communicate(timeout=SECONDS)
    assert (process.returncode, done.returncode) == (0, 0)
    assert b"sdnator: stopped" in error
    assert processes_of(operator.mark) == []


def test_ctrl_c_ends_it_in_order(operator):
    """As does SIGTERM, by which all other tests end it."""
    with operator.up() as (process, _):
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=SECONDS)
        assert process.returncode == 0
        assert "Traceback" not in error
    assert processes_of(operator.mark) == []


CONFIGURATION = """
[up]
quota = 0.5
[log]
format = "json"
[metrics]
targets = "TARGETS"
[firewall]
rules.anomalous_seconds = HOT
[kitsune]
threshold = THRESHOLD
[[switches]]
name = "left"
[[switches]]
name = "right"
device_id = 2
"""


def test_a_configuration_holds_and_hangup_takes_up_what_it_can(operator, tmp_path):
    """Two switches, structured logs, metrics for Prometheus; then new rules for the firewall, without an end."""
    file, targets = tmp_path / "sdnator.toml", tmp_path / "targets.json"

    def write(hot, line):
        text = CONFIGURATION.replace("TARGETS", str(targets)).replace("HOT", str(hot))
        file.write_text(text.replace("THRESHOLD", str(line)))

    write(7, 1.5)
    with operator.up("--config", str(file)) as (process, said):
        assert [one["name"] for one in said["switches"]] == ["left", "right"]
        assert said["parts"].keys() >= {"switch-left", "switch-right"}
        parts = {group["labels"]["part"]: group["targets"] for group in json.loads(targets.read_text())}
        assert parts.keys() == {*APPS, "supervisor"}
        metrics = urllib.request.urlopen(f"http://{parts['supervisor'][0]}/metrics").read().decode()
        assert 'sdnator_part_state{part="switch-left",state="running"} 1' in metrics
        assert b"kitsune_" in urllib.request.urlopen(f"http://{parts['kitsune'][0]}/metrics").read()
        state = tmp_path / "state" / "sdnator"
        assert json.loads((state / "kitsune.settings.json").read_text())["threshold"] == 1.5
        logged = until(lambda: operator.run("logs", "p4runtime_ctrl", "--json").stdout)
        assert "level" in json.loads(logged.splitlines()[0])["line"]
        write(8, 2.5)
        process.send_signal(signal.SIGHUP)

        def firewall_now():
            return json.loads(operator.run("status", "--json").stdout)["parts"]["firewall"]["pid"]

        until(lambda: firewall_now() != said["parts"]["firewall"])
        assert json.loads((state / "firewall.settings.json").read_text())["rules"]["anomalous_seconds"] == 8
        file.write_text("[kitsune]\nthresold = 1")
        process.send_signal(signal.SIGHUP)
        assert process.stderr is not None
        heard = ""
        while "not applied" not in heard:
            heard += process.stderr.readline()
        assert "kitsune: a restart would train it again" in heard
        assert "did you mean threshold?" in heard
        assert process.poll() is None
    assert processes_of(operator.mark) == []


def test_killed_it_takes_all_along(operator):
    """And the next one starts over what it left."""
    with operator.up() as (process, _):
        process.kill()
        process.communicate(timeout=SECONDS)
    until(lambda: not processes_of(operator.mark))
    assert json.loads(operator.run("status", "--json").stdout) == {"running": False, "pid": None}
    with operator.up():
        pass


PASSWORD = "correct-horse-battery"  # noqa: S105 - of a server of this test


@contextmanager
def guarded_server(folder):
    """A server that asks for a password."""
    folder.mkdir()
    file = folder / "valkey.conf"
    file.write_text(f'port 0\nunixsocket {folder}/v.sock\nrequirepass {PASSWORD}\nsave ""\n')
    with subprocess.Popen([server_program(), str(file)], cwd=folder, stdout=subprocess.DEVNULL) as server:
        try:
            until((folder / "v.sock").exists)
            yield f"unix://:{PASSWORD}@{folder}/v.sock"
        finally:
            server.terminate()


def test_a_password_is_seen_nowhere_but_in_files_of_its_user(operator, tmp_path):
    """Not in what is printed, in arguments, in environments of the parts, in logs; files with it have mode 0600."""
    with guarded_server(tmp_path / "server") as url:
        operator.environment["SDNATOR_UP_UPDATES"] = url
        with operator.up() as (process, said):
            until(operator.well)
            os.kill(said["parts"]["kitsune"], signal.SIGKILL)
            until(lambda: (now := operator.well()) and now["parts"]["kitsune"]["restarts"])
            looks = (("status",), ("status", "--json"), ("config", "show"), ("doctor", "--updates", url))
            shown = [json.dumps(said), *(operator.run(*words).stdout for words in looks)]
            for pid in set(processes_of(operator.mark)) - {process.pid}:
                shown += [Path(f"/proc/{pid}/{file}").read_text() for file in ("cmdline", "environ")]
            process.terminate()
            shown += process.communicate(timeout=SECONDS)
        state = tmp_path / "state" / "sdnator"
        files = [path for path in state.rglob("*") if path.is_file()]
        shown += [path.read_text() for path in files if ".log" in path.name]
        of_kitsune = json.loads((state / "identities.json").read_text())["identities"]["kitsune"]["password"]
        assert not [text for text in shown if PASSWORD in text or of_kitsune in text]
        assert not [path for path in files if PASSWORD.encode() in path.read_bytes()], "parts need it no more"
        holding = [path for path in files if of_kitsune.encode() in path.read_bytes()]
        assert {path.name for path in holding} == {"identities.json", "kitsune.engine.json"}
        assert {path.stat().st_mode & 0o777 for path in holding} == {0o600}
        assert state.stat().st_mode & 0o777 == 0o700


def test_given_backends_and_a_switch_that_runs_already_are_used_and_left_running(operator, tmp_path):
    """Nothing embedded is started, the archive is the given one, and the pipeline loads its program into the switch."""
    archive = f"sqlite://{tmp_path}/given.db"
    command = [sys.executable, "-m", "dataplane", "--device-id", "7"]
    with (
        EmbeddedServer(tmp_path / "server") as server,
        subprocess.Popen(command, env=operator.environment, stdout=subprocess.PIPE) as switch,
    ):
        try:
            assert switch.stdout is not None
            address = json.loads(switch.stdout.readline())["grpc"]
            given = ("--updates", server.url, "--archive", archive, "--switch", address, "--device-id", "7")
            with operator.up(*given) as (_, said):
                assert not {"updates", "switch"} & said["parts"].keys()
                assert said["archive"] == archive
                assert said["updates"] == server.url.replace("unix://", "unix://…@"), "as a user of its own"
                assert operator.run("observe", "due.health.firewall", "--count", "1").stdout.count("\n") == 1
                until(lambda: operator.run("tables").returncode == 0)
                assert operator.figures("tables", address, "--device-id", "7")["entries"]
            assert switch.poll() is None
            assert server.pid
        finally:
            switch.terminate()
    assert (tmp_path / "given.db").exists()
    assert not (tmp_path / "data" / "sdnator" / "archive.db").exists()


@pytest.mark.parametrize("switch", ["embedded", "bmv2"])
def test_two_interfaces_are_a_wire_and_their_packets_are_seen(operator, switch):
    """Frames of one side leave at the other, their headers come as record batches, and their sender is a top talker."""
    require_netns()
    if switch == "bmv2":
        optional_program("simple_switch_grpc")
    with ExitStack() as stack:
        left, right = VethPair.make(stack, "upl"), VethPair.make(stack, "upr")
        ports = ("--port", f"1=veth:{left.far}", "--port", f"2=veth:{right.far}")
        stack.enter_context(operator.up("--switch", switch, *ports))
        send, receive = (stack.enter_context(raw(name)) for name in (left.near, right.near))
        frame = bytes.fromhex(
            "020000000002020000000001 0800 4500001c00010000401100000a0000010a000002 0035003500080000"
        )
        receive.settimeout(0.2)

        def passes():
            send.send(frame.ljust(60, b"\0"))
            try:
                return receive.recv(2048).startswith(frame)
            except TimeoutError:
                return False

        until(passes)

        def observed(key):
            viewer = stack.enter_context(
                subprocess.Popen(
                    operator.command("observe", key, "--count", "1", "--json"),
                    env=operator.environment,
                    stdout=subprocess.PIPE,
                    text=True,
                )
            )
            until(lambda: passes() and viewer.poll() is not None)
            assert viewer.stdout is not None
            return json.loads(viewer.stdout.read())["value"]

        batch = observed("network.packets.p4runtime_ctrl.s1.all")
        assert set(batch["port"]) == {1}
        now_us = time.time_ns() // 1_000
        assert all(abs(now_us - each) < SECONDS * 10**6 for each in batch["time_us"])
        state = observed("network.switch.p4runtime_ctrl.s1")
        assert bool(state["digests"]) == (switch == "embedded"), (
            "headers travel in lists where the switch has them"
        )
        (talker,) = observed("network.traffic.kitsune.s1")["talkers"]
        assert (talker["sender"]["ip"], talker["sender"]["port"]) == ("10.0.0.1", 1)


def raw(interface):
    opened = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    opened.bind((interface, 3))  # all frames, but of this interface only
    return opened
