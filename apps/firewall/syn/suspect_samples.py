"""Samples of the SYNs towards hosts that the switch reports: what is asked of the switch, and for how long.

    the switch counts SYNs itself ─► reports a host ─► copies of SYNs to that host only ─► end of the sample

Nothing is copied for a host before its report, and a sample ends by number and by time, so a flood costs the host
the same however large it is.  Pure; times are seconds of the caller's monotonic clock.
"""

import ipaddress
from collections.abc import Iterator
from typing import Any, Final

SAMPLE_BITS: Final = (196, 197, 198, 199)
"""Bits of the switch's classifier for samples, one a host."""
_REST_S: Final = 10.0
"""A host that was sampled is not sampled again so soon: its SYNs are still remembered."""
_MOST_RESTING: Final = 1024
_UNDER_WAY_S: Final = 15.0
"""Longest wait for the first SYN of a sample, on a machine that is busy with the flood."""
_IPV4, _IPV6, _TCP = 0x0800, 0x86DD, 6
_SYN_WITHOUT_ACK: Final = [0x02, 0x12]


class _Sample:
    def __init__(self, host: str, until: float) -> None:
        self.host = host
        self.until = until
        """When it ends; until the first SYN arrives, when it is given up."""
        self.taken = 0


class SuspectSamples:
    """The samples that run, at most one for each of `SAMPLE_BITS`.

    Args:
        most: SYNs of one sample.
        seconds: that a sample takes at most, from its first SYN.
    """

    def __init__(self, most: int, seconds: float) -> None:
        self._most = most
        self._seconds = seconds
        self._running: dict[str, _Sample] = {}
        self._resting: dict[str, float] = {}
        """Hosts whose sample has ended, and until when they are not sampled again."""

    @staticmethod
    def names() -> list[str]:
        """Names of the packet requests, and last segments of the keys under which samples arrive."""
        return [f"suspect{bit}" for bit in SAMPLE_BITS]

    def __len__(self) -> int:
        return len(self._running)

    def runs(self, host: str) -> bool:
        """Whether SYNs to a host are being copied, or will be."""
        return any(each.host == host for each in self._running.values())

    def begin(self, host: str, now: float) -> Iterator[dict[str, Any]]:
        """The packet request for a host; none while it is sampled, soon after that, or where no bit is free."""
        free = [name for name in self.names() if name not in self._running]
        if not free or self.runs(host) or self._resting.get(host, now) > now:
            return
        self._running[free[0]] = _Sample(host, now + _UNDER_WAY_S)
        yield _request(free[0], active=True, conditions=_towards(host))

    def taken(self, name: str, number: int, now: float) -> None:
        """SYNs of a sample have arrived."""
        sample = self._running.get(name)
        if sample is not None:
            if not sample.taken:
                sample.until = now + self._seconds
            sample.taken += number

    def ended(self, now: float) -> Iterator[dict[str, Any]]:
        """Withdrawals of the samples that are large or old enough."""
        over = [name for name, each in self._running.items() if each.taken >= self._most or each.until <= now]
        for name in over:
            ended = self._running.pop(name)
            if ended.taken:
                self._resting[ended.host] = now + _REST_S
            while len(self._resting) > _MOST_RESTING:
                del self._resting[next(iter(self._resting))]
            yield _request(name, active=False, conditions={})


def _request(name: str, *, active: bool, conditions: dict[str, Any]) -> dict[str, Any]:
    bit = int(name.removeprefix("suspect"))
    return {"name": name, "bit": bit, "conditions": conditions, "copy": True, "active": active}


def _towards(host: str) -> dict[str, Any]:
    address = ipaddress.ip_address(host)
    return {
        "ethertype": _IPV4 if address.version == 4 else _IPV6,
        "dst": f"{address}/{address.max_prefixlen}",
        "protocol": _TCP,
        "l4_valid": 1,
        "tcp_flags": _SYN_WITHOUT_ACK,
    }
