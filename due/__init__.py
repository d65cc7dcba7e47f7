"""DUE, the Data Ubiquity Engine: one small API over Data Updates (Redis) and Data Archives.

    engine.write(key, value) ──► whoever observes the key, in other processes, and the archive
    engine.observe(key)      ──► a ReactiveX Subject of items        engine.get(key or query) ──► the past

Read `due/engine.py` first, `due/keys.py` for what data is called, `docs/wire-format.md` for the bytes.
"""

from due.config import Options
from due.engine import Engine
from due.errors import DueError
from due.keys import Key
from due.messages import (
    CONSUMER,
    DB_ONLY,
    NO_WAIT,
    PRODUCER,
    PUB_ONLY,
    Assignment,
    Capability,
    Interest,
    Item,
    RecordBatch,
    Role,
)
from due.observation import Observation

__all__ = [
    "CONSUMER",
    "DB_ONLY",
    "NO_WAIT",
    "PRODUCER",
    "PUB_ONLY",
    "Assignment",
    "Capability",
    "DueError",
    "Engine",
    "Interest",
    "Item",
    "Key",
    "Observation",
    "Options",
    "RecordBatch",
    "Role",
]
