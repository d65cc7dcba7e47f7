"""A printer as its REST interface shows it: plain JSON values in the words of the Ultimaker API."""

from datetime import UTC, datetime, timedelta
from typing import Any, Final
from uuid import UUID, uuid5

from manufacturing.core.orders import Task
from manufacturing.core.printer import Printer, PrintRecord
from manufacturing.machine_assets.griffin import MATERIALS

START: Final = datetime(2026, 1, 1, tzinfo=UTC)
"""When simulated time begins."""
_JOBS: Final = UUID("0f6a9c3e-94ee-4f52-8d5f-f2d1b3b3a7a4")


def moment(seconds: float) -> str:
    """Simulated time in ISO 8601."""
    return (START + timedelta(seconds=seconds)).isoformat()


def seconds_of(text: str) -> float:
    """Simulated time of an ISO 8601 text, s after the start; raises ValueError."""
    return (datetime.fromisoformat(text) - START).total_seconds()


def job_id(machine: str, name: str) -> str:
    """UUID of a job at a printer."""
    return str(uuid5(_JOBS, f"{machine}/{name}"))


def printer_tree(printer: Printer) -> dict[str, Any]:
    """`/api/v1/printer`, of which every branch can be asked for alone."""
    material = MATERIALS[printer.loaded] if printer.loaded >= 0 else ""
    return {
        "status": printer.status,
        "bed": {"type": "glass", "temperature": {"current": 22.0, "target": 0.0}},
        "heads": [
            {
                "extruders": [
                    {
                        "active_material": {"guid": material},
                        "hotend": {
                            "id": "AA 0.4",
                            "temperature": {"current": printer.nozzle, "target": printer.target},
                        },
                    }
                ]
            }
        ],
    }


def print_job(printer: Printer) -> dict[str, Any] | None:
    """`/api/v1/print_job`; None while there is none."""
    running = printer.running()
    if running is None:
        return None
    return {
        **_job(printer.machine, running.task),
        "state": running.phase,
        "progress": running.progress,
        "time_elapsed": running.elapsed,
        "time_total": running.total,
        "datetime_started": moment(running.started),
    }


def queue(printer: Printer) -> list[dict[str, Any]]:
    """`/cluster-api/v1/print_jobs`: what waits, in order."""
    return [{**_job(printer.machine, task), "status": "queued"} for task in printer.queue]


def history(printer: Printer, offset: int, count: int) -> list[dict[str, Any]]:
    """`/api/v1/history/print_jobs`, oldest first."""
    return [_ended(printer.machine, record) for record in printer.history[offset : offset + count]]


def temperature_flow(printer: Printer, count: int) -> list[list[Any]]:
    """`/api/v1/printer/diagnostics/temperature_flow/<count>`: a head, then the last samples while it printed."""
    rows = [
        [at, round(target + reading[0], 2), target, reading[1]]
        for at, target, reading in zip(
            printer.reading_times.tolist(), printer.targets.tolist(), printer.readings.tolist(), strict=True
        )
    ]
    return [["Time", "temperature", "target", "flow"], *rows[-count:]]


def _job(machine: str, task: Task) -> dict[str, Any]:
    return {
        "uuid": job_id(machine, task.name),
        "name": task.name,
        "material": MATERIALS[task.kind],
        "volume": task.volume,
        "priority": task.priority,
    }


def _ended(machine: str, record: PrintRecord) -> dict[str, Any]:
    return {
        **_job(machine, record.task),
        "result": record.result,
        "datetime_started": moment(record.started),
        "datetime_finished": moment(record.finished),
        "datetime_cleaned": moment(record.cleaned),
        "time_setup": record.setup,
    }
