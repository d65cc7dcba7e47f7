"""Tables as plain text, the same on a terminal and in a pipe; no word is cut, so that names can be copied."""

import textwrap
from collections.abc import Iterable, Sequence
from itertools import zip_longest

WIDTH = 100
"""Most columns of a line, where no single word is longer than its share."""
_GAP = 2
_SHORT = 24
"""A cell that is not longer, such as a time, stays in one line."""


def plain_table(names: Sequence[str], rows: Iterable[Sequence[str]], width: int = WIDTH) -> str:
    """Columns as wide as their widest cell; where a line would be too long, the widest columns are wrapped.

    >>> print(plain_table(("port", "interface"), [("1", "eth1"), ("10", "eth2")]))
    port  interface
    1     eth1
    10    eth2
    >>> print(plain_table(("id", "reason"), [("1", "scans many hosts at port 23")], width=30))
    id  reason
    1   scans many hosts at port
        23
    """
    lines = [tuple(names), *map(tuple, rows)]
    widths = _widths(list(zip(*lines, strict=True)), width)
    shown = []
    for line in lines:
        cells = [_wrapped(cell, room) for cell, room in zip(line, widths, strict=True)]
        for parts in zip_longest(*cells, fillvalue=""):
            row = (part.ljust(room) for part, room in zip(parts, widths, strict=True))
            shown.append((" " * _GAP).join(row).rstrip())
    return "\n".join(shown)


def fitted(text: str, width: int = WIDTH) -> str:
    """A line of text, wrapped where it is too long; what follows is indented."""
    if len(text) <= width:
        return text
    start = text[: len(text) - len(text.lstrip())]
    return textwrap.fill(
        text.strip(), width, initial_indent=start, subsequent_indent=f"{start}  ",
        break_long_words=False, break_on_hyphens=False,
    )  # fmt: skip


def _widths(columns: Sequence[Sequence[str]], width: int) -> list[int]:
    widths = [max(map(len, column)) for column in columns]
    words = (max((len(word) for cell in column for word in cell.split()), default=0) for column in columns)
    least = [max(word, min(full, _SHORT)) for word, full in zip(words, widths, strict=True)]
    over = sum(widths) + _GAP * (len(widths) - 1) - width
    while over > 0:
        widest = max(range(len(widths)), key=lambda place: (widths[place] > least[place], widths[place]))
        if widths[widest] <= least[widest]:
            break
        cut = min(over, widths[widest] - least[widest], max(1, widths[widest] // 8))
        widths[widest] -= cut
        over -= cut
    return widths


def _wrapped(cell: str, width: int) -> list[str]:
    if len(cell) <= width:
        return [cell]
    return textwrap.wrap(cell, max(1, width), break_long_words=False, break_on_hyphens=False) or [""]
