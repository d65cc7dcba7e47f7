"""What was on its way when a block took effect: of everybody, and of the blocked sender.

A block holds from the lap behind that of the packet that made it due.  What the blocked sender sent until then has
passed: it is counted here, and never as stopped.
"""

import ipaddress
from collections.abc import Sequence
from itertools import islice
from typing import Final

import numpy as np
from numpy.typing import NDArray

from apps.messages import Confirmation, Decision, Target
from sdnator.capture.captures import Capture
from sdnator.replay.guards import batches
from sdnator.replay.survey import Survey

_HALF: Final = 64
_LOW: Final = (1 << _HALF) - 1


class InFlight:
    """The packets in flight of each block, by the block's id.

    Args:
        survey: the capture.
        decisions: of the firewall, in their order.
        confirmations: of the switch.
        sent: packets sent by the time of each confirmation.
        dropped: which packets the switch dropped.
    """

    def __init__(
        self,
        survey: Survey,
        decisions: Sequence[Decision],
        confirmations: Sequence[Confirmation],
        sent: Sequence[int],
        dropped: NDArray[np.bool_],
    ) -> None:
        self.of_all: dict[str, int] = {}
        """Packets of everybody that were sent after the one that made the block due, and before it took effect."""
        self.of_sender: dict[str, int] = {}
        """Those of the blocked sender among them, which passed."""
        self.packets = np.zeros(survey.packets, np.bool_)
        """Which packets of blocked senders passed in flight."""
        blocks = {each.id: each for each in reversed(decisions) if each.action == "block"}
        for confirmation, until in zip(confirmations, sent, strict=True):
            decision = blocks.get(confirmation.id)
            if decision is None or confirmation.state != "installed" or decision.id in self.of_all:
                continue
            behind = survey.time_ns[:until] > decision.event_time
            self.of_all[decision.id] = int(np.count_nonzero(behind))
            mine = np.zeros(survey.packets, np.bool_)
            if behind.any():
                mine[:until] = behind & ~dropped[:until] & _sent_by(survey, decision.target)[:until]
            self.of_sender[decision.id] = int(np.count_nonzero(mine))
            self.packets |= mine


def _sent_by(survey: Survey, target: Target) -> NDArray[np.bool_]:
    """Which packets come from a block's target."""
    found: NDArray[np.bool_]
    if target.kind == "mac":
        found = survey.eth_src == np.uint64(int(target.address.replace(":", ""), 16))
        return found
    network = ipaddress.ip_network(target.address)
    if network.version == 4:
        mask = np.uint32(int(network.netmask))
        found = (survey.ipv4_src & mask) == np.uint32(int(network.network_address))
        return found
    return _sent_by_ipv6(survey, int(network.network_address), int(network.netmask))


def _sent_by_ipv6(survey: Survey, address: int, mask: int) -> NDArray[np.bool_]:
    """The survey has no IPv6 addresses: the capture is read again."""
    found = np.zeros(survey.packets, np.bool_)
    with Capture(survey.path) as frames:
        for first, batch in batches(islice(iter(frames), survey.packets)):
            mine = batch["ip_version"] == 6
            for name, shift in (("ip_src_hi", _HALF), ("ip_src_lo", 0)):
                part = np.uint64(mask >> shift & _LOW)
                mine &= (batch[name] & part) == np.uint64(address >> shift & _LOW)
            found[first : first + len(mine)] = mine
    return found
