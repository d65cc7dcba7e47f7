"""Frames that the switch's parser does not cover: their digests come with a copy of the frame.

    802.3 and SNAP frames, VLAN tags of type 0x9100     IP that ends early, is malformed, or carries neither
    ICMP that quotes no ports as far as the parser sees  TCP, UDP nor ICMP behind at most three extensions

`FALLBACK` is the packet request for them, `uncovered` finds the same frames among digests.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from apps.p4runtime_ctrl.telemetry.classifier import TelemetryRequest

IPV4: Final = 0x0800
IPV6: Final = 0x86DD
_TAG: Final = 0x9100
_ICMP, _ICMP6 = 1, 58
_LEAST_ETHERTYPE: Final = 0x600
_LATER_FRAGMENT: Final = 2
_FIRST_BIT: Final = 200

_CONDITIONS: Final[tuple[dict[str, Any], ...]] = (
    {"ethertype": [0, 0xFC00]},
    {"ethertype": [0x400, 0xFE00]},
    {"ethertype": _TAG},
    {"ethertype": IPV4, "l4_valid": [0, 1], "fragment": [0, 2]},
    {"ethertype": IPV6, "l4_valid": [0, 1], "fragment": [0, 2]},
    {"ethertype": IPV4, "protocol": _ICMP, "sport": [0, 0]},
    {"ethertype": IPV6, "protocol": _ICMP6, "sport": [0, 0]},
)
FALLBACK: Final = tuple(
    TelemetryRequest(name=f"fallback{place}", bit=_FIRST_BIT + place, conditions=conditions)
    for place, conditions in enumerate(_CONDITIONS)
)
"""Copies of the frames whose digests are incomplete."""


def uncovered(found: NDArray[Any]) -> NDArray[np.bool_]:
    """Which digests (by the members of the program's digest) are of such frames."""
    ethertype, protocol = found["ethertype"], found["protocol"]
    ip = (ethertype == IPV4) | (ethertype == IPV6)
    unread = ip & (found["l4_valid"] == 0) & (found["fragment"] & _LATER_FRAGMENT == 0)
    icmp = ((ethertype == IPV4) & (protocol == _ICMP)) | ((ethertype == IPV6) & (protocol == _ICMP6))
    unquoted = icmp & (found["sport"] == 0)
    return np.asarray((ethertype < _LEAST_ETHERTYPE) | (ethertype == _TAG) | unread | unquoted)
