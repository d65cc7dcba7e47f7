"""Incidents in Data Archives, read without a running pipeline."""

from typing import Any

from apps.incidents import INCIDENTS, Incident
from apps.messages import MessageError, sender_of
from due import Item
from sdnator.blocks.blocks_archive import find
from sdnator.incidents.incident_rows import newest_of_each


def incidents_in(items: list[Item]) -> list[Incident]:
    """Reports of incidents in the order of writing; what is no report of the firewall is left out."""
    found = []
    for item in sorted(items, key=lambda item: (item.timestamp, item.sequence)):
        try:
            sender_of(item)
            found.append(Incident.from_value(item.value))
        except MessageError:
            continue
    return found


def archived_incidents(archive: str, since: int = 0) -> list[Incident]:
    """Incidents as last reported.

    Args:
        archive: URL; empty for the running or last pipeline's.
        since: only those that were reported on after this time, ns since the epoch.

    Returns:
        Incidents in the order of their begin.

    Raises:
        BadInput: there is no such archive, or it does not answer.
    """
    query: dict[str, Any] = {"dataKey": INCIDENTS}
    if since:
        query["timestamp"] = {"$gte": since}
    return newest_of_each(incidents_in(find(archive, query)))


def incident_of(archive: str, name: str) -> Incident | None:
    """The incident with this id, or with this decision, as last reported.

    Args:
        archive: URL; empty for the running or last pipeline's.
        name: id of an incident or of a decision.

    Raises:
        BadInput: there is no such archive, or it does not answer.
    """
    query = {"dataKey": INCIDENTS, "$or": [{"value.id": name}, {"value.actions.decision": name}]}
    # the whole has the decisions of its parts
    found = [each for each in incidents_in(find(archive, query)) if each.id == name or not each.joined]
    return found[-1] if found else None
