"""One printer over its REST interface: reads its state, and changes its queue."""

from typing import Any, Final, Literal

import httpx
import msgspec

from manufacturing.core.orders import Task
from manufacturing.core.printer import (
    READING_S,
    STEP_S,
    Phase,
    PrintRecord,
    Report,
    Result,
    RunningPrint,
    Status,
)
from manufacturing.machine_assets.griffin import kind_of, print_file
from manufacturing.machine_assets.printer_view import seconds_of

_SAMPLES: Final = round(STEP_S / READING_S) + 1
_PAGE: Final = 200
_MOST_BYTES: Final = 8 << 20


class PrinterUnreachable(Exception):
    """A printer did not answer, or not as it should; the text says which and what it said."""


class _Job(msgspec.Struct, frozen=True):
    """What all jobs have, whether waiting, printing or ended."""

    uuid: str
    name: str
    material: str
    volume: float
    priority: bool

    def task(self) -> Task:
        kind = kind_of(self.material)
        order, number, attempt = (int(part[1:]) for part in self.name.split("-"))
        return Task(order, number, attempt, kind, self.volume, self.priority)


class _Running(_Job, frozen=True):
    state: Phase
    progress: float
    time_elapsed: int
    time_total: int
    datetime_started: str


class _Ended(_Job, frozen=True):
    result: Result
    datetime_started: str
    datetime_finished: str
    datetime_cleaned: str
    time_setup: float


class _Temperature(msgspec.Struct, frozen=True):
    current: float
    target: float


class _Material(msgspec.Struct, frozen=True):
    guid: str


class _Hotend(msgspec.Struct, frozen=True):
    temperature: _Temperature


class _Extruder(msgspec.Struct, frozen=True):
    active_material: _Material
    hotend: _Hotend


class _Head(msgspec.Struct, frozen=True):
    extruders: tuple[_Extruder, ...]


class _Tree(msgspec.Struct, frozen=True):
    status: Status
    heads: tuple[_Head, ...]


class PrinterClient:
    """The driver's side of one printer.

    Args:
        machine: its name.
        url: of its REST interface.
        client: shared by all printers; bounds time and connections.
    """

    def __init__(self, machine: str, url: str, client: httpx.Client) -> None:
        self.machine = machine
        self.queue: list[Task] = []
        """What waited when it was read last."""
        self.history: list[PrintRecord] = []
        """All prints that have ended, oldest first."""
        self._url, self._client = url, client
        self._auth: httpx.DigestAuth | None = None

    def clock(self) -> int:
        """The step that the fleet's time has reached."""
        found: int = self._read("/simulation/clock", dict[str, int])["step"]
        return found

    def set_clock(self, step: int) -> bool:
        """Let simulated time pass; False: it is too early for this step."""
        answer = self._change("PUT", "/simulation/clock", {200, 425}, json={"step": step})
        return answer.status_code == httpx.codes.OK

    def read(self, step: int, *, readings: bool) -> Report:
        """Everything that schedulers and twins want to know; `ended` is empty, see `history`."""
        try:
            return self._report(step, readings=readings)
        except (ValueError, IndexError) as error:
            raise PrinterUnreachable(f"{self.machine}: {error}") from None

    def _report(self, step: int, *, readings: bool) -> Report:
        tree = self._read("/api/v1/printer", _Tree)
        running = self._running() if tree.status == "printing" else None
        self.queue = [job.task() for job in self._read("/cluster-api/v1/print_jobs", tuple[_Job, ...])]
        self._read_history()
        loaded = kind_of(tree.heads[0].extruders[0].active_material.guid)
        return Report(
            self.machine, step, step * STEP_S, tree.status, loaded, running, tuple(self.queue), (),
            self._readings() if readings else (),
        )  # fmt: skip

    def _running(self) -> RunningPrint | None:
        job = self._read("/api/v1/print_job", _Running)
        return RunningPrint(
            job.task(),
            seconds_of(job.datetime_started),
            job.state,
            job.time_elapsed,
            job.time_total,
            job.progress,
        )

    def _read_history(self) -> None:
        while True:
            path = f"/api/v1/history/print_jobs?offset={len(self.history)}&count={_PAGE}"
            page = self._read(path, tuple[_Ended, ...])
            self.history += [
                PrintRecord(
                    job.task(),
                    seconds_of(job.datetime_started),
                    seconds_of(job.datetime_finished),
                    seconds_of(job.datetime_cleaned),
                    job.result,
                    job.time_setup,
                )
                for job in page
            ]
            if len(page) < _PAGE:
                return

    def _readings(self) -> tuple[tuple[float, float], ...]:
        path = f"/api/v1/printer/diagnostics/temperature_flow/{_SAMPLES}"
        rows = self._read(path, list[tuple[Any, Any, Any, Any]])[1:]
        return tuple((round(nozzle - target, 2), flow) for _, nozzle, target, flow in rows)

    def enqueue(self, task: Task, place: int) -> None:
        """Post a job to a place of the queue; one that the printer has already is left alone."""
        form = {"jobname": task.name, "position": str(place)}
        files = {"file": (f"{task.name}.gcode", print_file(task).encode(), "text/x-gcode")}
        self._change("POST", "/api/v1/print_job", {201, 409}, data=form, files=files)

    def withdraw(self, name: str) -> None:
        """Take a waiting job out of the queue; one that waits no longer is left alone."""
        jobs = self._read("/cluster-api/v1/print_jobs", tuple[_Job, ...])
        for job in jobs:
            if job.name == name:
                self._change("DELETE", f"/cluster-api/v1/print_jobs/{job.uuid}", {204, 404})

    def maintain(self) -> None:
        """Abort the print in progress, if there is one, and have the printer maintained."""
        self._change("PUT", "/api/v1/print_job/state", {204, 405}, json={"target": "abort"})
        self._change("PUT", "/api/v1/printer/maintenance", {204})

    def _read(self, path: str, kind: Any) -> Any:
        try:
            answer = self._client.get(self._url + path)
            if answer.status_code == httpx.codes.OK and len(answer.content) <= _MOST_BYTES:
                return msgspec.json.decode(answer.content, type=kind)
        except (httpx.HTTPError, msgspec.MsgspecError) as error:
            raise PrinterUnreachable(f"{self.machine}: GET {path}: {error}") from None
        raise PrinterUnreachable(f"{self.machine}: GET {path}: {answer.status_code} {answer.text[:200]}")

    def _change(
        self, method: Literal["POST", "PUT", "DELETE"], path: str, good: set[int], **content: Any
    ) -> httpx.Response:
        try:
            if self._auth is None:
                self._auth = self._credentials()
            answer = self._client.request(method, self._url + path, auth=self._auth, **content)
        except httpx.HTTPError as error:
            raise PrinterUnreachable(f"{self.machine}: {method} {path}: {error}") from None
        if answer.status_code not in good:
            raise PrinterUnreachable(
                f"{self.machine}: {method} {path}: {answer.status_code} {answer.text[:200]}"
            )
        return answer

    def _credentials(self) -> httpx.DigestAuth:
        answer = self._client.post(
            f"{self._url}/api/v1/auth/request", data={"application": "SDNator", "user": "data_driver"}
        )
        try:
            found = msgspec.json.decode(answer.content, type=dict[str, str])
            return httpx.DigestAuth(found["id"], found["key"])
        except (msgspec.MsgspecError, KeyError):
            raise PrinterUnreachable(f"{self.machine}: no credentials: {answer.text[:200]}") from None
