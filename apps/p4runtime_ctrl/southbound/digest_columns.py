"""Rows of frame digests → columns of packet records, by one call of C for all columns.

With numpy (`digest_in.columns_of`) each column takes several calls, which for a list of a few frames cost more than all
of its frames.  Without a C compiler at installation numpy does it.
"""

from collections.abc import Sequence
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from apps.p4runtime_ctrl.southbound.digest_rows import DigestRowsLibrary, load_digest_rows
from apps.p4runtime_ctrl.southbound.rows import RowLayout
from apps.packets import PACKET_COLUMNS

FIELDS: Final = (
    *("timestamp", "arrival", "sequence", "ingress_port", "vid", "ethertype", "length", "eth_src", "eth_dst"),
    *("src", "dst", "protocol", "fragment", "l4_valid", "quoted", "quoted_protocol", "sport", "dport"),
    *("tcp_flags", "tcp_sequence", "tcp_acknowledgement", "icmp_type", "icmp_code"),
    *("arp_operation", "arp_sender_mac", "arp_target_mac"),
)
"""Members of the digest in the order of C, where addresses are two halves."""
_ADDRESSES: Final = ("src", "dst")
_ADDRESS_BYTES: Final = 16
_WORDS: Final = (1, 2, 4, 8)
_ALIGNMENT: Final = 16
_KINDS: Final = (*map(np.dtype, PACKET_COLUMNS.values()), np.dtype(np.bool_))
"""Of the columns, and of what is covered."""


class DigestColumns:
    """Writes columns of one digest's rows."""

    def __init__(self, library: DigestRowsLibrary, row_bytes: int, places: Sequence[tuple[int, int]]) -> None:
        self._library = library
        self._row_bytes = row_bytes
        self._fields = np.array(places, np.int32)

    @classmethod
    def of(cls, layout: RowLayout) -> Self | None:
        """For rows of a layout.

        Args:
            layout: with all `FIELDS`.

        Returns:
            None where there is no library, or where it does not read a field of this width.
        """
        library, places = load_digest_rows(), _places(layout.dtype)
        if library is None or places is None:
            return None
        return cls(library, layout.dtype.itemsize, places)

    def read(self, rows: NDArray[Any], base_us: int) -> tuple[dict[str, NDArray[Any]], NDArray[np.bool_]]:
        """Columns of rows, and which rows have all fields that the frame would give.

        Args:
            rows: records of the layout.
            base_us: added to their times.
        """
        ffi, lib = self._library
        rows, count = np.ascontiguousarray(rows), len(rows)
        starts, end = [], 0
        for kind in _KINDS:
            starts.append(end)
            end += -(-count * kind.itemsize // _ALIGNMENT) * _ALIGNMENT
        data = np.empty(end, np.uint8)
        lib.digest_columns(
            ffi.cast("uint8_t *", rows.ctypes.data),
            count,
            self._row_bytes,
            ffi.cast("DigestField *", self._fields.ctypes.data),
            base_us,
            ffi.cast("uint8_t *", data.ctypes.data),
        )
        *columns, covered = [
            np.ndarray(count, kind, data, start) for kind, start in zip(_KINDS, starts, strict=True)
        ]
        return dict(zip(PACKET_COLUMNS, columns, strict=True)), covered


def _places(dtype: np.dtype[Any]) -> list[tuple[int, int]] | None:
    """Where each field begins in a row, and its bytes; None if one has a width that C does not read."""
    assert dtype.fields is not None  # noqa: S101 - of a layout
    places: list[tuple[int, int]] = []
    for name in FIELDS:
        kind, at = dtype.fields[name][:2]
        if name in _ADDRESSES:
            if kind.itemsize != _ADDRESS_BYTES:
                return None
            places += [(at, 8), (at + 8, 8)]
        elif kind.itemsize in _WORDS:
            places.append((at, kind.itemsize))
        else:
            return None
    return places
