"""Blocks in force on generated traffic: what the entries of the switch program would drop."""

import ipaddress
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from apps.messages import Decision, Target


class ModelledBlocks:
    """All of them, by the decision's id.  A packet is looked up, so that many blocks cost no more than one."""

    def __init__(self) -> None:
        self._targets: dict[str, Target] = {}
        self._addresses: Counter[int] = Counter()
        self._senders: Counter[tuple[int, int]] = Counter()
        """MACs on a port."""
        self._macs: Counter[int] = Counter()
        """MACs on any port."""

    def decide(self, decision: Decision) -> None:
        """Block, extend or lift."""
        if decision.action == "unblock":
            target = self._targets.pop(decision.id, None)
            if target is not None:
                self._count(target, -1)
        elif decision.id not in self._targets:
            self._targets[decision.id] = decision.target
            self._count(decision.target, 1)

    def _count(self, target: Target, change: int) -> None:
        if target.kind == "mac":
            mac = int(target.address.replace(":", ""), 16)
            if target.port is None:
                _add(self._macs, mac, change)
            else:
                _add(self._senders, (mac, target.port), change)
            return
        address = ipaddress.ip_address(target.address)
        if address.version == 4:
            _add(self._addresses, int(address), change)

    def drops(self, columns: Mapping[str, Any]) -> npt.NDArray[np.bool_]:
        """Which packets one of them drops."""
        found = np.zeros(len(columns["port"]), np.bool_)
        if self._addresses:
            sources = columns["ip_src_lo"].tolist()
            found |= (columns["ip_version"] == 4) & [source in self._addresses for source in sources]
        if self._macs:
            found |= [mac in self._macs for mac in columns["eth_src"].tolist()]
        if self._senders:
            senders = zip(columns["eth_src"].tolist(), columns["port"].tolist(), strict=True)
            found |= [sender in self._senders for sender in senders]
        return found


def _add(counts: Counter[Any], key: object, change: int) -> None:
    counts[key] += change
    if not counts[key]:
        del counts[key]
