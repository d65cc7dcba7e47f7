"""Items of a pipeline as they arrive, for commands: a consumer that keeps nothing."""

import os
import queue
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from sdnator.errors import PipelineError

if TYPE_CHECKING:
    from due import Item

_WAITING = 10_000
"""Items that may wait for the terminal; more are counted as missed, since a viewer must not slow down producers."""


@contextmanager
def live_items(keys: Sequence[str], url: str) -> "Iterator[tuple[queue.Queue[Item], Callable[[], int]]]":
    """A bounded queue of the items under some keys, and the number of items that did not fit."""
    import tempfile

    from due import CONSUMER, Engine, Options
    from due.errors import DueError

    waiting: queue.Queue[Item] = queue.Queue(_WAITING)
    lost = [0]

    def put(item: "Item") -> None:
        try:
            waiting.put_nowait(item)
        except queue.Full:
            lost[0] += 1

    with tempfile.TemporaryDirectory(prefix="sdnator-observe-") as folder:
        engine = Engine(
            Options(updates=url, archive=f"sqlite://{folder}/none.db", directory=folder, spool_bytes=0)
        )
        try:
            # a unique name: instances of one app would share a reliable stream between them
            engine.init(f"observe-{os.getpid()}-{time.time_ns() % 10**6:06d}", CONSUMER)
            for key in keys:
                engine.observe(key).subscribe(put)
            yield waiting, lambda: lost[0]
        except DueError as error:
            raise PipelineError(str(error)) from None
        finally:
            engine.close()
