"""The size of a pipeline, as somebody asks for it."""

import math
from dataclasses import dataclass

from sdnator.errors import BadInput

_MOST_COUNT = 1_000_000
_MOST_PPS = 1e12
_MOST_DAYS = 36_500.0


@dataclass(frozen=True, kw_only=True)
class PipelineDemand:
    """What a pipeline has to carry.

    Raises:
        BadInput: no pipeline can have this size.
    """

    switches: int = 1
    pps: float
    """Packets a second, at all switches together."""
    queries: int = 0
    """Further queries, beside those that the pipeline asks by itself."""
    consumers: int = 0
    """Further apps that read every score."""
    archive_days: float = 1.0
    """How long the archive keeps what is written."""
    blocks: int = 0
    """Blocks in force."""

    def __post_init__(self) -> None:
        _checked("switches", self.switches, 1, _MOST_COUNT)
        if not (math.isfinite(self.pps) and 0 < self.pps <= _MOST_PPS):
            raise BadInput(f"--pps {self.pps:g}: give a number above 0 and at most {_MOST_PPS:g}")
        if not (math.isfinite(self.archive_days) and 0 < self.archive_days <= _MOST_DAYS):
            raise BadInput(
                f"--archive-days {self.archive_days:g}: give a number above 0 and at most {_MOST_DAYS:,.0f}"
            )
        for name in ("queries", "consumers", "blocks"):
            _checked(name, getattr(self, name), 0, _MOST_COUNT)


def _checked(name: str, value: int, least: int, most: int) -> None:
    if not least <= value <= most:
        raise BadInput(f"--{name} {value}: give a number from {least} to {most:,}")
