"""The driver for a URL, and the defaults where no URL is given."""

import os
from pathlib import Path

from due.config import Options
from due.drivers.base import ArchiveDriver, Spool, UpdatesDriver
from due.drivers.redis import RedisUpdates
from due.errors import InvalidOption
from due.logs import without_passwords


def open_updates(url: str, options: Options) -> UpdatesDriver:
    """The Data Updates driver of a URL; raises `InvalidOption`."""
    if url.startswith("memory:"):
        from due.drivers.memory_updates import MemoryUpdates

        return MemoryUpdates(
            url,
            window=options.window_bytes,
            retain=options.retain_bytes,
            retain_s=options.retain_seconds,
            group_timeout=options.group_timeout,
            backlog=options.backlog_bytes,
        )
    if url.startswith(("kafka:", "kafkas:")):
        try:
            from due.drivers.kafka import KafkaUpdates
        except ImportError:
            raise InvalidOption(
                f"URL {without_passwords(url)!r} needs Kafka's client: pip install 'sdnator[kafka]'"
            ) from None

        return KafkaUpdates(
            url,
            window=options.window_bytes,
            group_timeout=options.group_timeout,
            backlog=options.backlog_bytes,
        )
    return RedisUpdates(
        url,
        window=options.window_bytes,
        retain=options.retain_bytes,
        retain_s=options.retain_seconds,
        group_timeout=options.group_timeout,
        backlog=options.backlog_bytes,
        observable=options.observable,
    )


def open_archive(url: str) -> ArchiveDriver:
    """The Data Archives driver of a URL; raises `InvalidOption`, `ArchiveUnavailable`."""
    if url.startswith("sqlite:"):
        from due.drivers.sqlite import SqliteArchive

        return SqliteArchive(url)
    if url.startswith(("mongodb:", "mongodb+srv:")):
        from due.drivers.mongodb import MongoArchive
        from due.drivers.mongodb_apps import MongoAppsArchive, has_app

        return MongoAppsArchive(url) if has_app(url) else MongoArchive(url)
    if url.startswith("memory:"):
        from due.drivers.memory_archive import MemoryArchive

        return MemoryArchive(url)
    raise InvalidOption(
        f"Data Archives URL {url!r}: use sqlite:///path/file.db, mongodb://host/database or memory://"
    )


def open_spool(folder: Path, options: Options) -> Spool | None:
    """A spool in `folder`, one of several of the app; None where the options give it no space."""
    if options.spool_bytes <= 0:
        return None
    from due.drivers.spool_slots import SlottedSpool

    return SlottedSpool(folder, options.spool_bytes, options.spool_reserve_bytes)


def default_updates(options: Options) -> str:
    """The URL where none was given; empty: use the embedded server."""
    return options.updates or os.environ.get("DUE_UPDATES", "")


def default_archive(options: Options) -> str:
    """The URL where none was given."""
    return (
        options.archive
        or os.environ.get("DUE_ARCHIVE", "")
        or f"sqlite://{options.folder().absolute() / 'archive.db'}"
    )
