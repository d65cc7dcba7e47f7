"""Kitsune for Python programs, in the manner of online-learning libraries.

>>> from apps.kitsune.online import Kitsune
>>> from apps.packets import read_frames
>>> kitsune = Kitsune(fm_grace=20, ad_grace=100)
>>> frame = bytes.fromhex("ffffffffffff0200000000010806")
>>> def packets(first, count):
...     times = [(first + n) * 1000 for n in range(count)]
...     return read_frames([frame] * count, lengths=[60] * count, times_us=times, ports=[1] * count,
...                        sequence=range(1, count + 1), arrival=range(count))
>>> kitsune.learn_many(packets(0, 121))
>>> kitsune.score_many(packets(121, 3)).shape
(3,)
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from apps.kitsune.afterimage import HORIZON_S, MAX_LINKS, MAX_STREAMS, AfterImage, Mode
from apps.kitsune.kernel import PACKET_FIELDS, Columns, load_kernel
from apps.kitsune.kitnet import KitNet
from apps.kitsune.model_file import load_model, save_model

_KINDS: Final = {name: kind for name, _, kind in PACKET_FIELDS if name != "time"} | {"time_us": "i8"}


class Kitsune:
    """Learns from and scores packets, one by one or in batches.

    A packet is a mapping of `apps.packets.PACKET_COLUMNS` (missing columns count as absent); a batch
    holds arrays of equal length.  Every packet changes the statistics that later packets are seen
    against, so give each packet to `learn_*` or to `score_*`, in the order of capture; the same
    object given to `score_one` and right after to `learn_one` counts once.

    Args:
        fm_grace, ad_grace: packets for the feature map and for the autoencoders.
        max_ae: most features per autoencoder.
        mode: "reference" or "bounded", see `AfterImage`.
        clip: limit of scaled features when scoring, 0 = none as published.

    Source: Mirsky et al., "Kitsune", NDSS 2018.
    """

    def __init__(
        self,
        *,
        fm_grace: int = 5_000,
        ad_grace: int = 50_000,
        max_ae: int = 10,
        mode: Mode = "reference",
        max_streams: int = MAX_STREAMS,
        max_links: int = MAX_LINKS,
        horizon: float = HORIZON_S,
        clip: float = 0.0,
    ) -> None:
        kernel = load_kernel()
        self._clip = clip
        self._afterimage = AfterImage(
            mode, max_streams=max_streams, max_links=max_links, horizon=horizon, kernel=kernel
        )
        self.network = KitNet(fm_grace=fm_grace, ad_grace=ad_grace, max_ae=max_ae, clip=clip, kernel=kernel)
        self._scored: tuple[object, npt.NDArray[np.float64]] | None = None

    @property
    def is_trained(self) -> bool:
        """Whether the packets of `fm_grace` and `ad_grace` have been learnt."""
        return self.network.is_trained

    def features(self, batch: Columns) -> npt.NDArray[np.float64]:
        """The 100 features of each packet, float64, shape (packets, 100); changes the statistics."""
        return self._afterimage.update(batch)

    def learn_one(self, packet: Mapping[str, int]) -> None:
        """Learns one packet; raises `ValueError` when a feature is not finite as the map is made."""
        scored, self._scored = self._scored, None
        known = scored is not None and scored[0] is packet
        self.network.learn(scored[1] if scored is not None and known else self._row(packet))

    def learn_many(self, batch: Columns) -> None:
        """Learns packets in order."""
        self.network.learn(self.features(batch))

    def score_one(self, packet: Mapping[str, int]) -> float:
        """RMSE of one packet, 0 or greater, without bound; 1.0 is the paper's line.

        Raises `ValueError` until the feature map has been learnt.
        """
        row = self._row(packet)
        self._scored = packet, row
        return float(self.network.score(row)[0][0])

    def score_many(self, batch: Columns) -> npt.NDArray[np.float64]:
        """RMSE of each packet, float64, shape (packets,); raises as `score_one`."""
        return self.network.score(self.features(batch))[0]

    def save(self, path: Path, **notes: Any) -> None:
        """Writes the trained model; raises `ModelFileError`."""
        save_model(path, self.network, notes)

    def load(self, path: Path) -> None:
        """Takes a saved model; raises `ModelFileError`.  The statistics of packets begin anew."""
        self.network = load_model(path, clip=self._clip, kernel=load_kernel()).network

    def _row(self, packet: Mapping[str, int]) -> npt.NDArray[np.float64]:
        batch = {
            name: np.array([packet.get(name, -1 if kind[0] == "i" else 0)], dtype=kind)
            for name, kind in _KINDS.items()
        }
        return self.features(batch)
