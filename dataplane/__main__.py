"""The embedded switch as a process: `python -m dataplane --grpc 127.0.0.1:0 --port 1=capture:/run/s.sock`.

Prints one JSON line {"ready": true, "grpc": "HOST:PORT", "pid": …} when it serves; SIGTERM or SIGINT ends
it; it also ends when the process that started it does.  It starts without a pipeline: the controller
pushes one.
"""

import p4rt  # noqa: F401  # isort: skip  # before anything loads gRPC: it says how gRPC waits

import argparse
import ctypes
import gc
import json
import os
import signal
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import grpc

from dataplane.device import Device
from dataplane.errors import DataplaneError
from dataplane.p4runtime_server import P4RuntimeServer, ServerError
from dataplane.packet_loop import PacketClock, PacketLoop
from dataplane.port_options import FORMS, captures, open_ports
from dataplane.ports import Port
from dataplane.stop import Stop

_GC_ALLOCATIONS = 50_000
_PR_SET_PDEATHSIG = 1


def options() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m dataplane", description="The embedded P4Runtime switch.")
    add = parser.add_argument
    add("--grpc", default="127.0.0.1:0", metavar="HOST:PORT", help="where to serve P4Runtime; port 0 = any")
    add("--device-id", type=int, default=1, help="P4Runtime device id (default 1)")
    add("--cpu-port", type=int, default=510, help="port number of the CPU (default 510)")
    add("--port", action="append", default=[], metavar="N=KIND", help=f"a port; kinds: {FORMS}")
    add("--backend", choices=("auto", "c", "python"), default="auto", help="how programs are run")
    add("--queue", type=int, default=4096, help="packet-ins that may wait for the controller (default 4096)")
    add("--tls-cert", type=Path, help="PEM certificate chain of the server; with --tls-key")
    add("--tls-key", type=Path, help="PEM private key of the server")
    add("--tls-client-ca", type=Path, help="PEM certificates of CAs; clients must then show a certificate")
    add("--state-json", metavar="FILE", help="write counts there at the end; - = standard output")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run until a signal comes; 0, 2 where an option cannot be met, 1 after a fault of our own."""
    arguments = options().parse_args(argv)
    _end_with_parent()
    stop = Stop((signal.SIGTERM, signal.SIGINT))
    try:
        return _run(arguments, stop)
    except DataplaneError as error:
        print(f"dataplane: {error}", file=sys.stderr)
        return 2


def _run(arguments: argparse.Namespace, stop: Stop) -> int:
    clock = PacketClock(driven=captures(arguments.port))
    credentials = _credentials(arguments)
    ports = open_ports(arguments.port, arguments.cpu_port, clock.now)
    device = Device(
        arguments.device_id,
        cpu_port=arguments.cpu_port,
        backend=arguments.backend,
        queue=arguments.queue,
        ports=ports,
        clock=clock.now,
    )
    try:
        server = P4RuntimeServer(device, arguments.grpc, credentials)
    except ServerError:
        for port in ports.values():
            port.close()
        raise
    loop = PacketLoop(device, ports, clock, on_end=stop.set)
    # entries are many, live long and form no cycles: looking through them again and again costs a third of a write
    gc.freeze()
    gc.set_threshold(_GC_ALLOCATIONS, 50, 100)
    loop.start()
    server.start()
    print(json.dumps({"ready": True, "grpc": server.address, "pid": os.getpid()}), flush=True)
    stop.wait()
    failed = loop.failed
    server.stop()
    loop.stop()
    if arguments.state_json:
        _write(arguments.state_json, state(device, loop, ports))
    device.close()
    return 1 if failed else 0


def state(device: Device, loop: PacketLoop, ports: Mapping[int, Port]) -> dict[str, Any]:
    """Counts of everything that passed or was lost."""
    pipeline = device.pipeline
    return {
        **device.counts,
        **loop.counts,
        "switch": {} if pipeline is None else pipeline.switch.statistics(),
        "ports": {number: asdict(port.counters) for number, port in ports.items()},
    }


def _write(where: str, counts: Mapping[str, Any]) -> None:
    text = json.dumps(counts) + "\n"
    if where == "-":
        sys.stdout.write(text)
        sys.stdout.flush()
    else:
        Path(where).write_text(text, encoding="utf-8")


def _credentials(arguments: argparse.Namespace) -> grpc.ServerCredentials | None:
    if arguments.tls_cert is None and arguments.tls_key is None:
        return None
    if arguments.tls_cert is None or arguments.tls_key is None:
        raise ServerError("TLS needs both --tls-cert and --tls-key")
    try:
        chain = [(arguments.tls_key.read_bytes(), arguments.tls_cert.read_bytes())]
        ca = None if arguments.tls_client_ca is None else arguments.tls_client_ca.read_bytes()
    except OSError as error:
        raise ServerError(f"cannot read {error.filename}: {error.strerror}") from error
    return grpc.ssl_server_credentials(chain, root_certificates=ca, require_client_auth=ca is not None)


def _end_with_parent() -> None:
    if sys.platform != "linux":
        return
    # told by whoever starts us, for it may die while we are still importing
    parent = int(os.environ.pop("DUE_PARENT", "0")) or os.getppid()
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:
        # it died before the kernel knew of our wish
        os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(main())
