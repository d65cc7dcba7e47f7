"""Signs of an attack in the training traffic, which the model would learn as normal."""

from statistics import median
from typing import Final

import numpy as np

from apps.kitsune.kernel import Columns
from apps.kitsune.names import ip_text, mac_text
from apps.kitsune.senders import SenderRecord

_FLOOD_RATE: Final = 500
"""Packets a second from one sender ..."""
_FLOOD_RATIO: Final = 50
"""... and this many times the median sender's maximum."""
_SCAN_HOSTS: Final = 50
"""Hosts addressed by one sender in one second."""
_SYN_RATE: Final = 200
"""SYNs of one sender in one second, and most of its TCP packets."""
_SYN_SHARE: Final = 0.5
_SYN, _ACK, _RST = 0x02, 0x10, 0x04


class TrainingCheck:
    """Counts during training; reports afterwards what looks like an attack."""

    def __init__(self) -> None:
        self._second = 0
        self._syn = self._tcp = 0
        self._worst = 0

    def see(self, batch: Columns, packets: int) -> None:
        """The first `packets` of the batch are training."""
        own = (batch["tcp_sport"][:packets] >= 0) & (batch["quoted"][:packets] == 0)
        seconds = batch["time_us"][:packets][own] // 1_000_000
        is_syn = batch["tcp_flags"][:packets][own] & (_SYN | _ACK | _RST) == _SYN
        for second in np.unique(seconds).tolist():
            if second != self._second:
                self._second, self._syn, self._tcp = second, 0, 0
            here = seconds == second
            self._tcp += int(np.count_nonzero(here))
            self._syn += int(np.count_nonzero(here & is_syn))
            if self._syn > _SYN_SHARE * self._tcp:
                self._worst = max(self._worst, self._syn)

    def warnings(self, records: list[SenderRecord]) -> list[str]:
        """One sentence for each sign; no sign does not prove that training was clean."""
        found = []
        rates = [record.training_rate for record in records if record.training_rate]
        usual = median(rates) if rates else 0
        for record in records:
            name = ip_text(*record.identity[3]) or mac_text(record.identity[2])
            if record.training_rate >= max(_FLOOD_RATE, _FLOOD_RATIO * usual):
                found.append(
                    f"{name} sent {record.training_rate} packets in one second of training "
                    f"(the median sender at most {usual:.0f}): a flood?"
                )
            if record.training_destinations >= _SCAN_HOSTS:
                found.append(
                    f"{name} addressed {record.training_destinations} hosts in one second of training: a scan?"
                )
        if self._worst >= _SYN_RATE:
            found.append(
                f"{self._worst} SYNs in one second of training, most of its TCP packets: a SYN flood?"
            )
        return found
