"""Has msgspec learn all types of messages in one thread.

The first use of a `msgspec.Struct` type fills a description that msgspec 0.22 keeps with the class.  Another thread that
uses the type meanwhile reads it half filled, and the process ends with a segmentation fault.
"""

import threading
import weakref
from collections.abc import Iterator

import msgspec

_learning = threading.Lock()
_learnt: weakref.WeakSet[type[msgspec.Struct]] = weakref.WeakSet()


def learn_struct_types() -> None:
    """Use every Struct type that has been imported; types that were used by this function before cost nothing."""
    with _learning:
        for kind in _kinds(msgspec.Struct):
            if kind in _learnt:
                continue
            _learnt.add(kind)
            try:
                msgspec.msgpack.Decoder(kind)
            except (TypeError, NameError, AttributeError):
                continue  # not a type of messages: it has fields that no decoder knows


def _kinds(base: type[msgspec.Struct]) -> Iterator[type[msgspec.Struct]]:
    for kind in base.__subclasses__():
        yield kind
        yield from _kinds(kind)
