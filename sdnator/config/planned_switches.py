"""Switches of the configuration: ports and port forwarding, checked before anything starts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from dataplane.p4runtime.listening import is_address
from sdnator.config.up_settings import LearnPlan, SwitchPlan
from sdnator.errors import BadInput

_PORTS = range(511)


@dataclass(frozen=True, kw_only=True)
class PlannedSwitch:
    """A switch to start, or to use."""

    name: str = "s1"
    kind: str = "embedded"
    """embedded, bmv2, or HOST:PORT of a P4Runtime switch that runs already."""
    device_id: int = 1
    ports: Mapping[int, str] = field(default_factory=dict)
    """Port number to `veth:INTERFACE` or `null`, for a switch that `sdnator up` starts."""
    forward: Mapping[int, int] = field(default_factory=dict)
    """Ingress port to egress port."""
    learn: LearnPlan = field(default_factory=LearnPlan)
    fail: Literal["open", "closed"] = "open"
    mirror: bool = False
    listen: str = ""
    """HOST:PORT on which a switch that `sdnator up` starts serves P4Runtime; empty: a private address."""
    insecure: bool = False
    tls_certificate: str = ""
    tls_key: str = ""


def planned(plan: SwitchPlan, *, look: bool = True) -> PlannedSwitch:
    """Parse ports and port forwarding; raises BadInput naming the wrong one.  `look`: check the interfaces."""
    ports = parse_ports(plan.ports, plan.kind, look=look)
    learns = _checked_learning(plan, ports)
    return PlannedSwitch(
        name=plan.name,
        kind=plan.kind,
        device_id=plan.device_id,
        ports=ports,
        # forwarding between the only two ports would leave nothing to learn
        forward=parse_wires(plan.wires or (("none",) if learns else ()), ports, plan.kind),
        learn=plan.learn,
        fail=plan.fail,
        mirror=plan.mirror,
        listen=_checked_listen(plan),
        insecure=plan.insecure,
        tls_certificate=plan.tls_certificate,
        tls_key=plan.tls_key,
    )


def _checked_listen(plan: SwitchPlan) -> str:
    if not plan.listen:
        return ""
    if not is_address(plan.listen):
        raise BadInput(f"--grpc {plan.listen}: give HOST:PORT (port 0: any) or unix:/PATH")
    if plan.kind == "bmv2" and plan.listen.startswith("unix:"):
        raise BadInput(f"--grpc {plan.listen}: BMv2 listens on HOST:PORT only")
    if plan.kind not in ("embedded", "bmv2"):
        raise BadInput(
            f"--grpc {plan.listen}: the address of the switch at {plan.kind} cannot be set; leave it out"
        )
    return plan.listen


def _checked_learning(plan: SwitchPlan, ports: Mapping[int, str]) -> bool:
    if plan.learn.ports and plan.fail == "closed":
        raise BadInput(
            'fail = "closed" removes port forwarding only, not learnt entries: leave out fail or learn'
        )
    for port in plan.learn.ports:
        if port not in _PORTS[1:-1]:
            raise BadInput(f"learn.ports: {port}: ports are numbered from 1 to 509")
        if plan.kind in ("embedded", "bmv2") and port not in ports:
            raise BadInput(f"learn.ports: there is no port {port}; add {port}=veth:INTERFACE to ports")
    return bool(plan.learn.ports)


def parse_ports(options: Sequence[str], switch: str, *, look: bool = True) -> dict[int, str]:
    """`N=veth:NAME` or `N=null`, by number; raises BadInput naming the wrong one."""
    if switch not in ("embedded", "bmv2"):
        if not is_address(switch):
            raise BadInput(f"--switch {switch}: give embedded, bmv2, HOST:PORT or unix:/PATH")
        if options:
            raise BadInput(f"--port: the ports of the switch at {switch} are its own; leave --port out")
    ports: dict[int, str] = {}
    for option in options:
        number, _, kind = option.partition("=")
        place = _port_number(number, f"--port {option}")
        if place in ports:
            raise BadInput(f"--port {option}: port {place} is given twice")
        ports[place] = _port_kind(option, kind, switch, look=look)
    return ports


def _port_kind(option: str, kind: str, switch: str, *, look: bool) -> str:
    name = kind.removeprefix("veth:")
    if kind != "null" and (name == kind or not name):
        raise BadInput(f"--port {option}: give N=veth:INTERFACE or N=null (captures: `sdnator replay`)")
    if kind == "null" and switch == "bmv2":
        raise BadInput(f"--port {option}: BMv2 has interfaces only; give N=veth:INTERFACE")
    if look and kind != "null" and not Path("/sys/class/net", name).exists():
        raise BadInput(f"--port {option}: there is no interface {name}; see `ip link`")
    return kind


def require_compiler() -> None:
    """The embedded switch compiles its program; raises BadInput where nothing can."""
    from dataplane.compiler.c_build import compiler

    if compiler() is None:
        raise BadInput(
            "the embedded switch needs a C compiler, and there is none ($CC, cc, gcc, clang): install gcc, "
            "or use a switch of your own (--switch HOST:PORT)"
        )


def parse_wires(options: Sequence[str] | None, ports: Mapping[int, str], switch: str) -> dict[int, int]:
    """Ingress port to egress port, both ways; raises BadInput naming the wrong pair."""
    if not options:
        first, second, *more = [*ports, 0, 0]
        return {first: second, second: first} if len(more) == len(ports) == 2 else {}
    if list(options) == ["none"]:
        return {}
    forward: dict[int, int] = {}
    for option in options:
        ends = [_port_number(end, f"--wire {option}") for end in option.split("-")]
        if len(ends) != 2 or ends[0] == ends[1]:
            raise BadInput(f"--wire {option}: give two ports, such as 1-2, or none")
        for near, far in (ends, ends[::-1]):
            if near in forward:
                raise BadInput(f"--wire {option}: port {near} is already joined to another port")
            if switch in ("embedded", "bmv2") and near not in ports:
                raise BadInput(f"--wire {option}: there is no port {near}; add --port {near}=veth:INTERFACE")
            forward[near] = far
    return forward


def _port_number(text: str, option: str) -> int:
    # int() takes no more than some thousand digits
    if not text.isascii() or not text.isdecimal() or len(text) > 9 or int(text) not in _PORTS[1:-1]:
        raise BadInput(f"{option}: ports are numbered from 1 to 509")
    return int(text)
