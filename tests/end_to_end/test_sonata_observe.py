"""Queries as an operator meets them: observed by a process that dies, and run again over the archive."""

import json
import subprocess
import sys

import pytest

from sdnator.testing.controller_run import BASE_US, ControllerRun, Heard
from sdnator.testing.query_traffic import BASE_US as TRAFFIC_US
from sdnator.testing.query_traffic import mixed
from sdnator.testing.waiting import wait_for
from tests.end_to_end.command import sdnator

PREFIX = "network.traffic_query.sonata"
KEY = f"{PREFIX}.new_tcp:threshold=10,window=2s"


@pytest.fixture
def stage(tmp_path):
    with ControllerRun(tmp_path) as stage:
        stage.run("apps.sonata_adapter.service", {})
        yield stage


def telemetry(states):
    found = states.values("network.switch")
    return found[-1]["telemetry"] if found else None


def observer(stage, *options):
    command = [
        sys.executable,
        "-m",
        "sdnator.cli.main",
        "observe",
        KEY,
        "--updates",
        stage.server.url,
        *options,
    ]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finished(process):
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err[-2000:]
    return out, err


def play(stage, frames):
    feed = stage.feed()
    times = [frame.time_us - TRAFFIC_US for frame in frames]
    feed.send(times, [frame.length for frame in frames], [frame.data for frame in frames])
    done = 0

    def processed():
        nonlocal done
        done += len(feed.verdicts())
        return done >= len(frames)

    wait_for(processed, 60)
    feed.close()


def test_the_last_consumers_death_takes_the_query_out_of_the_switch(stage):
    """Two processes share the entry; one is killed, one leaves: then the switch has nothing to send."""
    states = Heard(stage.engine("watcher"), "network.switch.p4runtime_ctrl.s1")
    stage.controller()
    killed, leaving = observer(stage), observer(stage, "--plot", "--json")
    try:
        wait_for(lambda: telemetry(states) == ["q0"], 120, stage.log)
        # both are known by now, or the second is the one that keeps the entry
        line = leaving.stdout.readline()
        assert json.loads(line)["records"] >= 0
        killed.kill()
        leaving.terminate()
        _, told = finished(leaving)
        assert "0 items" in told
        wait_for(lambda: telemetry(states) == [], 60, stage.log)
    finally:
        for process in (killed, leaving):
            process.kill()
            process.wait(60)
            process.stdout.close()
            process.stderr.close()


def test_the_archive_gives_the_results_of_the_live_run(stage):
    """Packets that somebody observed are kept; the query over them finds what the switch had reported."""
    engine = stage.engine("observer")
    states = Heard(engine, "network.switch.p4runtime_ctrl.s1")
    stage.controller()
    live = Heard(engine, KEY)
    packets = Heard(engine, "network.packets.p4runtime_ctrl.s1.all")
    wait_for(lambda: sorted(telemetry(states) or ()) == ["packets", "q0"], 60, stage.log)
    frames = mixed(["new_tcp", "port_scan"], seconds=6)
    play(stage, frames)
    wait_for(lambda: sum(len(item.value) for item in packets.items) == len(frames), 60)
    past: list[dict[str, object]] = []

    def same():
        done = sdnator("queries", "run", KEY, "--since", "1h", "--archive", stage.archive, "--json")
        assert done.returncode == 0, done.stderr[-2000:]
        past[:] = [json.loads(line) for line in done.stdout.splitlines()]
        return {row(each) for each in past} == {row(item.value) for item in live.items}

    wait_for(same, 120, lambda: (past, [dict(item.value) for item in live.items]))
    assert past
    assert all((each["window_start"] - BASE_US * 1000) % (2 * 10**9) == 0 for each in past)
    assert len(past) == len(live.items)


def row(value):
    return value["dst"], value["count"], value["window_start"], value["at"]
