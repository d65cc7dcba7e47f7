"""One app of the star: `python -m benchmarks.paper_star_app producer|consumer URL PAIR FOLDER`, until it is ended.

A producer writes messages of 1,000 bytes, 12,500 in a row, held back by the reliable stream's window alone, at its
default; a consumer prints the time and how many it has received, four times a second.
"""

import os
import sys
import time
from typing import Final

from due import CONSUMER, PRODUCER, PUB_ONLY, Capability, Engine, Interest, Item, Options

MESSAGE_BYTES: Final = 1_000
BATCH: Final = 12_500
_TELL_S: Final = 0.25


def main(role: str, url: str, pair: str, folder: str) -> None:
    """Write or read for ever."""
    key = f"bench.star.producer{pair}.message"
    engine = Engine(
        Options(
            updates=url,
            archive="memory://",
            directory=folder,
            coordinated=False,
            connect_timeout=60.0,
        )
    )
    if role == "producer":
        engine.init(f"producer{pair}", PRODUCER, capabilities=(Capability(key, delivery="reliable"),))
        print("ready", flush=True)
        payload = os.urandom(MESSAGE_BYTES)
        while True:
            for _ in range(BATCH):
                engine.write(key, payload, (PUB_ONLY,))
    count = [0]

    def callback(_item: Item) -> None:
        count[0] += 1

    engine.init(f"consumer{pair}", CONSUMER, interests=(Interest(key),))
    engine.observe(key).subscribe(callback)
    print("ready", flush=True)
    while True:
        time.sleep(_TELL_S)
        print(time.monotonic(), count[0], flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
