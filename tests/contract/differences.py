"""Where BMv2 (1.15 with PI) and the embedded switch differ, and why: the list that docs/dataplane.md shows.

A contract test that treats the two differently names an entry of this list; nothing else may differ.
"""

from typing import Any, NamedTuple


class Difference(NamedTuple):
    """One row of the documentation."""

    bmv2: str
    embedded: str
    reason: str


_SPECIFIED = "the specification"

DIFFERENCES = {
    "takeover": Difference(
        "when a primary leaves, the backup with the highest id is primary at once",
        "the role is empty until a controller sends an id that is at least the highest seen",
        f"{_SPECIFIED}; a controller that raises its id is right on both",
    ),
    "device-ids": Difference("a stream for any device id is accepted", "NOT_FOUND", _SPECIFIED),
    "empty-program": Difference(
        "JSON that is not a program, and a p4info that does not match, are accepted",
        "both are refused with INVALID_ARGUMENT",
        "an error is reported where it is made, not at a later write",
    ),
    "metadata-limit": Difference(
        "the details of batches with more than about 80 failures are lost",
        "metadata of 64 MiB",
        "every update has its error",
    ),
    "table-full": Difference("a full table is UNKNOWN", "RESOURCE_EXHAUSTED", _SPECIFIED),
    "meter-check": Difference(
        "a peak rate below the committed rate is taken", "the update is refused", "RFC 2698, section 2"
    ),
    "constant-table": Difference(
        "an insert into a constant table is UNKNOWN", "PERMISSION_DENIED", _SPECIFIED
    ),
    "is-const": Difference("the flag is ignored in a Write", "INVALID_ARGUMENT", _SPECIFIED),
    "delete-with-age": Difference(
        "a DELETE with `time_since_last_hit` set is INVALID_ARGUMENT",
        "only the key counts",
        f"{_SPECIFIED}; an entry can be deleted as it was read",
    ),
    "read-by-priority": Difference(
        "the priority of a read without match is ignored", "it selects", _SPECIFIED
    ),
    "atomicity": Difference(
        "CONTINUE_ON_ERROR only; all others are UNIMPLEMENTED",
        "also ROLLBACK_ON_ERROR and DATAPLANE_ATOMIC; others are INVALID_ARGUMENT",
        "nobody wants half a batch",
    ),
    "cell-index": Difference(
        "array indices out of range have codes of their own",
        "INVALID_ARGUMENT (negative), OUT_OF_RANGE (too high)",
        _SPECIFIED,
    ),
    "registers": Difference(
        "neither read nor written through P4Runtime", "both", f"{_SPECIFIED}; the product does not need it"
    ),
    "stream-errors": Difference(
        "wrong packet-outs and acknowledgements are dropped silently", "a StreamError as well", _SPECIFIED
    ),
    "packet-out-metadata": Difference(
        "a packet-out that lacks a field is sent with 0 in its place", "it is refused", _SPECIFIED
    ),
    "digest-lists": Difference(
        "two layers of buffers: samples from before the configuration may arrive, lists may be delayed; equal samples "
        "may be suppressed at any time",
        "lists by size and time-out; a sample equal to one that is waiting, or not acknowledged, is left out",
        _SPECIFIED,
    ),
    "save-and-reconcile": Difference(
        "RECONCILE_AND_COMMIT keeps no entries, COMMIT swaps late", "both do what their names say", _SPECIFIED
    ),
    "clocks": Difference(
        "meters, idle time-outs and time stamps run on the wall clock",
        "on the packets' clock",
        "a replay runs on the time of its capture",
    ),
    "hit-age": Difference(
        "an entry's age is in ms, and 0 without an idle time-out",
        "in µs, always",
        "nothing speaks against it",
    ),
}


def differs(target: Any, name: str) -> bool:
    """Whether the target is BMv2, in a matter that is listed above."""
    assert name in DIFFERENCES
    return bool(target.name == "bmv2")


def markdown() -> str:
    """The list as a table for the documentation."""
    rows = [f"| {name} | {' | '.join(difference)} |" for name, difference in DIFFERENCES.items()]
    return "\n".join(("| matter | BMv2 | here | reason |", "|---|---|---|---|", *rows))


if __name__ == "__main__":
    print(markdown())
