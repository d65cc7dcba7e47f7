"""Where BMv2 (1.15 with PI) and the embedded switch differ, and why: the list behind `docs/`.

A contract test that treats the two differently names an entry of this list; nothing else may differ.
"""

from typing import Any

DIFFERENCES = {
    "takeover": "When a primary leaves, BMv2 makes the backup with the highest id primary at once; the "
    "specification (and the embedded switch) leaves the role empty until a controller sends an id that is "
    "at least the highest seen. A controller that raises its id is right on both.",
    "device-ids": "BMv2 accepts a stream for any device id; the embedded switch answers NOT_FOUND.",
    "empty-program": "BMv2 accepts JSON that is no program, and a p4info that does not fit; the embedded "
    "switch refuses both with INVALID_ARGUMENT.",
    "metadata-limit": "BMv2 loses the details of batches with more than about 80 failures, because its "
    "metadata limit is not raised; the embedded switch's is 64 MiB.",
    "table-full": "BMv2 reports a full table as UNKNOWN; the embedded switch as RESOURCE_EXHAUSTED.",
    "meter-check": "BMv2 takes a meter whose peak rate is below its committed rate; the embedded switch refuses "
    "the whole update.",
    "constant-table": "BMv2 reports an insert into a constant table as UNKNOWN; the embedded switch as "
    "PERMISSION_DENIED.",
    "read-by-priority": "BMv2 ignores the priority of a read without match; the embedded switch selects by it.",
    "atomicity": "BMv2 has CONTINUE_ON_ERROR only; the embedded switch also ROLLBACK_ON_ERROR and "
    "DATAPLANE_ATOMIC.",
    "cell-index": "BMv2 reports array indices out of range with codes of its own; the embedded switch with "
    "INVALID_ARGUMENT (negative) and OUT_OF_RANGE.",
    "registers": "BMv2 cannot read or write registers through P4Runtime; the embedded switch can.",
    "stream-errors": "BMv2 drops wrong packet-outs and acknowledgements silently; the embedded switch also "
    "answers with a StreamError.",
    "packet-out-metadata": "BMv2 sends a packet-out that lacks a metadata field, with 0 in its place; the "
    "embedded switch refuses it.",
    "digest-lists": "BMv2 buffers digests in two layers: samples made before the digest was configured may "
    "still arrive, and lists of configured size may wait; the embedded switch follows the specification.",
    "save-and-reconcile": "BMv2 does not keep entries on RECONCILE_AND_COMMIT and swaps late on COMMIT; the "
    "embedded switch does both as specified.",
    "clocks": "Meters, idle time-outs and time stamps run on the wall clock on BMv2, on the packets' clock on "
    "the embedded switch.",
    "hit-age": "BMv2's age of an entry has a resolution of milliseconds, and is 0 without an idle time-out.",
}


def differs(target: Any, name: str) -> bool:
    """Whether the target is BMv2, in a matter that is listed above."""
    assert name in DIFFERENCES
    return bool(target.name == "bmv2")


def markdown() -> str:
    """The list as a table for the documentation."""
    rows = [f"| {name} | {text} |" for name, text in DIFFERENCES.items()]
    return "\n".join(("| matter | what differs |", "|---|---|", *rows))


if __name__ == "__main__":
    print(markdown())
