"""What runs in the namespaces of the SYN flood demo: `python -m sdnator.syn_flood_hosts ROLE OPTIONS.json`.

victim    a TCP service that accepts and closes
client    keeps connecting, from known and from ever new addresses; one JSON line an attempt
flood     sends SYNs from its SIGUSR1 on
counters  reads the guard's counters and the number of entries out of the switch; one JSON line a reading

Each prints one JSON line when ready, and ends at SIGTERM or with its parent.
"""

import asyncio
import contextlib
import ipaddress
import json
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TextIO

from due.drivers.embedded_redis import die_with_parent
from sdnator.syn_flood_frames import FloodPlan, make_frames

_BURST_S = 0.002
_OUTCOMES = "ingress.guard_outcomes"
_DYNAMIC = (
    "ingress.known_sources",
    "ingress.block_src",
    "ingress.block_mac",
    "ingress.block",
    "ingress.protect",
)
OUTCOMES = (
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


def victim(options: dict[str, Any]) -> None:
    """Accept and close."""
    family = socket.AF_INET6 if ":" in options["address"] else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as service:
        service.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        service.bind((options["address"], options["port"]))
        service.listen(options["backlog"])
        _ready()
        while True:
            connection, _ = service.accept()
            connection.close()


def client(options: dict[str, Any]) -> None:
    """Connect at fixed rates until killed."""
    with Path(options["report"]).open("a", encoding="utf-8", buffering=1) as report:
        _ready()
        asyncio.run(_attempts(options, report))


async def _attempts(options: dict[str, Any], report: TextIO) -> None:
    network = ipaddress.ip_network(options["prefix"])
    known = [str(network[10 + each]) for each in range(options["known"])]
    fresh = (str(network[number]) for number in range(options["first_new"], network.num_addresses))
    await asyncio.gather(
        _keep_connecting("known", _cycle(known), options["known_rate"], options, report),
        _keep_connecting("new", fresh, options["new_rate"], options, report),
    )


def _cycle(addresses: list[str]) -> Iterator[str]:
    while True:
        yield from addresses


async def _keep_connecting(
    kind: str, sources: Iterator[str], rate: float, options: dict[str, Any], report: TextIO
) -> None:
    tasks: set[asyncio.Task[None]] = set()
    begun = time.monotonic()
    for number, source in enumerate(sources if rate else ()):
        await asyncio.sleep(max(0.0, begun + number / rate - time.monotonic()))
        task = asyncio.create_task(_attempt(kind, source, options, report))
        tasks.add(task)
        task.add_done_callback(tasks.discard)


async def _attempt(kind: str, source: str, options: dict[str, Any], report: TextIO) -> None:
    """One connect() with a budget."""
    family = socket.AF_INET6 if ":" in source else socket.AF_INET
    at, begun = time.time(), time.monotonic()
    with socket.socket(family, socket.SOCK_STREAM) as attempt:
        attempt.setblocking(False)
        attempt.bind((source, 0))
        try:
            target = (options["address"], options["port"])
            await asyncio.wait_for(
                asyncio.get_running_loop().sock_connect(attempt, target), options["budget"]
            )
            succeeded = True
        except OSError:  # TimeoutError is one
            succeeded = False
    spent = (time.monotonic() - begun) * 1000
    report.write(json.dumps({"at": at, "kind": kind, "ok": succeeded, "ms": round(spent, 1)}) + "\n")


def flood(options: dict[str, Any]) -> None:
    """Send the frames at a steady rate; a report with the time of the first and the number sent."""
    report = Path(options.pop("report"))
    plan = FloodPlan(**options)
    frames = [row.tobytes() for row in make_frames(plan)]
    told: list[int] = []
    # a handler, not a mask: numpy's threads exist already and would take the signal; a list, not an
    # Event, which its own waiter may hold when the handler interrupts it
    signal.signal(signal.SIGUSR1, lambda number, _: told.append(number))
    with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0) as wire:
        wire.bind(("eth0", 0))
        _ready()
        while not told:
            time.sleep(_BURST_S)
        first, begun, sent, failed = time.time(), time.monotonic(), 0, 0
        report.write_text(json.dumps({"first": first}) + "\n", encoding="utf-8")
        while sent < len(frames):
            due = min(len(frames), int((time.monotonic() - begun) * plan.rate) + 1)
            for frame in frames[sent:due]:
                try:
                    wire.send(frame)
                except OSError:  # the interface's queue is full
                    failed += 1
            sent = due
            time.sleep(_BURST_S)
    seconds = time.monotonic() - begun
    text = json.dumps({"first": first, "sent": sent - failed, "failed": failed, "seconds": seconds})
    report.write_text(text + "\n", encoding="utf-8")
    signal.pause()


def counters(options: dict[str, Any]) -> None:
    """Read the switch's counters every so often."""
    import grpc

    from apps.p4runtime_ctrl.p4info import Program
    from p4rt import P4RuntimeStub, p4runtime

    program = Program.from_text(Path(options["p4info"]).read_text(encoding="utf-8"))
    outcomes = next(each.preamble.id for each in program.message.counters if each.preamble.name == _OUTCOMES)
    tables = [program.table(name).id for name in _DYNAMIC]
    limits = [("grpc.max_receive_message_length", -1)]
    with grpc.insecure_channel(options["grpc"], options=limits) as channel:
        stub = P4RuntimeStub(channel)

        def read(entity: Any) -> list[Any]:
            request = p4runtime.ReadRequest(device_id=options["device_id"], entities=[entity])
            return [each for answer in stub.Read(request) for each in answer.entities]

        _ready()
        with Path(options["report"]).open("a", encoding="utf-8", buffering=1) as report:
            for number in range(sys.maxsize):
                line: dict[str, Any] = {"at": time.time()}
                with contextlib.suppress(grpc.RpcError):  # the switch has no program yet
                    counted = read(
                        p4runtime.Entity(counter_entry=p4runtime.CounterEntry(counter_id=outcomes))
                    )
                    values = {
                        each.counter_entry.index.index: each.counter_entry.data.packet_count
                        for each in counted
                    }
                    line |= {name: values.get(index, 0) for index, name in enumerate(OUTCOMES)}
                    if number % options["entries_every"] == 0:
                        entries = (p4runtime.TableEntry(table_id=table) for table in tables)
                        line["entries"] = sum(
                            len(read(p4runtime.Entity(table_entry=each))) for each in entries
                        )
                    report.write(json.dumps(line) + "\n")
                time.sleep(options["every"])


ROLES: dict[str, Callable[[dict[str, Any]], None]] = {
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
