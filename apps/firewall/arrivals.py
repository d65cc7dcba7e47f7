"""DUE items → the firewall's own types, where `Message.from_item` is not all there is to do.  Pure.

Each decoder accepts an item of any origin, and raises `MessageError` only.
"""

from typing import Annotated, Final

import msgspec
from msgspec import Meta

from apps.enforcement import EnforcementReport
from apps.evidence import TrainingState
from apps.firewall.evidence.shared import shared_text
from apps.firewall.syn.recent_syns import SYN_COLUMNS
from apps.firewall.syn.services import TcpService
from apps.firewall.syn.syn_ack_buffer import ANSWER_COLUMNS
from apps.messages import (
    LATEST_NS,
    Answer,
    Exhibit,
    Message,
    MessageError,
    Name,
    Number,
    Port,
    Time,
    address_in,
    sender_of,
)
from apps.packets import PACKET_COLUMNS, read_columns
from due import Item, RecordBatch

ARP_COLUMNS: Final = ("time_us", "port", "arp_op", "eth_src", "arp_src_mac", "arp_src_ip")
_MOST_SUMMARY: Final = 4_000


class DropReading(Message, frozen=True, kw_only=True):
    """A drop counter."""

    id: Name
    packets: Number


class SwitchReport(Message, frozen=True, kw_only=True):
    """The fields that the firewall needs of `network.switch.p4runtime_ctrl.<switch>`."""

    switch: Name
    primary: bool = False
    event_time: Time = 0
    clock: Name = ""
    """What moves its clock; "packets": nothing else does."""
    mirror: bool = False
    """It sees copies only."""
    blocks: Annotated[tuple[DropReading, ...], Meta(max_length=100_000)] = ()


class Shake(Message, frozen=True, kw_only=True):
    """`network.handshake.sonata.tcp`."""

    source: Name
    service: Name
    port: Port
    at: Time


class FloodReported(Message, frozen=True, kw_only=True):
    """`network.traffic_query.sonata.syn_flood`."""

    dst: Name
    count: Number
    window_start: Time


def training_in(item: Item) -> TrainingState:
    """`network.training.kitsune`: another app's word would move the bound that all evidence has to reach."""
    if sender_of(item) != "kitsune":
        raise MessageError("sender", f"{item.key}: only Kitsune reports the progress of training")
    return TrainingState.from_value(item.value)


def report_in(item: Item) -> EnforcementReport:
    """`network.enforced.<enforcer>.<place>`."""
    app = sender_of(item)
    report = EnforcementReport.from_value(item.value)
    if (report.enforcer, report.place) != (app, item.key.rpartition(".")[2]):
        raise MessageError("fields", f"{item.key}: its value is about {report.enforcer!r} {report.place!r}")
    return report


def answer_in(item: Item) -> Answer:
    """`network.answer.firewall.<app>`, as it was archived."""
    return Answer.from_value(item.value)


def state_in(item: Item) -> SwitchReport:
    """`network.switch.p4runtime_ctrl.<switch>`."""
    sender_of(item)
    state = SwitchReport.from_value(item.value)
    if item.key.rpartition(".")[2] != state.switch:
        raise MessageError("fields", f"{item.key}: its value names switch {state.switch!r}")
    return state


def handshake_in(item: Item) -> tuple[str, TcpService, int]:
    """Source, service and capture time (ns) of a completed handshake."""
    sender_of(item)
    shake = Shake.from_value(item.value)
    service = TcpService(address_in(shake.service, "handshake"), shake.port)
    return address_in(shake.source, "handshake"), service, shake.at


def flood_in(item: Item) -> FloodReported:
    """A result of the query for SYN floods."""
    sender_of(item)
    flood = FloodReported.from_value(item.value)
    return msgspec.structs.replace(flood, dst=address_in(flood.dst, "syn_flood"))


def syns_in(item: Item) -> RecordBatch:
    """SYNs, with the columns that are used."""
    sender_of(item)
    return read_columns(item.value, {name: PACKET_COLUMNS[name] for name in SYN_COLUMNS}, "SYNs")


def syn_acks_in(item: Item) -> RecordBatch:
    """SYN-ACKs with the columns that are present; resets need all of them."""
    sender_of(item)
    there = item.value.columns if isinstance(item.value, RecordBatch) else ()
    kinds = {name: PACKET_COLUMNS[name] for name in ANSWER_COLUMNS if name in there}
    return read_columns(item.value, {**kinds, "time_us": "i8"}, "SYN-ACKs")


def arps_in(item: Item) -> RecordBatch:
    """ARP packets, with the columns that are used."""
    sender_of(item)
    return read_columns(item.value, {name: PACKET_COLUMNS[name] for name in ARP_COLUMNS}, "ARP")


def evidence_of(item: Item, summary: str) -> Exhibit:
    """The item as evidence of a decision."""
    at = min(max(0, item.timestamp), LATEST_NS)
    return Exhibit(key=shared_text(item.key), timestamp=at, summary=summary[:_MOST_SUMMARY])
