"""The embedded switch as a process: `python -m dataplane --grpc unix:/run/me/s.sock --port 1=capture:/run/c.sock`.

Prints one JSON line {"ready": true, "grpc": ADDRESS, "pid": …, "base_us": …} when it serves; SIGTERM or SIGINT
ends it; it also ends when the process that started it does, and with exit code 1 when one of its threads dies.
It starts without a pipeline: the controller pushes one.  Restarted with the same ports, address and
--base-us, it continues as the same switch; the controller restores its entries.  With --spare it loads everything and
compiles the product's program, then waits: a spare is in service within a fraction of the time of a start.
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
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import grpc

from dataplane.compiler.c_build import compiler
from dataplane.errors import DataplaneError
from dataplane.faults import Faults
from dataplane.heartbeat import LivenessPipe, Turning
from dataplane.p4runtime.client_rights import DEFAULT, RIGHTS, CertificateRights
from dataplane.p4runtime.device import Device
from dataplane.p4runtime.listening import default_address, socket_path
from dataplane.p4runtime.pipeline import ForwardingPipeline, verify
from dataplane.p4runtime.server import P4RuntimeServer, ServerError
from dataplane.p4runtime.status import InvalidArgument
from dataplane.p4runtime.trust import TrustedPrograms, TrustError, default_file, own_program, read_program
from dataplane.packet_loop import PacketClock, PacketLoop
from dataplane.ports.port import Port
from dataplane.ports.port_options import FORMS, captures, open_ports
from dataplane.stop import Stop

_GC_ALLOCATIONS = 50_000
_PR_SET_PDEATHSIG = 1
_PRECEDENCE = 5
"""Steps of nice value above the programs beside the switch."""


def options() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m dataplane", description="The embedded P4Runtime switch.")
    add = parser.add_argument
    add(
        "--grpc",
        default="",
        metavar="ADDRESS",
        help="address of the P4Runtime server: unix:/PATH, or HOST:PORT (0: any)",
    )
    add("--device-id", type=int, default=1, help="P4Runtime device id (default 1)")
    add("--cpu-port", type=int, default=510, help="number of the port to the controller (default 510)")
    add("--port", action="append", default=[], metavar="N=KIND", help=f"a port; kinds: {FORMS}")
    add("--queue", type=int, default=4096, help="packet-ins that may wait for the controller (default 4096)")
    add("--tls-cert", type=Path, help="PEM certificate chain of the server; with --tls-key")
    add("--tls-key", type=Path, help="PEM private key of the server")
    add("--tls-client-ca", type=Path, help="PEM certificates of CAs; clients must then show a certificate")
    add(
        "--tls-rights",
        action="append",
        default=[],
        metavar="NAME=RIGHTS",
        help=f"rights of clients by the name (CN) of their certificate, some of {','.join(RIGHTS)}; default: "
        + " ".join(DEFAULT),
    )
    add(
        "--insecure",
        action="store_true",
        help="HOST:PORT without certificates: anyone who reaches it controls the switch",
    )
    add("--trust", action="append", default=[], metavar="SHA256", help="also allow this program")
    add(
        "--trust-file",
        type=Path,
        default=default_file(),
        metavar="FILE",
        help="file of allowed programs, one hash per line",
    )
    add("--base-us", type=int, metavar="N", help="zero of the packets' clock: µs since boot (default: now)")
    add(
        "--heartbeat-fd",
        type=int,
        metavar="N",
        help="write a byte per second there while all threads make progress",
    )
    add("--role", action="append", default=[], metavar="NAME", help="a role that controllers may claim")
    add(
        "--spare",
        action="store_true",
        help="prepare, and open ports and address when a byte arrives on standard input",
    )
    add("--state-json", metavar="FILE", help="write counters there at the end; - = standard output")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run until a signal; returns 0, 2 for a wrong option, 1 after an internal error."""
    arguments = options().parse_args(argv)
    _end_with_parent()
    stop = Stop((signal.SIGTERM, signal.SIGINT))
    try:
        return _run(arguments, stop)
    except DataplaneError as error:
        print(f"dataplane: {error}", file=sys.stderr)
        return 2


def _run(arguments: argparse.Namespace, stop: Stop) -> int:
    if compiler() is None:
        raise DataplaneError("no C compiler ($CC, cc, gcc, clang) to compile programs with: install gcc")
    clock = PacketClock(driven=captures(arguments.port), base_us=arguments.base_us)
    credentials, rights = _credentials(arguments), _rights(arguments)
    programs = TrustedPrograms(arguments.trust, arguments.trust_file)
    prepared = _prepared(arguments, clock, programs) if arguments.spare else None
    if arguments.spare and not (stop.readable_first(0) and os.read(0, 1)):
        return 0
    ports = open_ports(arguments.port, arguments.cpu_port, clock.now)
    if not captures(arguments.port):
        _raise_priority()
    device = Device(
        arguments.device_id,
        cpu_port=arguments.cpu_port,
        queue=arguments.queue,
        ports=ports,
        clock=clock.now,
        programs=programs,
        roles=[*arguments.role, *(rights.roles if rights is not None else ())],
        prepared=prepared,
    )
    loop = PacketLoop(device, ports, clock, on_end=stop.set)
    try:
        address = arguments.grpc or default_address(f"switch-{arguments.device_id}-{os.getpid()}.sock")
        server = P4RuntimeServer(device, address, credentials, rights)
        heartbeat = _heartbeat(arguments.heartbeat_fd, device, server, loop)
    except DataplaneError:
        for port in ports.values():
            port.close()
        raise
    faults = Faults(stop)
    # entries are many, long-lived and without cycles: scanning them repeatedly costs a third of a write
    gc.freeze()
    gc.set_threshold(_GC_ALLOCATIONS, 50, 100)
    loop.start()
    server.start()
    if heartbeat is not None:
        heartbeat.start()
    ready = {"ready": True, "grpc": server.address, "pid": os.getpid(), "base_us": clock.base_us}
    print(json.dumps(ready), flush=True)
    stop.wait()
    if loop.failed or faults.died:
        faults.end_soon()
    if heartbeat is not None:
        heartbeat.stop()
    server.stop()
    loop.stop()
    if arguments.state_json:
        _write(arguments.state_json, state(device, loop, ports))
    device.close()
    return 1 if loop.failed or faults.died else 0


def _raise_priority() -> None:
    """Where the system allows it, forwarding has precedence over apps that score, plan and restart beside it."""
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, os.getpriority(os.PRIO_PROCESS, 0) - _PRECEDENCE)


def _prepared(
    arguments: argparse.Namespace, clock: PacketClock, programs: TrustedPrograms
) -> ForwardingPipeline | None:
    """A pipeline of the product's program; None where that cannot be had: then the first controller's push makes one."""
    try:
        config = read_program(own_program())
        programs.check(config)  # it computes a hash that is asked for again
        return ForwardingPipeline(verify(config), cpu_port=arguments.cpu_port, clock=clock.now)
    except (TrustError, InvalidArgument) as error:
        print(f"dataplane: not prepared: {error}", file=sys.stderr)
        return None


def _heartbeat(descriptor: int | None, device: Device, *loops: Turning) -> LivenessPipe | None:
    return None if descriptor is None else LivenessPipe(descriptor, loops, out_of_range=device.out_of_range)


def state(device: Device, loop: PacketLoop, ports: Mapping[int, Port]) -> dict[str, Any]:
    """Counters of frames and messages, passed or lost."""
    pipeline = device.pipeline
    return {
        **device.counts,
        **loop.counts,
        "switch": {} if pipeline is None else pipeline.switch.statistics(),
        "out_of_range": {} if pipeline is None else pipeline.switch.out_of_range(),
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
    tcp = bool(arguments.grpc) and socket_path(arguments.grpc) is None
    if tcp and arguments.tls_client_ca is None and not arguments.insecure:
        raise ServerError(
            f"--grpc {arguments.grpc}: P4Runtime over TCP asks clients for certificates: give --tls-cert, --tls-key "
            "and --tls-client-ca (`sdnator cert init` makes the files), or --insecure in a lab"
        )
    if arguments.tls_cert is None and arguments.tls_key is None:
        if arguments.tls_client_ca is not None:
            raise ServerError("--tls-client-ca needs --tls-cert and --tls-key")
        return None
    if arguments.tls_cert is None or arguments.tls_key is None:
        raise ServerError("TLS needs both --tls-cert and --tls-key")
    try:
        chain = [(arguments.tls_key.read_bytes(), arguments.tls_cert.read_bytes())]
        ca = None if arguments.tls_client_ca is None else arguments.tls_client_ca.read_bytes()
    except OSError as error:
        raise ServerError(f"cannot read {error.filename}: {error.strerror}") from error
    return grpc.ssl_server_credentials(chain, root_certificates=ca, require_client_auth=ca is not None)


def _rights(arguments: argparse.Namespace) -> CertificateRights | None:
    """On a Unix socket gRPC shows no certificates, and the socket's mode decides who connects."""
    if arguments.tls_client_ca is None or socket_path(arguments.grpc) is not None:
        return None
    return CertificateRights(arguments.tls_rights or DEFAULT)


def _end_with_parent() -> None:
    if sys.platform != "linux":
        return
    # set by the parent, since it may die while we are still importing
    parent = int(os.environ.pop("DUE_PARENT", "0")) or os.getppid()
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:
        # it died before prctl took effect
        os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(main())
