"""What was called a false alarm, from Data Archives, for people."""

from collections.abc import Iterator
from datetime import UTC, datetime

from apps.firewall.evidence.history import LESSONS
from apps.firewall.policy.false_alarms import WEIGHT
from apps.messages import FalseAlarm, Ground, MessageError, one_line
from sdnator.blocks.blocks_archive import find


def lessons_in_force(archive: str) -> list[FalseAlarm]:
    """The last word about each decision, the oldest first, without what was taken back; raises `BadInput`."""
    held: dict[str, FalseAlarm] = {}
    for item in find(archive, LESSONS):
        try:
            lesson = FalseAlarm.from_item(item)
        except MessageError:
            continue
        held.pop(lesson.id, None)
        if not lesson.revoked:
            held[lesson.id] = lesson
    return list(held.values())


def lesson_lines(lesson: FalseAlarm) -> Iterator[str]:
    """A lesson in words: when, why, until when, about what."""
    why = f" ({one_line(lesson.reason)})" if lesson.reason else ""
    yield f"{lesson.id} was called a false alarm on {_day(lesson.event_time)}{why}; until {_day(lesson.expires)}:"
    for ground in lesson.grounds:
        yield f"  {ground_words(ground)} counts {WEIGHT:g} of its weight, and only beside other evidence"
    yield f"  revoke: sdnator blocks false-alarm {lesson.id} --revoke"


def ground_words(ground: Ground) -> str:
    """Which evidence is meant."""
    sender = ground.sender
    who = "" if sender is None else f" of {sender.ip or sender.mac} on {sender.switch} port {sender.port}"
    service = f" about {ground.service}" if ground.service else ""
    return f"{ground.source}{who}{service}{f' towards {ground.victim}' if ground.victim else ''}"


def _day(time_ns: int) -> str:
    return f"{datetime.fromtimestamp(time_ns / 1e9, UTC):%Y-%m-%d}"
