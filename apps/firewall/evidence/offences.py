"""Earlier blocks as evidence: they support what was seen now, and prove nothing by themselves.  Pure."""

from apps.evidence import Evidence
from apps.firewall.evidence.history import EarlierBlocks
from apps.messages import Alert, Target


def offence_evidence(
    cause: Alert | Evidence, target: Target, earlier: EarlierBlocks, nats: float = 0.0
) -> Evidence:
    """Evidence that a target was blocked before.

    Args:
        cause: what was seen now; whether that could be forged holds for its sender's past, too.
        target: what was blocked, and is about to be again.
        earlier: its earlier blocks, at least one.
        nats: what they add to the sum; 0 where another rule decides, and they only make a block longer.
    """
    seen = cause if isinstance(cause, Evidence) else None
    now = cause.event_time
    return Evidence(
        id=f"firewall-offence-{now}-{target.address}",
        kind="offence",
        source="offence",
        sender=cause.sender,
        address=seen.address if seen is not None else "",
        forgeable=seen.forgeable if seen is not None else True,
        routed=seen.routed if seen is not None else False,
        forged=seen.forged if seen is not None else False,
        supporting=True,
        nats=nats,
        since=min(earlier.first, now),
        event_time=now,
        packets=0,
        mac_addresses=cause.mac_addresses,
        role=cause.role,
        text=f"{target.address} has {earlier.times:,} earlier block{'s' if earlier.times > 1 else ''}",
    )
