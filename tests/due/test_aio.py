"""Coroutines receive in order, and a slow one holds the dispatcher back instead of piling items up."""

import asyncio
from typing import Any

from due import NO_WAIT, PUB_ONLY
from due.aio import items
from tests.due.conftest import wait_for


def test_a_coroutine_receives_items_in_order(make_engine):
    engine = make_engine("async")

    async def main():
        got: list[Any] = []
        stream = items(engine, "t.aio", most=10)
        first = asyncio.ensure_future(anext(stream))
        while not first.done():
            engine.write("t.aio", -1, [PUB_ONLY, NO_WAIT])
            await asyncio.sleep(0.01)
        for number in range(100):
            engine.write("t.aio", number, [PUB_ONLY, NO_WAIT])
        while not got or got[-1] < 99:
            got.append((await anext(stream)).value)
        await stream.aclose()
        return [number for number in got if number >= 0]

    assert asyncio.run(main()) == list(range(100))
    wait_for(lambda: not engine._session.dispatcher._routes.observations)
