"""What runs in the namespaces of the SYN flood demo: `python -m sdnator.demos.syn_flood.hosts ROLE OPTIONS.json`.

victim    TCP services that accept and close; counts their half-open connections
client    keeps connecting, from known and from ever new addresses
flood     sends the SYNs of a plan
counters  reads the guard's counters and the number of entries out of the switch

Each prints one JSON line when ready, reports in JSON lines, takes orders in JSON lines out of a FIFO
where it takes any, and ends at SIGTERM or with its parent.
"""

import asyncio
import contextlib
import ipaddress
import json
import os
import select
import selectors
import signal
import socket
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any, Final, TextIO

from due.drivers.embedded_redis import die_with_parent

_LOOK_S: Final = 0.05
_SYN_RECV: Final = "03"
_MOST_ORDERS: Final = 65_536
_OUTCOMES: Final = "ingress.guard_outcomes"
_DYNAMIC: Final = (
    "ingress.known_sources",
    "ingress.block_src",
    "ingress.block_mac",
    "ingress.block",
    "ingress.protect",
    "ingress.protected_hosts",
)
OUTCOMES: Final = (
    "known",
    "unchallenged",
    "challenged",
    "repeated",
    "proven",
    "over_last_meter",
    "cookie_sent",
    "cookie_capped",
    "cookie_returned",
)


def _ready() -> None:
    print(json.dumps({"ready": True}), flush=True)


def _report(options: dict[str, Any]) -> TextIO:
    return Path(options["report"]).open("a", encoding="utf-8", buffering=1)


def _orders(options: dict[str, Any]) -> TextIO:
    """The FIFO; opened for writing too, so that it never ends."""
    return os.fdopen(os.open(options["orders"], os.O_RDWR), encoding="utf-8", buffering=1)


def victim(options: dict[str, Any]) -> None:
    """Accept and close; tell the half-open connections of each service that has any."""
    services = options["services"]
    with contextlib.ExitStack() as stack, selectors.DefaultSelector() as ready, _report(options) as report:
        for address in services:
            family = socket.AF_INET6 if ":" in address else socket.AF_INET
            service = stack.enter_context(socket.socket(family, socket.SOCK_STREAM))
            service.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            service.bind((address, options["port"]))
            service.listen(options["backlog"])
            service.setblocking(False)
            ready.register(service, selectors.EVENT_READ)
        _ready()
        look = time.monotonic()
        while True:
            for key, _ in ready.select(max(0.0, look - time.monotonic())):
                with contextlib.suppress(OSError):  # gone before it was accepted
                    key.fileobj.accept()[0].close()  # type: ignore[union-attr]
            if time.monotonic() >= look:
                report.write(json.dumps({"at": time.time(), "half_open": half_open(options["port"])}) + "\n")
                look = time.monotonic() + _LOOK_S


def half_open(port: int) -> dict[str, int]:
    """Half-open connections by local address, in this network namespace."""
    found: Counter[str] = Counter()
    for name in ("tcp", "tcp6"):
        for line in Path("/proc/self/net", name).read_text(encoding="ascii").splitlines()[1:]:
            fields = line.split(None, 4)
            address, _, local_port = fields[1].partition(":")
            if fields[3] == _SYN_RECV and int(local_port, 16) == port:
                found[address] += 1
    return {_address(text): number for text, number in found.items()}


def _address(text: str) -> str:
    """An address of /proc/net/tcp: words of 32 bits in the machine's order."""
    words = (int(text[place : place + 8], 16).to_bytes(4, sys.byteorder) for place in range(0, len(text), 8))
    return str(ipaddress.ip_address(b"".join(words)))


@dataclass
class _Target:
    """Where a client connects to, and how often; changed by orders."""

    address: str = ""
    port: int = 0
    known_rate: float = 0.0
    new_rate: float = 0.0


class _Client:
    def __init__(self, options: dict[str, Any], report: TextIO) -> None:
        self._options = options
        self._report = report
        self._target = _Target()
        self._number = count()
        self._tasks: set[asyncio.Task[None]] = set()

    async def run(self, orders: TextIO) -> None:
        asyncio.get_running_loop().add_reader(
            orders, lambda: self._obey(os.read(orders.fileno(), _MOST_ORDERS))
        )
        await asyncio.gather(*(self._keep_connecting(kind) for kind in ("known", "new")))

    def _obey(self, lines: bytes) -> None:
        self._target = _Target(**json.loads(lines.splitlines()[-1]))

    def _sources(self, kind: str) -> Iterator[str]:
        """Known clients come back again and again; a new one is never seen a second time."""
        families = [ipaddress.ip_network(each) for each in self._options["prefixes"]]
        known = self._options["known"]
        for number in count():
            place = 10 + number % known if kind == "known" else self._options["first_new"] + number
            version = 6 if ":" in self._target.address else 4
            yield next(str(network[place]) for network in families if network.version == version)

    async def _keep_connecting(self, kind: str) -> None:
        sources = self._sources(kind)
        due = time.monotonic()
        while True:
            rate = getattr(self._target, f"{kind}_rate")
            due = max(due, time.monotonic() - 1.0)  # what was missed is not made up for in one go
            await asyncio.sleep(max(0.0, due - time.monotonic()))
            due += 1 / rate if rate else _LOOK_S
            if rate:
                task = asyncio.create_task(self._attempt(kind, next(sources)))
                self._tasks.add(task)
                task.add_done_callback(self._tasks.discard)

    async def _attempt(self, kind: str, source: str) -> None:
        """One connect() with a budget."""
        target = (self._target.address, self._target.port)
        number, begun = next(self._number), time.monotonic()
        self._tell({"number": number, "at": time.time(), "kind": kind, "to": target[0]})
        with socket.socket(
            socket.AF_INET6 if ":" in source else socket.AF_INET, socket.SOCK_STREAM
        ) as attempt:
            attempt.setblocking(False)
            attempt.bind((source, 0))
            try:
                connect = asyncio.get_running_loop().sock_connect(attempt, target)
                await asyncio.wait_for(connect, self._options["budget"])
                succeeded = True
            except OSError:  # TimeoutError is one
                succeeded = False
        self._tell({"number": number, "ok": succeeded, "ms": round((time.monotonic() - begun) * 1000, 1)})

    def _tell(self, line: dict[str, Any]) -> None:
        self._report.write(json.dumps(line) + "\n")


def client(options: dict[str, Any]) -> None:
    """Connect at the rates of the last order: a line for an attempt's begin, one for its end."""
    with _report(options) as report, _orders(options) as orders:
        _ready()
        asyncio.run(_Client(options, report).run(orders))


def flood(options: dict[str, Any]) -> None:
    """Send each plan that is ordered: a line with the time of the first frame, one at the end.

    An empty order, or any other, ends a flood before its time.
    """
    from sdnator.demos.syn_flood.frames import FloodPlan, make_flood
    from sdnator.demos.syn_flood.sender import send_flood

    with (
        _report(options) as report,
        _orders(options) as orders,
        socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0) as wire,
    ):
        wire.bind(("eth0", 0))
        _ready()

        def begun(first: float) -> None:
            report.write(json.dumps({"to": plan.victim, "first": first}) + "\n")

        while True:
            order = json.loads(orders.readline())
            if not order:  # to end what has ended by itself
                continue
            plan = FloodPlan(**order)
            sent = send_flood(wire, make_flood(plan), begun, lambda: _waiting(orders))
            report.write(json.dumps({"to": plan.victim, **sent.to_json()}) + "\n")


def _waiting(orders: TextIO) -> bool:
    return bool(select.select([orders], [], [], 0)[0])


def counters(options: dict[str, Any]) -> None:
    """Read the switch's counters every so often, and now and then the number of entries by table."""
    import grpc

    from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
    from p4rt import INSECURE, P4RuntimeStub, open_channel, p4runtime

    program = ProgramInfo.from_text(Path(options["p4info"]).read_text(encoding="utf-8"))
    outcomes = next(each.preamble.id for each in program.message.counters if each.preamble.name == _OUTCOMES)
    tables = {name: program.table(name).id for name in _DYNAMIC}
    limits = [("grpc.max_receive_message_length", -1)]
    with open_channel(options["grpc"], INSECURE, limits) as channel, _report(options) as report:
        stub = P4RuntimeStub(channel)

        def read(entity: Any) -> list[Any]:
            request = p4runtime.ReadRequest(device_id=options["device_id"], entities=[entity])
            return [each for answer in stub.Read(request) for each in answer.entities]

        _ready()
        for number in count():
            line: dict[str, Any] = {"at": time.time()}
            with contextlib.suppress(grpc.RpcError):  # the switch has no program yet
                counted = read(p4runtime.Entity(counter_entry=p4runtime.CounterEntry(counter_id=outcomes)))
                values = {
                    each.counter_entry.index.index: each.counter_entry.data.packet_count for each in counted
                }
                line |= {name: values.get(index, 0) for index, name in enumerate(OUTCOMES)}
                if number % options["entries_every"] == 0:
                    line["entries"] = {
                        name.rpartition(".")[2]: len(
                            read(p4runtime.Entity(table_entry=p4runtime.TableEntry(table_id=table)))
                        )
                        for name, table in tables.items()
                    }
                report.write(json.dumps(line) + "\n")
            time.sleep(options["every"])


ROLES: Final[dict[str, Callable[[dict[str, Any]], None]]] = {
    "victim": victim,
    "client": client,
    "flood": flood,
    "counters": counters,
}


def main() -> None:
    """Run one role."""
    die_with_parent(signal.SIGKILL)
    ROLES[sys.argv[1]](json.loads(Path(sys.argv[2]).read_text(encoding="utf-8")))


if __name__ == "__main__":
    main()
