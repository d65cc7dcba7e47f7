"""Options of the supervision of `sdnator up`, each with its default and its text."""

import msgspec

_MIB = 1 << 20


class SupervisorSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When parts are restarted, and how much of their logs is kept."""

    hung_s: float = 20.0
    """Seconds without progress after which a part is killed and restarted; 0: never."""
    restart_s: float = 0.5
    """Seconds before a part that died is restarted; doubled with each death in a row ..."""
    restart_longest_s: float = 30.0
    """... up to this."""
    log_mib: float = 16.0
    """Size at which a log is rotated, MiB."""
    log_files: int = 3
    """Logs kept for each part, including the one being written."""
    log_minute_mib: float = 4.0
    """Most that a part may log in a minute, MiB; the rest is suppressed and counted."""

    def __post_init__(self) -> None:
        if self.hung_s and not 3 <= self.hung_s <= 3_600:
            raise ValueError(f"hung_s={self.hung_s}: must be 3 to 3600, or 0")
        if not 0.05 <= self.restart_s <= self.restart_longest_s:
            raise ValueError(
                f"restart_s={self.restart_s}: must be 0.05 to restart_longest_s={self.restart_longest_s}"
            )
        if self.restart_longest_s > 3_600:
            raise ValueError(f"restart_longest_s={self.restart_longest_s}: must be at most 3600")
        if not 0.01 <= self.log_minute_mib <= self.log_mib:
            raise ValueError(f"log_minute_mib={self.log_minute_mib}: must be 0.01 to log_mib={self.log_mib}")
        if not 1 <= self.log_files <= 100:
            raise ValueError(f"log_files={self.log_files}: must be 1 to 100")

    @property
    def file_bytes(self) -> int:
        """`log_mib` in bytes."""
        return int(self.log_mib * _MIB)

    @property
    def minute_bytes(self) -> int:
        """`log_minute_mib` in bytes."""
        return int(self.log_minute_mib * _MIB)
