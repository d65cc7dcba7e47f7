"""What a detector keeps in Python beside the kernel, by object: the attributes that a checkpoint holds."""

from collections import Counter, OrderedDict, deque
from collections.abc import Iterator
from typing import Any, Final

from apps.kitsune.detector import Detector
from apps.kitsune.plain_values import Kinds, SubjectName

_Address = tuple[int, int, int]
_Sender = tuple[str, int, int, int]
_Identity = tuple[str, int, int, _Address]
_Contact = tuple[int, int, int]

_DETECTOR: Final[Kinds] = {
    "training_warnings": list[str],
    "drift_changed": bool,
    "_trained_at_us": int,
    "_knows_behaviour": bool,
}
_CHECK: Final[Kinds] = {"_second": int, "_syn": int, "_tcp": int, "_worst": int}
_SENDERS: Final[Kinds] = {"clock_jumps": int, "_history": OrderedDict[_Identity, deque[int]]}
_SWITCHES: Final[Kinds] = {"names": list[str]}
_ROLES: Final[Kinds] = {
    "_behind": dict[int, set[_Address]],
    "_towards": dict[int, set[_Address]],
    "_serves": dict[_Address, str],
    "_multicast": dict[_Address, list[int]],
    "_gateways": set[int],
    "_gateway_addresses": set[_Address],
}
_VICTIMS: Final[Kinds] = {
    "_has_learnt": bool,
    "_highest": dict[tuple[int, int], int],
    "_sources": dict[tuple[int, int], Counter[int]],
    "_packets": Counter[tuple[int, int]],
}
_BEHAVIOUR: Final[Kinds] = {
    "_learning": bool,
    "begun": float,
    "seconds": float,
    "usual_score": float,
    "senders": set[_Sender],
    "_addresses": set[int],
    "_owners": dict[int, set[int]],
    "_silence": float,
    "_reached": float,
}
_CONTACTS: Final[Kinds] = {
    "_learning": bool,
    "trained": set[_Contact],
    "arp_grace": float,
    "arp_seen": tuple[int, float],
}
_CALLBACKS: Final[Kinds] = {"pairs": int, "back": int}
_OUTSIDE: Final[Kinds] = {"longest": float, "reachable": bool, "_learning": bool}
_COUNTER: Final[Kinds] = {"usable": int}
_BASELINE: Final[Kinds] = {
    "highest": dict[SubjectName, list[float]],
    "shared": dict[SubjectName, list[float]],
    "_own_scale": float,
    "_shared_scale": float,
    "exceeded": float,
    "rarity": float,
}
_FINGERPRINTS: Final[Kinds] = {"syns": int, "marked": int, "_times": OrderedDict[_Sender, list[float]]}
_FOUND: Final[Kinds] = {"_reported": dict[_Sender, tuple[float, float]]}
_ACCUSED: Final[Kinds] = {"_until": OrderedDict[int, float]}
_CALIBRATION: Final[Kinds] = {"_count": int, "_begun": float}


def parts(detector: Detector) -> Iterator[tuple[Any, Kinds]]:
    """The objects of a detector with the attributes that are kept, in an order that does not change.

    Args:
        detector: any.
    """
    yield detector, _DETECTOR
    yield detector._check, _CHECK
    yield detector.senders, _SENDERS
    yield detector.senders._switches, _SWITCHES
    yield detector.senders.roles, _ROLES
    yield detector.victims, _VICTIMS
    behaviour = detector.behaviour
    yield behaviour, _BEHAVIOUR
    yield behaviour._switches, _SWITCHES
    yield behaviour.contacts, _CONTACTS
    yield behaviour._callbacks, _CALLBACKS
    yield behaviour._outside, _OUTSIDE
    for counter in behaviour._counters.values():
        yield counter, _COUNTER
        yield counter.baseline, _BASELINE
    yield detector.fingerprints, _FINGERPRINTS
    yield detector.fingerprints._found, _FOUND
    yield detector.accused, _ACCUSED
    yield detector.calibration, _CALIBRATION
