"""Which archived decisions stand, whatever the wall clocks of those who wrote them.  Pure.

    decisions as written ──► without those that were lifted ──► the newest for each target

Decisions are archived with the wall time of their writer, and a firewall that was started again with a clock an hour
behind writes a lift "before" the block that it ends.  So a lift counts by the id of what it lifts, and newer is what
has the later event time, which follows the switches.
"""

from collections.abc import Iterable
from typing import Final

from apps.messages import Decision, FloodKind, Target

STANDING: Final = ("block", "protect", "meter")
"""Actions that put something in force; the others lift it."""


def in_force(decisions: Iterable[Decision]) -> list[Decision]:
    """Find the decisions in force: the newest for each target on each switch that nobody has lifted.

    Expired ones are included: the firewall decides whether to extend or lift them.

    Args:
        decisions: in the order of writing, as far as that is known; without dry runs.

    Returns:
        Those in force, in the same order.
    """
    given = list(decisions)
    lifted = {each.id for each in given if each.action not in STANDING}
    newest: dict[tuple[str, Target, tuple[FloodKind, int | None] | None], Decision] = {}
    for each in given:
        packets = None if each.limit is None else (each.limit.kind, each.limit.port)
        key = (each.switch, each.target, packets)
        held = newest.get(key)
        if held is not None and (held.event_time > each.event_time or held == each):
            continue
        if each.action not in STANDING:  # what a switch had refused was replaced, not lifted
            newest.pop(key, None)
        elif each.id not in lifted:
            newest.pop(key, None)
            newest[key] = each
    return list(newest.values())
