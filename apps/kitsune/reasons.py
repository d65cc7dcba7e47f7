"""The reason of an alert as text."""

from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Final, NamedTuple

from apps.kitsune.kernel import LAMBDAS
from apps.kitsune.names import ip_text, mac_text
from apps.kitsune.senders import AnomalousSecond

_GROUPS: Final = (
    (0, 3, "packets from this MAC and address"),
    (15, 7, "packets from this host to that host"),
    (50, 3, "gaps between packets of the two hosts"),
    (65, 7, "packets from this socket to that socket"),
)
_STATISTICS: Final = (
    "rate",
    "mean size",
    "spread of sizes",
    "joint spread",
    "joint size",
    "covariance",
    "correlation",
)
_GAP_STATISTICS: Final = ("number", "mean", "spread")
_NOTABLE: Final = 2.0
"""A rate or fan-out of at least this many times its training maximum is mentioned."""


class Explanation(NamedTuple):
    """What moved most in the packet with the highest score of a second."""

    autoencoders: tuple[int, ...]
    features: tuple[int, ...]
    """Of each of them one."""


def explanations(moved: Iterable[Sequence[int]]) -> list[Explanation]:
    """What `KitNet.moved_most` has found, by packet."""
    return [Explanation((a, b), (x, y)) if b >= 0 else Explanation((a,), (x,)) for a, b, x, y in moved]


def feature_words(feature: int) -> str:
    """A feature described in words."""
    start, per_scale, group = max(entry for entry in _GROUPS if entry[0] <= feature)
    scale, statistic = divmod(feature - start, per_scale)
    names = _GAP_STATISTICS if start == 50 else _STATISTICS
    return f"{names[statistic]} of {group} over {round(1 / LAMBDAS[scale], 1):g} s"


def reason(second: AnomalousSecond, threshold: float) -> str:
    """What the sender did, and the autoencoders and features with the highest errors."""
    tally, record = second.tally, second.record
    _, _, mac, address = record.identity
    who = ip_text(*address) or mac_text(mac)
    parts = _comparisons(who, tally.packets, record.training_rate, tally.hosts, record.training_destinations)
    parts.append(
        f"{tally.over} of {tally.packets} packets scored over {threshold:.3g}, the highest {tally.peak:.3g}"
    )
    if isinstance(tally.evidence, Explanation):
        parts.append(_moved(tally.evidence))
    return "; ".join(parts)


def _comparisons(who: str, packets: int, trained_packets: int, hosts: int, trained_hosts: int) -> list[str]:
    if not trained_packets:
        towards = {0: "", 1: " to 1 host"}.get(hosts, f" to {hosts} hosts")
        return [f"{who} was never seen in training and sends {packets} packets/s{towards}"]
    parts = []
    if trained_hosts and hosts >= _NOTABLE * trained_hosts:
        parts.append(f"{who} sends to {hosts / trained_hosts:.0f} times more hosts than in training")
    if packets >= _NOTABLE * trained_packets:
        parts.append(f"{who} sends {packets / trained_packets:.0f} times more packets than in training")
    return parts or [f"{who} sends no more than in training, but differently"]


@lru_cache(maxsize=4_096)
def _moved(explanation: Explanation) -> str:
    which, words = explanation.autoencoders, map(feature_words, explanation.features)
    return f"autoencoders {' and '.join(map(str, which))} moved most: " + ", ".join(dict.fromkeys(words))
