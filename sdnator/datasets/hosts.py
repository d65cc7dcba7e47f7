"""Who is there: the devices of the house, its gateway, the cloud they call, and the intruder.

Addresses are those of the public Mirai capture, so that generated traffic can be spliced behind it.
"""

import ipaddress
from dataclasses import dataclass, field
from typing import Final


@dataclass(frozen=True)
class LanHost:
    """A device on the LAN."""

    mac_text: str
    ip_text: str
    mac: bytes = field(init=False, repr=False)
    ip: bytes = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "mac", bytes.fromhex(self.mac_text.replace(":", "")))
        object.__setattr__(self, "ip", address(self.ip_text))


def address(text: str) -> bytes:
    """An IPv4 or IPv6 address in network order."""
    return ipaddress.ip_address(text).packed


def _lan(mac: str, number: int) -> LanHost:
    return LanHost(mac, f"192.168.2.{number}")


GATEWAY: Final = _lan("4c:09:d4:c6:12:7b", 1)
PC: Final = _lan("40:8d:5c:4b:99:1d", 101)
PLUG_OLD: Final = _lan("34:ea:34:f1:04:83", 104)
WEBCAM: Final = _lan("c4:12:f5:db:4a:e2", 105)
CAMERA_WIRED: Final = _lan("5c:cf:7f:05:f2:c6", 108)
RECORDER: Final = _lan("48:02:2e:01:83:15", 109)
DOME: Final = _lan("3c:33:00:98:ee:fd", 110)
THERMOSTAT: Final = _lan("dc:20:08:3a:eb:e8", 111)
DOORBELL: Final = _lan("e0:b9:4d:08:71:23", 112)
CAMERA_CLOUD: Final = _lan("34:c3:d2:e0:fc:c9", 113)
MONITOR: Final = _lan("00:16:6c:7f:82:20", 115)
PLUG_A: Final = _lan("50:c7:bf:1c:9c:a6", 120)
PLUG_B: Final = _lan("50:c7:bf:1c:9c:c6", 119)
SINGLE_BOARD: Final = _lan("b8:27:eb:e1:a9:f6", 118)
CAMERA_P2P: Final = _lan("00:ec:04:56:93:03", 126)
CLOCK: Final = _lan("d4:6e:0e:2c:15:d4", 196)
SWITCH: Final = LanHost("00:14:1c:28:d6:06", "192.168.2.250")
ABSENT: Final = "192.168.2.106"
"""A device that was taken away; others still look for it."""

INFECTED: Final = CAMERA_CLOUD
INTRUDER: Final = _lan("00:0c:29:5e:71:b4", 66)
"""Loader and command-and-control, on the same LAN as in the lab of the original."""

LAN_HOSTS: Final = (
    *(GATEWAY, PC, PLUG_OLD, WEBCAM, CAMERA_WIRED, RECORDER, DOME, THERMOSTAT, DOORBELL, CAMERA_CLOUD),
    *(MONITOR, PLUG_A, PLUG_B, SINGLE_BOARD, CAMERA_P2P, CLOCK, INTRUDER),
)
BY_IP: Final = {host.ip: host for host in LAN_HOSTS}

CLOUD: Final = tuple(
    address(text)
    for text in (
        *("50.19.254.134", "122.248.234.207", "46.137.188.54", "122.226.84.253", "61.188.37.216"),
        *("120.24.59.150", "114.215.137.159", "104.199.156.58", "74.125.31.99", "61.220.62.219"),
        *("203.69.81.91", "210.61.248.232", "42.99.254.162", "119.29.29.29", "52.24.43.67", "52.25.66.250"),
        *("112.74.102.136", "54.154.5.26", "54.149.224.179"),
    )
)
TIME_SERVERS: Final = tuple(
    address(f"{61 + 3 * n}.{(37 * n) % 200}.{(91 * n) % 250}.{10 + n}") for n in range(45)
)
"""Stand-ins for a pool of time servers."""
DNS_PUBLIC: Final = (address("8.8.8.8"), address("114.114.114.114"))
SSDP_GROUP: Final = address("239.255.255.250")
IGMP_GROUP: Final = address("224.0.0.22")


def is_local(ip: bytes) -> bool:
    """On the LAN 192.168.2.0/24."""
    return ip[:3] == b"\xc0\xa8\x02"


def mac_towards(ip: bytes) -> bytes:
    """Destination MAC of a frame to an address: the host itself, its group, or the gateway."""
    if ip[0] >> 4 == 0xE:
        return b"\x01\x00\x5e" + bytes((ip[1] & 0x7F,)) + ip[2:]
    host = BY_IP.get(ip)
    return host.mac if host else GATEWAY.mac
