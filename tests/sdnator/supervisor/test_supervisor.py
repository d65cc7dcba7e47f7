"""Parts that die or hang are started again, for as long as it takes, and none waits for another."""

import os
import signal
import time

import pytest

from sdnator.errors import PipelineError
from sdnator.supervisor import Child, PartSpec, RestartPolicy, Supervisor

SECONDS = 60
QUICK = RestartPolicy(first_s=0.01, longest_s=0.05)


class Stage:
    """Makes parts of `fake_part`, and supervisors that end with the test."""

    def __init__(self, folder):
        self.folder = folder
        self.note = folder / "note"
        self.told = []
        self.supervisors = []

    def part(self, name, how="good", **more):
        arguments = ["tests.sdnator.supervisor.fake_part", how, str(self.note)]
        beats = more.get("silence_s", 0) > 0

        def start():
            return Child(name, arguments, self.folder, heartbeat=beats)

        return PartSpec(name=name, start=start, **{"restart": QUICK, **more})

    def supervisor(self, *parts):
        made = Supervisor(parts, self.told.append)
        self.supervisors.append(made)
        return made


@pytest.fixture
def stage(tmp_path):
    made = Stage(tmp_path)
    yield made
    for each in made.supervisors:
        each.stop()


def watch_until(supervisor, condition):
    deadline = time.monotonic() + SECONDS
    while not condition():
        assert time.monotonic() < deadline, supervisor.reports()
        supervisor.watch()
        supervisor.wait(0.02)


def report(supervisor, name):
    return next(each for each in supervisor.reports() if each.name == name)


def state(supervisor, name):
    return report(supervisor, name).state


def test_what_dies_again_and_again_is_degraded_but_never_given_up_and_others_run_on(stage):
    supervisor = stage.supervisor(stage.part("other"), stage.part("short", "short"))
    supervisor.start()
    before = supervisor.pids()["other"]
    watch_until(supervisor, lambda: report(supervisor, "short").restarts >= 12)
    assert state(supervisor, "short") == "degraded"
    assert report(supervisor, "short").cause == "short ended with exit code 0 with an empty log"
    assert (state(supervisor, "other"), supervisor.pids()["other"]) == ("running", before)
    assert stage.told[0] == "short ended with exit code 0 with an empty log: restarting it in 0.01 s"
    assert len(stage.told) < 20, "the same is not said again and again"


def test_a_stopped_part_is_killed_and_started_again(stage):
    supervisor = stage.supervisor(stage.part("hung", silence_s=0.5))
    supervisor.start()
    before = supervisor.pids()["hung"]
    os.kill(before, signal.SIGSTOP)
    watch_until(
        supervisor, lambda: supervisor.pids()["hung"] != before and state(supervisor, "hung") == "running"
    )
    assert "no heartbeat for 0.5 s, so it was killed" in report(supervisor, "hung").cause


def test_a_suspended_part_that_must_not_stand_still_is_killed_long_before_it_counts_as_hung(stage):
    supervisor = stage.supervisor(stage.part("switch", silence_s=3_600, suspended_s=0.2))
    supervisor.start()
    before = supervisor.pids()["switch"]
    os.kill(before, signal.SIGSTOP)
    watch_until(
        supervisor, lambda: supervisor.pids()["switch"] != before and state(supervisor, "switch") == "running"
    )
    assert "was suspended for 0.2 s" in report(supervisor, "switch").cause


def test_a_part_that_ran_well_until_it_was_suspended_comes_back_at_once_each_time(stage):
    policy = RestartPolicy(at_once=True, first_s=30.0, quick_s=0.1)
    supervisor = stage.supervisor(stage.part("switch", silence_s=3_600, suspended_s=0.2, restart=policy))
    supervisor.start()
    for restarts in (1, 2):
        os.kill(supervisor.pids()["switch"], signal.SIGSTOP)
        watch_until(
            supervisor,
            lambda restarts=restarts: (
                report(supervisor, "switch").restarts == restarts and state(supervisor, "switch") == "running"
            ),
        )
    assert sum(line.endswith("restarting it at once") for line in stage.told) == 2


def test_a_part_that_lives_but_makes_no_progress_is_started_again(stage):
    """Such as one whose dispatching thread has died."""
    supervisor = stage.supervisor(stage.part("silent", "silent", silence_s=0.5))
    supervisor.start()
    watch_until(supervisor, lambda: report(supervisor, "silent").restarts > 0)
    assert "hung" in report(supervisor, "silent").cause


def test_a_part_that_beats_is_left_alone(stage):
    supervisor = stage.supervisor(stage.part("good", silence_s=2.0), stage.part("short", "short"))
    supervisor.start()
    watch_until(supervisor, lambda: report(supervisor, "short").restarts > 30)
    assert report(supervisor, "good").restarts == 0


class Reserved:
    """Notes what the supervisor asks of a reserve."""

    def __init__(self):
        self.asked = []

    def prepare(self):
        self.asked.append("prepare")
        raise OSError("no process can be started now")

    def discard(self):
        self.asked.append("discard")


def test_what_runs_is_prepared_for_and_what_ends_needs_no_reserve(stage, monkeypatch):
    monkeypatch.setattr("sdnator.supervisor.part._PREPARE_AFTER_S", 0.0)
    reserve = Reserved()
    supervisor = stage.supervisor(stage.part("one", reserve=reserve))
    supervisor.start()
    watch_until(supervisor, lambda: reserve.asked)
    supervisor.stop()
    assert reserve.asked == ["prepare", "discard"]


def test_the_slow_start_of_one_delays_no_other(stage):
    supervisor = stage.supervisor(stage.part("slow", "slow"), stage.part("quick"))
    supervisor.start()
    for name in ("slow", "quick"):
        os.kill(supervisor.pids()[name], signal.SIGKILL)
    watch_until(
        supervisor, lambda: report(supervisor, "quick").restarts and state(supervisor, "quick") == "running"
    )
    assert state(supervisor, "slow") == "restarting"


def test_what_fails_at_first_is_told_with_its_last_words(stage):
    supervisor = stage.supervisor(stage.part("broken", "broken"))
    with pytest.raises(PipelineError, match=r"(?s)broken ended with exit code 1.*veth9"):
        supervisor.start()


def test_what_is_not_vital_may_fail_at_first(stage):
    supervisor = stage.supervisor(stage.part("page", "broken", vital=False), stage.part("good"))
    supervisor.start()
    watch_until(supervisor, lambda: state(supervisor, "page") == "degraded")
    assert state(supervisor, "good") == "running"


def test_a_death_without_restarts_is_an_error(stage):
    supervisor = stage.supervisor(stage.part("once", restart=None))
    supervisor.start()
    os.kill(supervisor.pids()["once"], signal.SIGKILL)
    with pytest.raises(PipelineError, match="once was killed by SIGKILL"):
        watch_until(supervisor, lambda: False)
    with pytest.raises(PipelineError, match="once was killed by SIGKILL"):
        supervisor.watch()  # who looks again learns it again


def test_parts_start_in_the_order_of_their_needs_and_stop_the_other_way_round(stage):
    supervisor = stage.supervisor(
        stage.part("first", "one"),
        stage.part("second", "two", after=("first",)),
        stage.part("third", needs=("second",)),
    )
    supervisor.start()
    supervisor.stop()
    words = ["one started", "two started", "good started", "good ended", "two ended", "one ended"]
    assert stage.note.read_text().splitlines() == words


def test_a_part_waits_with_its_restart_for_what_it_needs(stage):
    supervisor = stage.supervisor(stage.part("server", "slow"), stage.part("app", needs=("server",)))
    supervisor.start()
    for name in ("server", "app"):
        os.kill(supervisor.pids()[name], signal.SIGKILL)
    watch_until(supervisor, lambda: stage.note.read_text().count("slow started") == 2)
    assert stage.note.read_text().count("good started") == 1
    os.kill(supervisor.pids()["server"], signal.SIGKILL)
    watch_until(supervisor, lambda: stage.note.read_text().count("slow started") == 3)


def test_who_follows_a_part_is_renewed_with_it(stage):
    supervisor = stage.supervisor(stage.part("switch"), stage.part("controller", follows=("switch",)))
    supervisor.start()
    before = supervisor.pids()
    os.kill(before["switch"], signal.SIGKILL)
    watch_until(
        supervisor,
        lambda: (
            supervisor.pids()["controller"] != before["controller"]
            and state(supervisor, "controller") == "running"
        ),
    )
    assert report(supervisor, "controller").cause == "", "it was asked to end, and that is no death"


def test_a_stopped_part_ends_in_order_when_asked(stage):
    """SIGTERM alone would wait until it goes on."""
    supervisor = stage.supervisor(stage.part("good"))
    supervisor.start()
    os.kill(supervisor.pids()["good"], signal.SIGSTOP)
    supervisor.stop()
    assert stage.note.read_text().splitlines()[-1] == "good ended"


def test_wrong_names_are_refused(stage):
    with pytest.raises(ValueError, match="nobody"):
        stage.supervisor(stage.part("app", needs=("nobody",)))
    with pytest.raises(ValueError, match="another name"):
        stage.supervisor(stage.part("app"), stage.part("app"))
