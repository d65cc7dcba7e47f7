"""How channels to each switch are secured, by what the configuration says of it and of the controller."""

import ipaddress
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from dataplane.p4runtime.listening import UNIX
from sdnator.config import config_file
from sdnator.config.planned_switches import PlannedSwitch
from sdnator.errors import BadInput

if TYPE_CHECKING:
    from p4rt import ChannelSecurity

_TLS = ("tls_ca", "tls_certificate", "tls_key")


def security_of(switch: PlannedSwitch, controller: Mapping[str, Any]) -> "ChannelSecurity":
    """How the product speaks with a planned switch.

    Args:
        switch: as planned.
        controller: section `p4runtime_ctrl` of the configuration.
    """
    from p4rt import INSECURE  # not at the top: it loads gRPC

    if switch.insecure or _own_bmv2(switch):
        return INSECURE
    return _by_tls(controller)


def check_security(switch: PlannedSwitch, controller: Mapping[str, Any]) -> None:
    """Refuse a switch whose channel would be open to others.  Raises BadInput that says what to write."""
    ours = switch.kind in ("embedded", "bmv2")
    address = switch.listen if ours else switch.kind
    if not address or address.startswith(UNIX) or switch.insecure:
        return
    check(security_of(switch, controller), address)
    if switch.kind == "embedded" and not (switch.tls_certificate and switch.tls_key):
        raise BadInput(
            f"listen = {address}: set tls_certificate and tls_key of the switch (`sdnator cert init` creates them), "
            "or insecure = true in a lab"
        )


def switch_options(switch: PlannedSwitch, controller: Mapping[str, Any]) -> tuple[str, ...]:
    """Options of `python -m dataplane` for TLS of an embedded switch that the product starts."""
    if switch.kind != "embedded" or not switch.listen or switch.listen.startswith(UNIX):
        return ()
    if switch.insecure:
        return ("--insecure",)
    places = {
        "--tls-cert": switch.tls_certificate,
        "--tls-key": switch.tls_key,
        "--tls-client-ca": str(controller.get("tls_ca", "")),
    }
    return tuple(part for option, value in places.items() for part in (option, value))


def security_for(address: str, *, insecure: bool = False) -> "ChannelSecurity":
    """How to speak with a switch that somebody named by its address, by the configuration file.

    Args:
        address: HOST:PORT or unix:/PATH.
        insecure: somebody has allowed it, too.

    Raises:
        BadInput: neither TLS nor `insecure` is said of it; the configuration is wrong.
    """
    from p4rt import INSECURE, ChannelSecurity

    if address.startswith(UNIX):
        return ChannelSecurity()
    config = config_file.load(config_file.find())
    named = any(one.insecure and address in (one.kind, one.listen) for one in config.switches())
    if insecure or named:
        return INSECURE
    return check(_by_tls(config.section("p4runtime_ctrl")), address)


def _by_tls(controller: Mapping[str, Any]) -> "ChannelSecurity":
    from p4rt import ChannelSecurity

    ca, certificate, key = (str(controller.get(name, "")) for name in _TLS)
    return ChannelSecurity(ca=ca, certificate=certificate, key=key)


def check(security: "ChannelSecurity", address: str) -> "ChannelSecurity":
    """The same; raises BadInput that says what to write where `open_channel` would refuse it."""
    from p4rt import InsecureChannel

    try:
        security.check(address)
    except InsecureChannel as error:
        raise BadInput(str(error)) from None
    return security


def _own_bmv2(switch: PlannedSwitch) -> bool:
    """BMv2 has no TLS; the one that we start listens on loopback unless it is told to do otherwise."""
    if switch.kind != "bmv2":
        return False
    host = switch.listen.rpartition(":")[0].strip("[]")
    if host in ("", "localhost"):
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
