"""Every option of the engine, with its default and its description."""

import os
from pathlib import Path

import msgspec

from due.errors import InvalidOption

_MOST_FRAME_BYTES = 8 << 20
"""Keeps a frame of the smallest items below `due.codec.MAX_ITEMS`."""
MAX_HEARTBEAT = 3600.0
_CREDENTIAL_BYTES = 1 << 20


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of one engine; all have defaults."""

    updates: str = ""
    """Data Updates URL: redis://, rediss://, redis+sentinel://, unix://, kafka://; empty: $DUE_UPDATES, else an embedded server."""
    observable: tuple[str, ...] = ()
    """Key patterns that this app's user of Data Updates may observe; empty: the server restricts nothing."""
    archive: str = ""
    """Data Archives URL: sqlite:///file, mongodb://; empty: $DUE_ARCHIVE, else a file in `directory`."""
    directory: str = ""
    """Folder of embedded server, archive and spool; empty: $DUE_DIRECTORY, else ~/.local/state/due."""

    connect_timeout: float = 5.0
    """How long `init` waits for Data Updates, seconds; later reconnects are retried without limit."""

    frame_bytes: int = 96 << 10
    """A batch is sent when it holds this many bytes ..."""
    linger: float = 0.002
    """... or when its first item has waited this long, seconds."""
    single_bytes: int = 4096
    """Values of at least this size are sent at once, in a frame of their own."""

    window_bytes: int = 16 << 20
    """Unacknowledged bytes that a producer keeps per reliable stream; beyond that `write` waits."""
    retain_bytes: int = 16 << 20
    """Acknowledged bytes kept to be resent to a server that restarts empty, shared equally by the reliable streams of a process."""
    retain_seconds: float = 3600.0
    """Of these, entries older than the stream's newest by more than this are not kept, seconds."""
    group_timeout: float = 30.0
    """Readers whose lease has not changed for this long no longer hold a producer back, seconds."""
    backlog_bytes: int = 32 << 20
    """Bytes of best-effort payloads that may wait for a slow callback; more are dropped and counted."""
    tries: int = 3
    """How often a callback may fail on an item of a reliable key before the item is set aside."""

    coordinated: bool = True
    """False: never look for a Coordinator; declared keys are written as if wanted."""
    handshake_timeout: float = 1.0
    """How long declared keys are buffered while no Coordinator answers, seconds."""
    handshake_bytes: int = 16 << 20
    """Bytes buffered meanwhile; beyond that `write` waits. While Data Updates are away it does so for reliable keys only:
    of others it refuses, with False, what is to be archived, and drops and counts the rest."""
    heartbeat: float = 0.5
    """Seconds between heartbeats."""
    pause_limit: float = 0.0
    """After a longer suspension an instance asks whether it is still active; 0: three heartbeats."""

    archive_queue_bytes: int = 64 << 20
    """Bytes of frames that may wait for the archiver; beyond that `write` waits."""
    archive_batch: int = 1000
    """Minimum number of items per archive transaction while enough are waiting."""
    archive_linger: float = 0.02
    """How long the archiver waits for a full batch, seconds."""
    spool_bytes: int = 1 << 30
    """Disk space for frames while the archive cannot be reached; more are lost and counted."""

    spool_reserve_bytes: int = 1 << 20
    """Disk space allocated at the start by an app that always archives, for frames while its disk is full; 0: none."""

    def folder(self) -> Path:
        """The folder for embedded servers and the spool.

        Returns:
            `directory`, else $DUE_DIRECTORY, else ~/.local/state/due.
        """
        text = self.directory or os.environ.get("DUE_DIRECTORY", "")
        return Path(text) if text else Path.home() / ".local" / "state" / "due"

    def with_credential(self) -> "Options":
        """These options; Data Updates are those of the credential file $DUE_CREDENTIAL, unless the options name them.

        Returns:
            The options to use.

        Raises:
            InvalidOption: the file cannot be read, is malformed, or somebody other than its owner can read it.
        """
        path = os.environ.get("DUE_CREDENTIAL", "")
        if not path or self.updates or os.environ.get("DUE_UPDATES"):
            return self
        said = self.of_credential(path, f"$DUE_CREDENTIAL {path}")
        return msgspec.structs.replace(self, updates=said.updates, observable=said.observable)

    @classmethod
    def of_credential(cls, path: str, name: str = "") -> "Options":
        """The options in a credential file.

        Args:
            path: of the file, which only its owner may read.
            name: of the file in messages; empty: its path.

        Returns:
            Defaults, but for what the file says.

        Raises:
            InvalidOption: the file cannot be read, is malformed, or somebody other than its owner can read it.
        """
        name = name or path
        try:
            with Path(path).open("rb") as file:
                mode, text = os.fstat(file.fileno()).st_mode, file.read(_CREDENTIAL_BYTES)
            said = msgspec.json.decode(text, type=cls)
        except OSError as error:
            raise InvalidOption(f"{name}: {error.strerror}; give a credential file of the app") from None
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            raise InvalidOption(f"{name}: {error}; enrol the app again") from None
        if mode & 0o077:
            raise InvalidOption(f"{name}: others can read it; run `chmod 600 {path}`")
        return said

    def checked(self) -> "Options":
        """Check the numbers.

        Returns:
            These options, unchanged.

        Raises:
            InvalidOption: a number is out of bounds, for instance `heartbeat` below 0.01 s.
        """
        least = {
            "frame_bytes": 1, "single_bytes": 1, "window_bytes": 1, "tries": 1, "archive_batch": 1,
            "heartbeat": 0.01, "handshake_timeout": 0.0, "linger": 0.0, "retain_seconds": 0.0,
            "spool_reserve_bytes": 0,
        }  # fmt: skip
        for name, bound in least.items():
            if not getattr(self, name) >= bound:  # not a number is refused too
                raise InvalidOption(f"option {name}={getattr(self, name)}: must be at least {bound}")
        most = {
            "frame_bytes": _MOST_FRAME_BYTES,
            "heartbeat": MAX_HEARTBEAT,
            "handshake_timeout": 3600.0,
            "linger": 60.0,
            "spool_reserve_bytes": 1 << 30,
        }
        for name, limit in most.items():
            if not getattr(self, name) <= limit:
                raise InvalidOption(f"option {name}={getattr(self, name)}: must be at most {limit}")
        return self
