"""DUE, the Data Ubiquity Engine: one small API over Data Updates (Redis) and Data Archives.

    engine.write(key, value) ──► observers of the key, in other processes, and the archive
    engine.observe(key)      ──► a ReactiveX Subject of items
    engine.get(key or query) ──► archived items

Start with `due/engine.py`. `due/keys.py` defines the grammar of keys, `docs/wire-format.md` the encoding.
`__all__` is the public interface of this package.
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
