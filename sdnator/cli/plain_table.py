"""Tables as plain text, the same on a terminal and in a pipe; no cell is cut, so that names can be copied."""

from collections.abc import Iterable, Sequence


def plain_table(names: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Columns as wide as their widest cell; the last column is not padded, so put long texts there.

    >>> print(plain_table(("port", "interface"), [("1", "eth1"), ("10", "eth2")]))
    port  interface
    1     eth1
    10    eth2
    """
    lines = [tuple(names), *map(tuple, rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )
