"""The machine-readable files of a report: scores.csv, decisions.csv and eve.json.

Source of the event format: Suricata's EVE JSON (event types `alert` and `drop`).
"""

import csv
import ipaddress
import json
import math
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from apps.messages import Alert, Confirmation, Decision
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
_SIGNATURES: Final = {"anomaly": 9_100_001, "block": 9_100_002}


def time_text(time_ns: int) -> str:
    """Capture time as text: ISO 8601 in UTC with microseconds."""
    return f"{datetime.fromtimestamp(time_ns // 1_000_000_000, UTC):%Y-%m-%dT%H:%M:%S}.{time_ns // 1_000 % 1_000_000:06d}+0000"


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
        "state": answer.state if answer else "no answer",
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
    """decisions.csv: what was decided, why, and what the switch made of it."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, _DECISION_COLUMNS, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(decision_rows(decisions, confirmations))


def write_eve(path: Path, events: Iterable[dict[str, Any]]) -> None:
    """One JSON object a line."""
    with path.open("w", encoding="utf-8") as file:
        file.writelines(f"{json.dumps(event)}\n" for event in events)


def alert_events(alerts: Sequence[Alert]) -> list[dict[str, Any]]:
    """An EVE alert for each anomalous second of a sender."""
    return [
        {
            **_head("alert", alert.event_time, alert.sender.ip, alert.sender.mac),
            "in_iface": f"{alert.sender.switch}:{alert.sender.port}",
            "alert": _alert("anomaly", "allowed", alert.reason, 2),
            "sdnator": {
                "id": alert.id,
                "peak_score": alert.peak_score,
                "packets": alert.packets,
                "over": alert.over,
                "rate": alert.rate,
                "role": alert.role,
                "first_packet": alert.first_packet,
            },
        }
        for alert in alerts
    ]


def block_events(blocks: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """An EVE alert with action `blocked` for each block."""
    events = []
    for block in blocks:
        is_mac = block["kind"] == "mac"
        head = _head(
            "alert",
            block["event_time"],
            "" if is_mac else block["address"],
            block["address"] if is_mac else "",
        )
        about = {name: block[name] for name in ("id", "handle", "packet")}
        events.append({**head, "alert": _alert("block", "blocked", block["reason"], 1), "sdnator": about})
    return events


def drop_events(
    time_ns: NDArray[np.int64],
    state: NDArray[np.uint8],
    eth_src: NDArray[np.uint64],
    ipv4_src: NDArray[np.uint32],
) -> list[dict[str, Any]]:
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
        head = _head("drop", int(time_ns[index]), ip, mac)
        events.append(
            {**head, "drop": {"reason": "rules"}, "sdnator": {"packets": count, "first_packet": index}}
        )
    return events


def _head(kind: str, time_ns: int, ip: str, mac: str) -> dict[str, Any]:
    event: dict[str, Any] = {"timestamp": time_text(time_ns), "event_type": kind}
    if ip:
        event["src_ip"] = ip
    if mac:
        event["ether"] = {"src_mac": mac}
    return event


def _alert(kind: str, action: str, reason: str, severity: int) -> dict[str, Any]:
    return {
        "action": action,
        "gid": 1,
        "signature_id": _SIGNATURES[kind],
        "rev": 1,
        "signature": f"SDNATOR {kind}: {reason}",
        "category": "Anomalous network traffic",
        "severity": severity,
    }
