"""DUE from asyncio: `async for item in items(engine, key)`.

    dispatcher thread ──call_soon_threadsafe──► bounded queue ──► coroutine

A full queue makes the dispatcher wait, so a slow coroutine holds back reliable producers as a slow callback
does.  Run blocking calls (`flush`, `get`, `close`) with `asyncio.to_thread`.
"""

import asyncio
import threading
from collections.abc import AsyncGenerator

from due.engine import Engine
from due.messages import Item

_PATIENCE = 0.1


async def items(engine: Engine, key: str, *, most: int = 10_000) -> AsyncGenerator[Item, None]:
    """Receive the items under a key until the loop is left, which withdraws the interest.

    Args:
        engine: an initialised engine with the role CONSUMER.
        key: wildcards and lists are allowed.
        most: items that may wait in the queue; beyond that the dispatcher waits.

    Yields:
        Items in the order received.

    Raises:
        InvalidKey: the key breaks the grammar.
        NotAllowed: the engine was not given the role CONSUMER.
    """
    loop = asyncio.get_running_loop()
    queue: asyncio.Queue[Item] = asyncio.Queue()
    room = threading.Semaphore(most)
    left = threading.Event()

    def arrived(item: Item) -> None:
        while not room.acquire(timeout=_PATIENCE):
            if left.is_set():
                return
        if not left.is_set():
            loop.call_soon_threadsafe(queue.put_nowait, item)

    subscription = await asyncio.to_thread(engine.observe(key).subscribe, arrived)
    try:
        while True:
            item = await queue.get()
            room.release()
            yield item
    finally:
        left.set()
        subscription.dispose()
