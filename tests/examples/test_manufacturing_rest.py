"""The emulated printers' REST interface, by a client that knows nothing of us."""

import asyncio
import contextlib
import socket
import threading

import pytest
import requests
import uvicorn
from hypothesis import given, settings
from hypothesis import strategies as st
from manufacturing.core.orders import Order, Scenario
from manufacturing.machine_assets.digest import DigestGate
from manufacturing.machine_assets.fleet import EmulatedFleet, TooEarly
from manufacturing.machine_assets.griffin import BadPrintFile, print_file, read_task
from manufacturing.machine_assets.printer_view import seconds_of
from manufacturing.machine_assets.rest_api import PrinterApi

TASK = Order(id=3, at=0.0, kind=2, jobs=9, volume=7.25, priority=True).task(4, 1)
SECONDS = 60


@pytest.fixture
def fleet():
    return EmulatedFleet(Scenario(name="normal", seed=1, machines=2))


@pytest.fixture
def printer(fleet):
    """Base URL and credentials of the second printer, served on a real port."""
    ports = {}
    listening = [socket.create_server(("127.0.0.1", 0)) for _ in fleet.printers]
    for number, one in enumerate(listening):
        ports[one.getsockname()[1]] = number
    config = uvicorn.Config(PrinterApi(fleet, ports).app, log_config=None, lifespan="off", ws="none")
    server = uvicorn.Server(config)
    thread = threading.Thread(target=asyncio.run, args=(server.serve(listening),))
    thread.start()
    url = f"http://127.0.0.1:{listening[1].getsockname()[1]}"
    found = requests.post(f"{url}/api/v1/auth/request", timeout=SECONDS).json()
    yield url, requests.auth.HTTPDigestAuth(found["id"], found["key"])
    server.should_exit = True
    thread.join()


def post(url, auth, **form):
    files = {"file": ("job.gcode", form.pop("file", print_file(TASK)))}
    return requests.post(f"{url}/api/v1/print_job", data=form, files=files, auth=auth, timeout=SECONDS)


def test_a_job_is_queued_printed_and_found_in_the_history(fleet, printer):
    """What is posted with digest authentication waits, is printed, and is told with its times."""
    url, auth = printer
    assert post(url, auth, jobname=TASK.name).status_code == 201
    waiting = requests.get(f"{url}/cluster-api/v1/print_jobs", timeout=SECONDS).json()
    assert [(job["name"], job["volume"], job["priority"]) for job in waiting] == [(TASK.name, 7.25, True)]
    assert requests.get(f"{url}/api/v1/print_job", timeout=SECONDS).status_code == 404
    for step in range(1, 9):
        clock = requests.put(f"{url}/simulation/clock", json={"step": step}, auth=auth, timeout=SECONDS)
        assert clock.json() == {"step": step}
    assert requests.get(f"{url}/api/v1/printer/status", timeout=SECONDS).json() == "printing"
    assert requests.get(f"{url}/api/v1/print_job/state", timeout=SECONDS).json() == "printing"
    nozzle = f"{url}/api/v1/printer/heads/0/extruders/0/hotend/temperature"
    hot = requests.get(nozzle, timeout=SECONDS).json()
    assert abs(hot["current"] - hot["target"]) < 5 < hot["target"]
    samples = requests.get(f"{url}/api/v1/printer/diagnostics/temperature_flow/20", timeout=SECONDS).json()
    assert samples[0] == ["Time", "temperature", "target", "flow"]
    assert len(samples) == 11
    fleet.printers[1].advance(20_000.0)
    (ended,) = requests.get(f"{url}/api/v1/history/print_jobs", timeout=SECONDS).json()
    assert (ended["name"], ended["result"]) == (TASK.name, "Finished")
    assert seconds_of(ended["datetime_cleaned"]) == fleet.printers[1].history[0].cleaned


def test_changes_want_credentials(fleet, printer):
    """Without them, with wrong ones, or with those of another printer nothing changes."""
    url, auth = printer
    wrong = requests.auth.HTTPDigestAuth(auth.username, "guess")
    for tried in (None, wrong):
        assert post(url, tried, jobname=TASK.name).status_code == 401
        state = requests.put(
            f"{url}/api/v1/print_job/state", json={"target": "abort"}, auth=tried, timeout=SECONDS
        )
        assert state.status_code == 401
    assert fleet.printers[1].queue == []
    assert requests.get(f"{url}/api/v1/auth/verify", auth=auth, timeout=SECONDS).status_code == 200


def test_a_waiting_job_is_withdrawn_and_a_print_aborted(fleet, printer):
    """DELETE takes a job out of the queue, a state of `abort` ends the print, maintenance comes before the next."""
    url, auth = printer
    uuid = post(url, auth, jobname=TASK.name).json()["uuid"]
    assert post(url, auth, jobname=TASK.name).status_code == 409
    gone = [
        requests.delete(f"{url}/cluster-api/v1/print_jobs/{uuid}", auth=auth, timeout=SECONDS).status_code
        for _ in range(2)
    ]
    assert gone == [204, 404]
    post(url, auth, jobname=TASK.name)
    fleet.go_to(1)
    aborted = requests.put(
        f"{url}/api/v1/print_job/state", json={"target": "abort"}, auth=auth, timeout=SECONDS
    )
    requests.put(f"{url}/api/v1/printer/maintenance", auth=auth, timeout=SECONDS)
    assert aborted.status_code == 204
    for step in (2, 3, 4):
        fleet.go_to(step)
    assert fleet.printers[1].status == "maintenance"
    assert fleet.printers[1].history[0].result == "Aborted"


@pytest.mark.parametrize(
    ("form", "says"),
    [
        ({"jobname": "first"}, "o012-j003-a0"),
        ({"jobname": TASK.name, "file": "G28"}, ";START_OF_HEADER"),
        ({"jobname": TASK.name, "position": "-1"}, "position '-1'"),
    ],
)
def test_a_bad_job_is_refused_with_the_reason(printer, form, says):
    """Name, file and place are checked."""
    url, auth = printer
    answer = post(url, auth, **form)
    assert answer.status_code == 400
    assert says in answer.json()["message"]


def test_bad_requests_are_refused(printer):
    """Unknown branches, states, steps and bodies get an error with a message, never a crash."""
    url, auth = printer
    assert requests.get(f"{url}/api/v1/printer/heads/7", timeout=SECONDS).status_code == 404
    for path, body, status in (
        ("/api/v1/print_job/state", b'{"target": "pause"}', 405),
        ("/api/v1/print_job/state", b"[]", 400),
        ("/simulation/clock", b'{"step": 9}', 409),
        ("/simulation/clock", b'{"step": "1"}', 400),
        ("/simulation/clock", b"x" * (257 << 10), 413),
    ):
        answer = requests.put(url + path, data=body, auth=auth, timeout=SECONDS)
        assert answer.status_code == status
        assert answer.json()["message"]


def test_time_passes_no_faster_than_declared():
    """At a speed-up of 600 a step of 300 s takes half a second."""
    now = [100.0]
    fleet = EmulatedFleet(Scenario(name="normal", seed=1, machines=1), 600.0, lambda: now[0])
    fleet.go_to(1)
    now[0] += 0.4
    with pytest.raises(TooEarly, match=r"0\.100 s"):
        fleet.go_to(2)
    now[0] += 0.1
    fleet.go_to(2)
    assert fleet.step == 2


@settings(max_examples=50, deadline=None)
@given(st.text(max_size=30), st.text(max_size=60))
def test_any_file_is_a_task_or_refused(name, text):
    """The reader of print files has one error."""
    header = print_file(TASK).replace("7250.00", text[:20])
    for tried in ((TASK.name, text), (name, print_file(TASK)), (TASK.name, header)):
        with contextlib.suppress(BadPrintFile):
            assert read_task(*tried).volume > 0
    assert read_task(TASK.name, print_file(TASK)) == TASK


@settings(max_examples=50, deadline=None)
@given(st.text(max_size=60))
def test_any_authorization_is_judged(text):
    """Whatever stands in the header: no is the answer."""
    gate = DigestGate()
    assert not gate.allows("PUT", "/", "Digest =")
    name, _ = gate.register()
    assert not gate.allows("PUT", "/", text)
    assert not gate.allows("PUT", "/", f'Digest username="{name}", uri="/", qop=auth, {text}')
