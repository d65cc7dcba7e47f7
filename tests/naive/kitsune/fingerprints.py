"""`SynFingerprints`, one SYN after the other."""

import numpy as np

from apps.kitsune.behaviour.findings import Finding
from apps.kitsune.behaviour.fingerprints import MOST_AT_A_TIME, SynFingerprints
from apps.kitsune.kernel import Columns

_FIN, _SYN, _RST, _ACK = 0x01, 0x02, 0x04, 0x10


class PythonSynFingerprints(SynFingerprints):
    """Chooses the SYNs with numpy, and weighs each of them."""

    def add(self, batch: Columns, switch: str, trained: int, senders: int) -> list[Finding]:
        """As `SynFingerprints.add`."""
        flags = batch["tcp_flags"] & (_FIN | _SYN | _RST | _ACK)
        opening = (batch["tcp_sport"] >= 0) & (flags == _SYN) & (batch["quoted"] == 0)
        marked = opening & (batch["tcp_seq"] == batch["ip_dst_lo"]) & (batch["ip_version"] == 4)
        self.syns += int(np.count_nonzero(opening[:trained]))
        self.marked += int(np.count_nonzero(marked[:trained]))
        rows = (np.flatnonzero(marked[trained:]) + trained)[:MOST_AT_A_TIME]
        return self._findings(batch, rows, switch, self._nats(senders))
