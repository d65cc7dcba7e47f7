"""Every option of the engine, with its default and its text beside it."""

import os
from pathlib import Path

import msgspec

from due.errors import InvalidOption


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of one engine; all have defaults."""

    updates: str = ""
    """Data Updates URL: redis://, rediss://, unix://; empty: $DUE_UPDATES, else an embedded server."""
    archive: str = ""
    """Data Archives URL: sqlite:///file, mongodb://; empty: $DUE_ARCHIVE, else a file in `directory`."""
    directory: str = ""
    """Where the embedded defaults and the spool live; empty: $DUE_DIRECTORY, else ~/.local/state/due."""

    connect_timeout: float = 5.0
    """How long `init` waits for Data Updates, seconds; afterwards a lost server is waited for without end."""

    frame_bytes: int = 96 << 10
    """A batch is sent when it holds this many bytes ..."""
    linger: float = 0.002
    """... or when its first item has waited this long, seconds."""
    single_bytes: int = 4096
    """Values of this size and more are sent singly, at once."""

    window_bytes: int = 16 << 20
    """What a producer keeps per reliable stream until its readers acknowledge; then `write` waits."""
    retain_bytes: int = 16 << 20
    """What stays after that for replay, in equal shares for the reliable streams of a process."""
    group_timeout: float = 30.0
    """Readers not seen for so long no longer hold a producer back, seconds."""
    backlog_bytes: int = 32 << 20
    """Best-effort payloads that wait for a slow callback; more are dropped and counted."""
    tries: int = 3
    """How often a callback may fail on an item of a reliable key before the item is set aside."""

    coordinated: bool = True
    """False: never look for a Coordinator; declared keys are written as if wanted."""
    handshake_timeout: float = 1.0
    """How long declared keys are buffered while no Coordinator answers, seconds."""
    handshake_bytes: int = 16 << 20
    """How much is buffered meanwhile; then `write` waits."""
    heartbeat: float = 0.5
    """Seconds between heartbeats."""
    pause_limit: float = 0.0
    """Standby instances stopped for longer ask who is active before they speak on; 0: three heartbeats."""

    archive_queue_bytes: int = 64 << 20
    """Frames that wait for the archiver; then `write` waits."""
    archive_batch: int = 1000
    """Items per archive transaction, at least, while there are so many."""
    archive_linger: float = 0.02
    """How long the archiver waits for a full batch, seconds."""
    spool_bytes: int = 1 << 30
    """Disk space for frames while the archive is away; what does not fit is lost and counted."""

    def folder(self) -> Path:
        """`directory` with its defaults applied."""
        text = self.directory or os.environ.get("DUE_DIRECTORY", "")
        return Path(text) if text else Path.home() / ".local" / "state" / "due"

    def checked(self) -> "Options":
        """Itself; raises `InvalidOption` for a number that makes no sense."""
        least = {
            "frame_bytes": 1, "single_bytes": 1, "window_bytes": 1, "tries": 1, "archive_batch": 1,
            "heartbeat": 0.01, "handshake_timeout": 0.0, "linger": 0.0,
        }  # fmt: skip
        for name, bound in least.items():
            if getattr(self, name) < bound:
                raise InvalidOption(f"option {name} is {getattr(self, name)}: at least {bound}")
        return self
