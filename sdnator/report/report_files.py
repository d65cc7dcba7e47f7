"""The machine-readable files of a report: scores.csv, decisions.csv and eve.json."""

import csv
import ipaddress
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from apps.enforcement import SWITCHES, place_text
from apps.firewall.enforcement.eve import (
    Event,
    decision_event,
    drop_event,
    incident_event,
    line_of,
    time_text,
)
from apps.incidents import Incident
from apps.messages import Confirmation, Decision
from sdnator.replay.packet_accounting import PacketState

SCORED: Final = int(PacketState.SCORED)
STATE_NAMES: Final = {
    PacketState.IN_FLIGHT: "lost",
    PacketState.TRAIN: "train",
    PacketState.SCORED: "scored",
    PacketState.DROPPED: "dropped",
    PacketState.NOT_COPIED: "not copied",
}
_DECISION_COLUMNS: Final = (
    *("time", "id", "action", "kind", "address", "port", "switch", "reason", "evidence", "expires", "level"),
    *("dry_run", "first_packet", "state", "handle", "cause", "packet"),
)


def write_scores(
    path: Path, time_ns: NDArray[np.int64], score: NDArray[np.float64], state: NDArray[np.uint8]
) -> None:
    """`index,time,score,state`; time in seconds since the epoch, exact; score empty where there is none."""
    names = [STATE_NAMES.get(PacketState(number), "") for number in range(len(PacketState))]
    with path.open("w", encoding="ascii") as file:
        file.write("index,time,score,state\n")
        rows = zip(time_ns.tolist(), score.tolist(), state.tolist(), strict=True)
        file.writelines(
            f"{index},{time // 1_000_000_000}.{time % 1_000_000_000:09d},"
            f"{'' if math.isnan(value) else repr(value)},{names[number]}\n"
            for index, (time, value, number) in enumerate(rows)
        )


def decision_rows(
    decisions: Sequence[Decision], confirmations: Sequence[Confirmation]
) -> list[dict[str, Any]]:
    """One row a decision and confirmation; a decision that the switch never answered has one row too.

    A block that is extended or lifted keeps its id: an answer belongs to the last decision before it that
    asked for the same.
    """
    rounds: dict[str, list[int]] = {}
    for number, decision in enumerate(decisions):
        rounds.setdefault(decision.id, []).append(number)
    answers: dict[int, list[Confirmation]] = {}
    for confirmation in confirmations:
        asked = [(number, decisions[number]) for number in rounds.get(confirmation.id, ())]
        if asked:
            answers.setdefault(_asked_by(confirmation, asked), []).append(confirmation)
    return [
        _decision_row(decision, answer)
        for number, decision in enumerate(decisions)
        for answer in answers.get(number, (None,))
    ]


def _asked_by(answer: Confirmation, asked: Sequence[tuple[int, Decision]]) -> int:
    """Which of the decisions with the answer's id it answers."""
    same = [each for each in asked if each[1].action == answer.action] or asked
    before = [number for number, decision in same if decision.event_time <= answer.event_time]
    return before[-1] if before else same[0][0]


def _decision_row(decision: Decision, answer: Confirmation | None) -> dict[str, Any]:
    return {
        "time": time_text(decision.event_time),
        "event_time": decision.event_time,
        "id": decision.id,
        "action": decision.action,
        "kind": decision.target.kind,
        "address": decision.target.address,
        "port": "" if decision.target.port is None else decision.target.port,
        "switch": decision.switch,
        "reason": decision.reason,
        "evidence": "; ".join(f"{each.key}@{each.timestamp}" for each in decision.evidence),
        "expires": time_text(decision.expires) if decision.expires else "never",
        "level": decision.level,
        "dry_run": int(decision.dry_run),
        "first_packet": decision.first_packet,
        "state": answer.state if answer else "dry run" if decision.dry_run else "no answer",
        "handle": answer.handle if answer else "",
        "cause": answer.cause if answer else "",
        "packet": answer.arrival if answer else "",
    }


def block_rows(decisions: Sequence[Decision], confirmations: Sequence[Confirmation]) -> list[dict[str, Any]]:
    """The blocks that the switch installed, in order of time; an extended block is one."""
    rows: dict[str, dict[str, Any]] = {}
    for row in decision_rows(decisions, confirmations):
        if row["action"] == "block" and row["state"] == "installed":
            rows.setdefault(row["id"], row)
    return sorted(rows.values(), key=lambda row: int(row["event_time"]))


def write_decisions(path: Path, decisions: Sequence[Decision], confirmations: Sequence[Confirmation]) -> None:
    """decisions.csv: what was decided, why, and the switch's answer."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, _DECISION_COLUMNS, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(decision_rows(decisions, confirmations))


def write_eve(path: Path, events: Iterable[Event]) -> None:
    """One JSON object a line."""
    with path.open("w", encoding="utf-8") as file:
        file.writelines(f"{line_of(event)}\n" for event in events)


def incident_events(
    reports: Iterable[Incident], decisions: Iterable[Decision], confirmations: Iterable[Confirmation]
) -> list[Event]:
    """What the firewall's own EVE file would hold: reports of incidents, and decisions outside of them, before and
    after the switch has confirmed them."""
    told = [each for each in reports if each.change != "more"]
    within = {action.decision for each in told for action in each.actions}
    alone = [each for each in decisions if each.id not in within]
    places = {
        each.id: place_text(SWITCHES, each.switch) for each in confirmations if each.state == "installed"
    }
    return [
        *(incident_event(each) for each in told),
        *(decision_event(each) for each in alone),
        *(decision_event(each, [places[each.id]]) for each in alone if each.id in places),
    ]


def drop_events(
    time_ns: NDArray[np.int64],
    state: NDArray[np.uint8],
    eth_src: NDArray[np.uint64],
    ipv4_src: NDArray[np.uint32],
) -> list[Event]:
    """An EVE drop for each second in which packets of a sender were dropped, with their number."""
    dropped = np.flatnonzero(state == PacketState.DROPPED)
    if not len(dropped):
        return []
    keys = np.stack(
        [
            time_ns[dropped] // 1_000_000_000,
            eth_src[dropped].astype(np.int64),
            ipv4_src[dropped].astype(np.int64),
        ],
        1,
    )
    _, first, counts = np.unique(keys, axis=0, return_index=True, return_counts=True)
    events = []
    for position, count in zip(first.tolist(), counts.tolist(), strict=True):
        index = int(dropped[position])
        mac = int(eth_src[index]).to_bytes(6, "big").hex(":")
        ip = str(ipaddress.IPv4Address(int(ipv4_src[index]))) if ipv4_src[index] else ""
        events.append(drop_event(int(time_ns[index]), ip, mac, count, index))
    return events
