"""`apps.kitsune.senders` packet by packet, in Python."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import repeat, starmap
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from apps.kitsune import senders as product
from apps.kitsune.afterimage import seconds
from apps.kitsune.blocked import Blocked
from apps.kitsune.kernel import Columns
from apps.kitsune.names import ip_text, mac_text
from apps.kitsune.roles import Roles
from apps.kitsune.senders import Address, AnomalousSecond, Evidence, Identity, SenderRecord
from tests.naive.kitsune.conversations import Conversations, is_tcp_reply

_BACKWARDS_S: Final = 10
_GROUP_BIT: Final = 1 << 40


@dataclass(slots=True)
class PythonTally:
    """The counts of one sender in one second."""

    packets: int = 0
    over: int = 0
    peak: float = -math.inf
    peak_row: int = -1
    first_over: int = 0
    destinations: set[Address] = field(default_factory=set)
    evidence: Any = None

    @property
    def hosts(self) -> int:
        """Number of different destinations."""
        return len(self.destinations)

    def mark(self, score: float, arrival: int, row: int) -> None:
        """One more packet above the threshold."""
        if not self.over:
            self.first_over = arrival
        self.over += 1
        if not score <= self.peak:
            self.peak, self.peak_row = score, row

    def keep(self, evidence: Evidence) -> None:
        """Copy the peak's evidence, because the batch is about to be released."""
        if self.peak_row >= 0:
            self.evidence, self.peak_row = evidence(np.array([self.peak_row], np.int32))[0], -1


class Packet(NamedTuple):
    """The relevant columns of one row of a batch."""

    switch: str
    time: float
    arrival: int
    port: int
    mac: int
    to_mac: int
    source: Address
    destination: Address
    to_multicast: bool
    is_tcp: bool
    sport: int
    dport: int
    udp_sport: int
    quoted: int
    flags: int


class PythonSenders:
    """Assigns scored packets to responsible senders and closes seconds as capture time passes them."""

    def __init__(self, roles: Roles | None = None) -> None:
        self.roles = roles or Roles()
        self.records: list[SenderRecord | None] = []
        self.clock_jumps = 0
        self._ids: dict[Identity, int] = {}
        self._free: list[int] = []
        self.blocked = Blocked()
        self._conversations = Conversations()
        self._second: int | None = None
        self._training = True
        self._tallies: dict[int, PythonTally] = {}
        self._evidence: Evidence = lambda rows: rows.tolist()

    def add(
        self,
        batch: Columns,
        switch: str,
        *,
        scores: npt.NDArray[np.float64],
        trained: int,
        threshold: float,
        evidence: Evidence,
    ) -> list[AnomalousSecond]:
        """Takes a batch of which the first `trained` packets were training; returns the seconds that became anomalous."""
        found: list[AnomalousSecond] = []
        self._evidence = evidence
        for row, packet in enumerate(_packets(batch, switch)):
            second = int(packet.time)
            if second != self._second:
                found += self._turn(second)
            sender = self._sender(packet)
            responsible = self._responsible(packet, sender)
            if self.blocked and self._concerns_blocked(packet, sender, responsible):
                continue
            tally = self._tallies.get(responsible)
            if tally is None:
                tally = self._tallies[responsible] = PythonTally()
            tally.packets += 1
            if responsible == sender:
                tally.destinations.add(packet.destination)
            if row < trained:
                self.roles.learn(
                    packet.source, packet.udp_sport, packet.to_mac, packet.destination, packet.to_multicast
                )
                continue
            if self._training:
                self._end_training()
            score = scores[row]
            if not score < threshold:
                tally.mark(float(score), packet.arrival, row)
        for tally in self._tallies.values():
            tally.keep(evidence)
        return found

    def finish(self) -> list[AnomalousSecond]:
        """The capture has ended: closes the second that is still open."""
        found = list(self._close())
        self._second = None
        return found

    def rates(self, identity: Identity) -> tuple[int, int]:
        """Packets of a sender in the open second, and the highest of any second of training."""
        number = self._ids.get(identity)
        record = self.records[number] if number is not None else None
        if number is None or record is None:
            return 0, 0
        tally = self._tallies.get(number)
        return tally.packets if tally is not None else 0, record.training_rate

    def known(self) -> list[SenderRecord]:
        """All senders that are remembered."""
        return [record for record in self.records if record is not None]

    def to_state(self) -> dict[str, Any]:
        """The learnt senders as plain values."""
        trained = [record for record in self.known() if record.training_rate]
        return {
            "roles": self.roles.to_state(),
            "records": [[r.identity, r.training_rate, r.training_destinations] for r in trained],
        }

    @classmethod
    def from_state(cls, state: dict[str, Any] | None) -> "PythonSenders":
        """Senders from a saved model (None: it has none); training is complete.

        Raises `KeyError`, `TypeError` or `ValueError` when the state is not one.
        """
        senders = cls(Roles.from_state(state["roles"]) if state else None)
        senders._training = False
        for (switch, port, mac, (version, hi, lo)), rate, destinations in state["records"] if state else ():
            identity = (str(switch), int(port), int(mac), (int(version), int(hi), int(lo)))
            senders.know(
                SenderRecord(identity, training_rate=int(rate), training_destinations=int(destinations))
            )
        return senders

    def _end_training(self) -> None:
        self._training = False
        self._note_rates()
        self.roles.close_training()

    def _turn(self, second: int) -> list[AnomalousSecond]:
        if self._second is not None and second < self._second:
            if self._second - second <= _BACKWARDS_S:
                return []  # a late packet counts towards the open second
            self.clock_jumps += 1
            self._forget_history()
        found = list(self._close())
        self._second = second
        return found

    def _close(self) -> Iterator[AnomalousSecond]:
        if self._training:
            self._note_rates()
        second = self._second or 0
        for responsible, tally in self._tallies.items():
            record = self.records[responsible]
            if record is None:
                continue
            record.last_second = second
            if (
                tally.over >= product.ANOMALOUS_PACKETS
                and tally.over >= product.ANOMALOUS_SHARE * tally.packets
            ):
                record.anomalous.append(second)
                while record.anomalous[0] <= second - product.HISTORY_S:
                    record.anomalous.popleft()
                tally.keep(self._evidence)
                yield AnomalousSecond(second, record, tally, len(record.anomalous))
        self._tallies = {}
        if len(self._ids) > product.MOST_SENDERS:
            self._forget(second)

    def _note_rates(self) -> None:
        for responsible, tally in self._tallies.items():
            record = self.records[responsible]
            if record is not None:
                record.training_rate = max(record.training_rate, tally.packets)
                record.training_destinations = max(record.training_destinations, len(tally.destinations))

    def _forget(self, second: int) -> None:
        for number, record in enumerate(self.records):
            if (
                record is not None
                and not record.training_rate
                and record.last_second < second - product.HISTORY_S
            ):
                del self._ids[record.identity]
                self.records[number] = None
                self._free.append(number)

    def _forget_history(self) -> None:
        """The clock was set back: keep rates and roles, forget anomalous seconds."""
        for record in self.known():
            record.anomalous.clear()

    def _sender(self, packet: Packet) -> int:
        identity = (packet.switch, packet.port, packet.mac, packet.source)
        number = self._ids.get(identity)
        if number is None:
            number = self.know(SenderRecord(identity, last_second=self._second or 0))
        return number

    def know(self, record: SenderRecord) -> int:
        """Add a sender, new or from a saved model."""
        if self._free:
            number = self._free.pop()
            self.records[number] = record
        else:
            number = len(self.records)
            self.records.append(record)
        self._ids[record.identity] = number
        self.roles.see(record.identity[2], record.identity[3])
        return number

    def _concerns_blocked(self, packet: Packet, sender: int, responsible: int) -> bool:
        """Whether a packet answers a sender that is blocked, seen to begin the conversation or not."""
        if responsible == sender:
            return self._answers_blocked(packet)
        record = self.records[responsible]
        if record is None:
            return False
        switch, _, mac, address = record.identity
        return self.blocked.covers(switch, mac_text(mac), ip_text(*address))

    def _answers_blocked(self, packet: Packet) -> bool:
        """Whether a packet answers a conversation that was not seen because its initiator is blocked."""
        answer = packet.quoted or packet.udp_sport >= 0 or is_tcp_reply(packet.flags)
        return bool(answer) and self.blocked.covers(
            packet.switch, mac_text(packet.to_mac), ip_text(*packet.destination)
        )

    def _responsible(self, packet: Packet, sender: int) -> int:
        charged = self._charged(packet, sender)
        # who began the conversation may be forgotten
        return sender if self.records[charged] is None else charged

    def _charged(self, packet: Packet, sender: int) -> int:
        if packet.sport < 0:
            return sender
        if packet.quoted:
            key = (packet.is_tcp, packet.destination, packet.sport, packet.dport)
            return self._conversations.responsible_for_error(sender, packet.time, key)
        key = (packet.is_tcp, packet.source, packet.sport, packet.dport)
        reverse = (packet.is_tcp, packet.destination, packet.dport, packet.sport)
        return self._conversations.responsible(sender, packet.time, key, reverse, packet.flags)


def _packets(batch: Columns, switch: str) -> Iterator[Packet]:
    is_arp = batch["arp_op"] >= 0
    is_tcp = batch["tcp_sport"] >= 0
    multicast = batch["eth_dst"] & _GROUP_BIT != 0
    return starmap(
        Packet,
        zip(
            repeat(switch, len(is_arp)),
            seconds(batch).tolist(),
            batch["arrival"].tolist(),
            batch["port"].tolist(),
            batch["eth_src"].tolist(),
            batch["eth_dst"].tolist(),
            _addresses(batch, "src", is_arp),
            _addresses(batch, "dst", is_arp),
            multicast.tolist(),
            is_tcp.tolist(),
            np.where(is_tcp, batch["tcp_sport"], batch["udp_sport"]).tolist(),
            np.where(is_tcp, batch["tcp_dport"], batch["udp_dport"]).tolist(),
            np.where(batch["quoted"] != 0, -1, batch["udp_sport"]).tolist(),
            batch["quoted"].tolist(),
            batch["tcp_flags"].tolist(),
            strict=True,
        ),
    )


def _addresses(batch: Columns, side: str, is_arp: npt.NDArray[np.bool_]) -> Iterator[Address]:
    """The IP address of each row; for ARP the sender or target address in the message."""
    version, low = batch["ip_version"], batch[f"ip_{side}_lo"]
    # received columns may hold anything: see `behaviour/rows.py`
    version = np.where(is_arp, 4, np.where((version == 4) | (version == 6), version, 0))
    short = np.where(is_arp, batch[f"arp_{side}_ip"], np.where(version == 4, low & 0xFFFF_FFFF, 0))
    high = np.where(version == 6, batch[f"ip_{side}_hi"], 0)
    return zip(version.tolist(), high.tolist(), np.where(version == 6, low, short).tolist(), strict=True)
