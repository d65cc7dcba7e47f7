"""Options of the enforcer `nftables`."""

import re
from typing import Final, Literal

import msgspec

_NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,63}")
_LOWEST: Final = 0.1


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the enforcer."""

    place: str = ""
    """Name of this host in keys and on the dashboard; empty: its host name."""
    table: str = "sdnator"
    """Name of the table, of family inet; it belongs to this app alone."""
    hooks: tuple[Literal["input", "forward", "prerouting"], ...] = ("input", "forward")
    """Where packets are dropped: on their way to this host, through it, or before routing."""
    priority: int = -10
    """Priority of its chains; -10 is before the usual filter chains."""
    at_end: Literal["keep", "remove"] = "keep"
    """When the app ends in order: keep the table, whose blocks end by their own time-outs, or remove it."""
    check_s: float = 1.0
    """Seconds between two readings of the table; what somebody else removed is put back."""
    patience_s: float = 10.0
    """Seconds after which a block that cannot be written is answered as failed."""
    program: str = "nft"
    """The program nft, by name or path."""

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.table):
            raise ValueError(
                f"table={self.table!r}: must be 1 to 64 letters, digits or _, the first not a digit"
            )
        if not self.hooks:
            raise ValueError("hooks=[]: must name one or more of input, forward, prerouting")
        if not self.check_s >= _LOWEST:
            raise ValueError(f"check_s={self.check_s}: must be at least {_LOWEST} s")
