"""The records of one data set of NetFlow v9 or IPFIX, read by their template."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from flow_records.decoding.errors import FlowDecodeError
from flow_records.decoding.octets import MOST_WIDTH, Places, numbers
from flow_records.decoding.templates import VARIABLE, FlowTemplate

_LONG: Final = 255
"""First length byte that says that two more follow."""


class DataSet:
    """Where each known field of each record stands.

    Args:
        datagram: the whole datagram.
        octets: the same bytes.
        start: where the first record begins.
        end: where the set ends; what is too short for a record is padding.
        template: what a record looks like.

    Raises:
        FlowDecodeError: a field of variable length ends beyond the set.
    """

    def __init__(
        self, datagram: bytes, octets: NDArray[np.uint8], start: int, end: int, template: FlowTemplate
    ) -> None:
        self._octets = octets
        self._template = template
        self._places: dict[int, Places] = {}
        """Element to the places of its field."""
        if template.variable:
            self._find(datagram, start, end)
        else:
            self.size = (end - start) // template.least
            bases = start + template.least * np.arange(self.size)
            widths = np.array([field.width for field in template.fields])
            offsets = np.cumsum(widths) - widths
            self._places = {element: bases + offsets[place] for element, place in template.known.items()}

    def number(self, *elements: int, width: int = 0) -> NDArray[np.uint64] | None:
        """Values of the first of these elements that the records have as a number; of this width, if it is not 0.

        Returns:
            Shape (size,); None: they have none of them.
        """
        for element in elements:
            found = self._width(element)
            if found and (found == width or (not width and found <= MOST_WIDTH)):
                return numbers(self._octets, self._places[element], found)
        return None

    def halves(self, element: int) -> tuple[NDArray[np.uint64], NDArray[np.uint64]] | None:
        """Upper and lower half of a field of 16 bytes; None: the records have no such field."""
        if self._width(element) != 2 * MOST_WIDTH:
            return None
        at = self._places[element]
        return numbers(self._octets, at, MOST_WIDTH), numbers(self._octets, at + MOST_WIDTH, MOST_WIDTH)

    def _width(self, element: int) -> int:
        place = self._template.known.get(element)
        width = 0 if place is None else self._template.fields[place].width
        return 0 if width == VARIABLE else width

    def _find(self, datagram: bytes, start: int, end: int) -> None:
        """Step through records whose fields say their lengths: at least one byte a field."""
        template = self._template
        wanted = {place: element for element, place in template.known.items()}
        found: dict[int, list[int]] = {element: [] for element in template.known}
        at, self.size = start, 0
        while end - at >= template.least:
            for place, field in enumerate(template.fields):
                if place in wanted:
                    found[wanted[place]].append(at)
                at += field.width if field.width != VARIABLE else _length(datagram, at, end)
                if at > end:
                    raise FlowDecodeError(
                        "length", f"a record of template {template.number} ends beyond its set"
                    )
            self.size += 1
        self._places = {element: np.array(places, dtype=np.intp) for element, places in found.items()}


def _length(datagram: bytes, at: int, end: int) -> int:
    """Bytes of a field of variable length, those of its length included (RFC 7011, 7)."""
    if at >= end:
        return 1
    if datagram[at] < _LONG:
        return 1 + datagram[at]
    return 3 + int.from_bytes(datagram[at + 1 : at + 3], "big")
