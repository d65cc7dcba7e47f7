"""The REST interface of the printers: a subset of the Ultimaker 3's, with a queue as the Cluster API has it.

One server listens on a port for each printer.  Reading is free; whatever changes a printer wants digest
authentication.  Ours, and not of the real printers: `position` of a posted job, `PUT /printer/maintenance`, and
`/simulation/clock`, by which the driver lets simulated time pass.
"""

from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Final

import orjson
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from manufacturing.core.printer import Printer, QueueFull
from manufacturing.machine_assets import printer_view
from manufacturing.machine_assets.digest import DigestGate, TooManyUsers
from manufacturing.machine_assets.fleet import EmulatedFleet, TooEarly, WrongStep
from manufacturing.machine_assets.griffin import BadPrintFile, read_task

_BODY_BYTES: Final = 256 << 10
_MOST_HISTORY: Final = 1_000
_MOST_SAMPLES: Final = 1_000

Handler = Callable[[Request], Awaitable[Response]]


class PrinterAnswer(JSONResponse):
    """JSON."""

    def render(self, content: Any) -> bytes:
        """As bytes."""
        return orjson.dumps(content)


class PrinterApi:
    """The ASGI application of a fleet.

    Args:
        fleet: the printers.
        ports: port to the number of the printer behind it; may be filled later.
    """

    def __init__(self, fleet: EmulatedFleet, ports: Mapping[int, int]) -> None:
        self._fleet, self._ports = fleet, ports
        self._gates = [DigestGate() for _ in fleet.printers]
        self.requests = 0
        """Answered so far."""
        routes: list[tuple[str, str, Handler]] = [
            ("GET", "/api/v1/system", self._system),
            ("POST", "/api/v1/auth/request", self._request_credentials),
            ("GET", "/api/v1/auth/check/{name}", self._check_credentials),
            ("GET", "/api/v1/auth/verify", self._verify),
            ("GET", "/api/v1/printer", self._tree),
            ("GET", "/api/v1/printer/diagnostics/temperature_flow/{count:int}", self._samples),
            ("PUT", "/api/v1/printer/maintenance", self._maintain),
            ("GET", "/api/v1/printer/{path:path}", self._tree),
            ("GET", "/api/v1/print_job", self._job),
            ("POST", "/api/v1/print_job", self._enqueue),
            ("PUT", "/api/v1/print_job/state", self._set_state),
            ("GET", "/api/v1/print_job/{field}", self._job),
            ("GET", "/api/v1/history/print_jobs", self._history),
            ("GET", "/cluster-api/v1/print_jobs", self._queue),
            ("DELETE", "/cluster-api/v1/print_jobs/{uuid}", self._withdraw),
            ("GET", "/simulation/clock", self._clock),
            ("PUT", "/simulation/clock", self._set_clock),
        ]
        self.app = Starlette(
            routes=[Route(path, handler, methods=[method]) for method, path, handler in routes],
            exception_handlers={HTTPException: _refuse},
        )

    # who asks, and whom

    def _number(self, request: Request) -> int:
        self.requests += 1
        return self._ports[request.scope["server"][1]]

    def _printer(self, request: Request) -> Printer:
        return self._fleet.printers[self._number(request)]

    def _allowed(self, request: Request) -> Printer:
        """The printer, for a request that proves its credentials."""
        number = self._number(request)
        target = request.url.path + (f"?{request.url.query}" if request.url.query else "")
        gate = self._gates[number]
        if not gate.allows(request.method, target, request.headers.get("authorization", "")):
            raise HTTPException(
                401, "credentials of /api/v1/auth/request are needed", {"WWW-Authenticate": gate.challenge()}
            )
        return self._fleet.printers[number]

    async def _request_credentials(self, request: Request) -> Response:
        try:
            name, key = self._gates[self._number(request)].register()
        except TooManyUsers as error:
            raise HTTPException(429, str(error)) from None
        return PrinterAnswer({"id": name, "key": key})

    async def _check_credentials(self, request: Request) -> Response:
        known = self._gates[self._number(request)].knows(request.path_params["name"])
        return PrinterAnswer({"message": "authorized" if known else "unknown"})

    async def _verify(self, request: Request) -> Response:
        self._allowed(request)
        return PrinterAnswer({"message": "ok"})

    # what is read

    async def _system(self, request: Request) -> Response:
        name = self._printer(request).machine
        return PrinterAnswer(
            {"name": name, "variant": "Ultimaker 3", "hostname": name, "firmware": "emulated"}
        )

    async def _tree(self, request: Request) -> Response:
        found: Any = printer_view.printer_tree(self._printer(request))
        for part in request.path_params.get("path", "").strip("/").split("/"):
            if part:
                found = _branch(found, part)
        return PrinterAnswer(found)

    async def _samples(self, request: Request) -> Response:
        count = min(request.path_params["count"], _MOST_SAMPLES)
        return PrinterAnswer(printer_view.temperature_flow(self._printer(request), count))

    async def _job(self, request: Request) -> Response:
        job = printer_view.print_job(self._printer(request))
        if job is None:
            raise HTTPException(404, "no print job is in progress")
        field = request.path_params.get("field")
        return PrinterAnswer(job if field is None else _branch(job, field))

    async def _history(self, request: Request) -> Response:
        offset = _whole(request.query_params.get("offset", "0"), "offset")
        count = min(_whole(request.query_params.get("count", "50"), "count"), _MOST_HISTORY)
        return PrinterAnswer(printer_view.history(self._printer(request), offset, count))

    async def _queue(self, request: Request) -> Response:
        return PrinterAnswer(printer_view.queue(self._printer(request)))

    # what is changed

    async def _enqueue(self, request: Request) -> Response:
        printer = self._allowed(request)
        await _body(request)
        async with request.form(max_files=1, max_fields=4, max_part_size=_BODY_BYTES) as form:
            file = form.get("file")
            text = file if isinstance(file, str) or file is None else await file.read()
            place = form.get("position")
            name = str(form.get("jobname", ""))
        if text is None:
            raise HTTPException(400, "the form has no part `file` with a print file")
        plain = text if isinstance(text, str) else text.decode("utf-8", errors="replace")
        try:
            task = read_task(name, plain)
            if printer.knows(task.name):
                raise HTTPException(409, f"{printer.machine} has a job {task.name} already")
            printer.enqueue(task, None if place is None else _whole(str(place), "position"))
        except BadPrintFile as error:
            raise HTTPException(400, str(error)) from None
        except QueueFull as error:
            raise HTTPException(405, str(error)) from None
        return PrinterAnswer(
            {"message": "job queued", "uuid": printer_view.job_id(printer.machine, name)}, 201
        )

    async def _withdraw(self, request: Request) -> Response:
        printer = self._allowed(request)
        for task in printer.queue:
            if printer_view.job_id(printer.machine, task.name) == request.path_params["uuid"]:
                printer.withdraw(task.name)
                return Response(status_code=204)
        raise HTTPException(404, "no such job waits")

    async def _set_state(self, request: Request) -> Response:
        printer = self._allowed(request)
        target = _field(await _body(request), "target", str)
        if target != "abort":
            raise HTTPException(405, f"target {target[:32]!r}: the emulated printers know `abort` only")
        if not printer.abort():
            raise HTTPException(405, "no print is in progress that could be aborted")
        return Response(status_code=204)

    async def _maintain(self, request: Request) -> Response:
        self._allowed(request).maintain()
        return Response(status_code=204)

    async def _clock(self, _request: Request) -> Response:
        return PrinterAnswer({"step": self._fleet.step})

    async def _set_clock(self, request: Request) -> Response:
        self._allowed(request)
        try:
            self._fleet.go_to(_field(await _body(request), "step", int))
        except WrongStep as error:
            raise HTTPException(409, str(error)) from None
        except TooEarly as error:
            raise HTTPException(425, str(error)) from None
        return PrinterAnswer({"step": self._fleet.step})


async def _refuse(_request: Request, error: Exception) -> Response:
    if not isinstance(error, HTTPException):
        raise error
    return PrinterAnswer({"message": error.detail}, error.status_code, dict(error.headers or {}))


async def _body(request: Request) -> bytes:
    """The body, of bounded length; it can be read again."""
    length = request.headers.get("content-length", "")
    if not length.isdecimal() or int(length) > _BODY_BYTES:
        raise HTTPException(413, f"a body with Content-Length of at most {_BODY_BYTES} bytes is wanted")
    return await request.body()


def _field(body: bytes, name: str, kind: type[Any]) -> Any:
    try:
        found = orjson.loads(body)[name]
    except (orjson.JSONDecodeError, KeyError, TypeError):
        raise HTTPException(400, f'a JSON object with the field "{name}" is wanted') from None
    if type(found) is not kind:
        raise HTTPException(400, f'the field "{name}" is to be of type {kind.__name__}')
    return found


def _whole(text: str, name: str) -> int:
    if not text.isdecimal() or len(text) > 9:
        raise HTTPException(400, f"{name} {text[:16]!r}: a whole number is wanted")
    return int(text)


def _branch(value: Any, part: str) -> Any:
    if isinstance(value, dict) and part in value:
        return value[part]
    if isinstance(value, list) and part.isdecimal() and len(part) < 4 and int(part) < len(value):
        return value[int(part)]
    raise HTTPException(404, f"nothing is named {part[:64]!r} here")
