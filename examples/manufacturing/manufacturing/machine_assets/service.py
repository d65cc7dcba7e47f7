"""Printers' REST interfaces out, nothing of DUE in but where they are.

    emulated printers ──HTTP, a port each──► any client
                      └──► manufacturing.inventory.machine_assets

The schedulers and twins never speak to it: only the data driver knows that there is a REST interface.
"""

import asyncio
import socket
import sys
import threading
import time
from collections.abc import Sequence
from typing import Any, Final
from uuid import uuid4

import msgspec
import uvicorn

import due.service
from due import NO_WAIT, Capability, Engine, Interest
from manufacturing.core.orders import Scenario, ScenarioName
from manufacturing.machine_assets.fleet import EmulatedFleet
from manufacturing.machine_assets.rest_api import PrinterApi
from manufacturing.messages import INVENTORY, Inventory, to_value

INTERESTS: tuple[Interest, ...] = ()
CAPABILITIES = (Capability(INVENTORY, archive="always"),)
_AGAIN_S: Final = 0.5
_STOP_S: Final = 10.0


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the emulated fleet."""

    scenario: ScenarioName = "normal"
    seed: int = 0
    machines: int = 5
    speed_up: float = 0.0
    """Simulated seconds in a second at most; 0: as fast as the apps go."""
    host: str = "127.0.0.1"
    """Address to listen on."""


class MachineAssetsService:
    """The app as `due.service.run` drives it."""

    def __init__(self, engine: Engine, settings: Settings) -> None:
        self._engine, self._settings = engine, settings
        scenario = Scenario(name=settings.scenario, seed=settings.seed, machines=settings.machines)
        self.fleet = EmulatedFleet(scenario, settings.speed_up)
        self._ports: dict[int, int] = {}
        self._api = PrinterApi(self.fleet, self._ports)
        self._run = uuid4().hex[:12]
        self._told = float("-inf")
        self._server: uvicorn.Server | None = None
        self._thread: threading.Thread | None = None
        self._urls: dict[str, str] = {}

    def start(self) -> None:
        """Listen on a port for each printer."""
        sockets = []
        for number, printer in enumerate(self.fleet.printers):
            listening = socket.create_server((self._settings.host, 0))
            # accepted connections take it over; asyncio sees no TCP in such a socket, and answers would wait 40 ms
            listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            port = listening.getsockname()[1]
            self._ports[port] = number
            self._urls[printer.machine] = f"http://{self._settings.host}:{port}"
            sockets.append(listening)
        config = uvicorn.Config(
            self._api.app, log_config=None, access_log=False, lifespan="off", ws="none",
            limit_concurrency=1_000, server_header=False, timeout_graceful_shutdown=2,
        )  # fmt: skip
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(
            target=asyncio.run, args=(self._server.serve(sockets),), name="printers", daemon=True
        )
        self._thread.start()

    def tick(self) -> None:
        """Say now and then where the printers are, for drivers that come late."""
        if time.monotonic() - self._told >= _AGAIN_S:
            self._told = time.monotonic()
            self._engine.write(INVENTORY, to_value(Inventory(self._run, self._urls)), [NO_WAIT])

    def stop(self) -> None:
        """Close the ports."""
        if self._server is not None and self._thread is not None:
            self._server.should_exit = True
            self._thread.join(_STOP_S)

    def health(self) -> dict[str, Any]:
        """Requests, prints and faults so far."""
        printers = self.fleet.printers
        return {
            "requests": self._api.requests,
            "step": self.fleet.step,
            "prints": sum(len(printer.history) for printer in printers),
            "faults": sum(len(printer.faults_begun) for printer in printers),
            "ruined": sum(printer.ruined for printer in printers),
        }


def main(argv: Sequence[str] | None = None) -> int:
    """Run the app until a signal ends it."""
    return due.service.run("machine_assets", MachineAssetsService, Settings, INTERESTS, CAPABILITIES, argv)


if __name__ == "__main__":
    sys.exit(main())
