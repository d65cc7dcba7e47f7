"""Ports from the command line: NUMBER=KIND[:ARGUMENT]."""

from collections.abc import Callable, Iterable
from pathlib import Path

from dataplane.ports.capture_port import CapturePort
from dataplane.ports.pcap_port import PcapPort
from dataplane.ports.port import NullPort, Port, PortError

_MAX_PORT = 510
FORMS = "null, capture:SOCKET, pcap:IN.pcap[,OUT.pcap] (either may be empty), veth:INTERFACE"


def open_ports(options: Iterable[str], cpu_port: int, clock: Callable[[], int]) -> dict[int, Port]:
    """Open what `--port` options ask for.

    clock: the packets' clock, µs

    Raises PortError; ports opened before are closed again.
    """
    wanted = [(*parse(option, cpu_port), option) for option in options]
    numbers = [number for number, *_ in wanted]
    twice = {number for number in numbers if numbers.count(number) > 1}
    if twice:
        raise PortError(f"port {min(twice)} is given twice")
    ports: dict[int, Port] = {}
    try:
        for number, kind, argument, option in wanted:
            ports[number] = _open(kind, argument, option, clock)
    except PortError:
        for port in ports.values():
            port.close()
        raise
    return ports


def parse(option: str, cpu_port: int) -> tuple[int, str, str]:
    """(number, kind, argument).  Raises PortError."""
    name, equals, what = option.partition("=")
    kind, _, argument = what.partition(":")
    if not equals or not name.isascii() or not name.isdigit():
        raise PortError(f"port {option!r} is not NUMBER=KIND; kinds: {FORMS}")
    number = int(name)
    if number > _MAX_PORT or number == cpu_port:
        raise PortError(f"port {option!r}: numbers are 0..{_MAX_PORT} without the CPU port {cpu_port}")
    return number, kind, argument


def captures(options: Iterable[str]) -> bool:
    """Whether a capture drives the packets' clock."""
    return any(option.partition("=")[2].startswith(("capture:", "pcap:")) for option in options)


def _open(kind: str, argument: str, option: str, clock: Callable[[], int]) -> Port:
    if kind == "null" and not argument:
        return NullPort()
    if kind == "capture" and argument:
        return CapturePort(argument)
    if kind == "pcap" and argument:
        incoming, _, outgoing = argument.partition(",")
        return PcapPort(Path(incoming) if incoming else None, Path(outgoing) if outgoing else None, clock)
    if kind == "veth" and argument:
        # AF_PACKET is Linux only; the other kinds are not
        from dataplane.ports.veth_port import VethPort

        return VethPort(argument)
    raise PortError(f"port {option!r}: kinds are {FORMS}")
