"""An archive with packets of switches, as a controller that somebody observed would have left it."""

import random
from collections.abc import Sequence
from typing import Final

import numpy as np

from apps.packets import PACKET_COLUMNS
from due import Item, RecordBatch
from due.drivers.base import ArchiveDriver
from sdnator.testing.query_traffic import TimedFrame, batch_of

_WRITER: Final = "p4runtime_ctrl"


def archive_packets(
    archive: ArchiveDriver,
    switch: str,
    frames: Sequence[TimedFrame],
    *,
    base_us: int,
    begin_ns: int,
    every_ns: int = 10**9,
    size: int = 200,
    shift_us: int = 0,
) -> int:
    """Archive frames in their order, and the state of their switch.

    Args:
        archive: to write to.
        switch: that they passed.
        frames: in the order in which they were written.
        base_us: the switch's clock zero.
        begin_ns: when the first item was written.
        every_ns: between two items.
        size: packets of an item.
        shift_us: added to all capture times.

    Returns:
        The number of items.
    """
    state = {"switch": switch, "base_us": base_us, "primary": True}
    archive.insert([_item(f"network.switch.{_WRITER}.{switch}", state, begin_ns, 1, switch)])
    items: list[Item] = []
    for at in range(0, len(frames), size):
        batch = batch_of(list(frames[at : at + size]), at)
        columns = {name: batch[name] for name in PACKET_COLUMNS}
        columns["time_us"] = columns["time_us"] + np.int64(shift_us)
        number = len(items)
        key, time = f"network.packets.{_WRITER}.{switch}.all", begin_ns + number * every_ns
        items.append(_item(key, RecordBatch(columns), time, number + 1, switch))
    archive.insert(items)
    return len(items)


def out_of_order(frames: Sequence[TimedFrame], most_us: int, seed: int = 1) -> list[TimedFrame]:
    """The frames in the order in which they come when each is on its way for up to `most_us`.

    Args:
        frames: in the order of their times.
        most_us: longest delay.
        seed: of the delays.
    """
    rng = random.Random(seed)
    return sorted(frames, key=lambda frame: frame.time_us + rng.random() ** 4 * most_us)


def _item(key: str, value: object, time_ns: int, number: int, instance: str) -> Item:
    return Item(key, value, time_ns, time_ns, _WRITER, instance, number)
