"""Kitsune for Python programs, with the interface of online-learning libraries.

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
    """Learn from packets and score them, one by one or in batches.

    A packet is a mapping with the columns of `apps.packets.PACKET_COLUMNS`; missing columns count as absent
    headers. A batch holds arrays of equal length. Every packet changes the statistics against which later
    packets are scored, so pass each packet either to `learn_*` or to `score_*`, in capture order. A packet
    object passed to `score_one` and then immediately to `learn_one` is counted once.

    Args:
        fm_grace: packets from which the feature map is learnt, at least 1.
        ad_grace: packets on which the autoencoders are trained, at least 1.
        max_ae: largest number of features per autoencoder.
        mode: "reference" is exact as published, and its memory grows with the traffic; "bounded" limits it.
        max_streams: bounded mode: maximum number of streams in each of four tables, at least 2.
        max_links: bounded mode: maximum number of links in each of two tables, at least 1.
        horizon: bounded mode: seconds of capture time after which an idle stream is forgotten.
        clip: limit for scaled features while scoring; 0 means none, as published.

    Raises:
        ValueError: a number is out of bounds.

    Reference:
        Mirsky et al., Kitsune, NDSS 2018.
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
        """Whether fm_grace + ad_grace + 1 packets have been learnt, as many as the published implementation
        takes."""
        return self.network.is_trained

    def features(self, batch: Columns) -> npt.NDArray[np.float64]:
        """Compute the features of packets, which updates the statistics.

        Args:
            batch: n packets, columns of equal length in capture order.

        Returns:
            The 100 features of each packet, float64, shape (n, 100).

        Raises:
            ColumnError: a column is missing, has another length or holds no numbers.
            MemoryError: the statistics cannot grow; this object cannot be used any more.
        """
        return self._afterimage.update(batch)

    def learn_one(self, packet: Mapping[str, int]) -> None:
        """Learn from one packet.

        Args:
            packet: column name to number.

        Raises:
            ValueError: a feature was not finite when the feature map was due.
        """
        scored, self._scored = self._scored, None
        known = scored is not None and scored[0] is packet
        self.network.learn(scored[1] if scored is not None and known else self._row(packet))

    def learn_many(self, batch: Columns) -> None:
        """Learn from packets, in order.

        Args:
            batch: n packets, columns of equal length in capture order.

        Raises:
            ColumnError: a column is missing, has another length or holds no numbers.
            ValueError: a feature was not finite when the feature map was due.
        """
        self.network.learn(self.features(batch))

    def score_one(self, packet: Mapping[str, int]) -> float:
        """Score one packet.

        Args:
            packet: column name to number.

        Returns:
            RMSE of the output layer: 0 or greater, without upper bound. The paper's threshold is 1.0.

        Raises:
            ValueError: the feature map has not been learnt yet.
        """
        row = self._row(packet)
        self._scored = packet, row
        return float(self.network.score(row)[0][0])

    def score_many(self, batch: Columns) -> npt.NDArray[np.float64]:
        """Score packets, in order.

        Args:
            batch: n packets, columns of equal length in capture order.

        Returns:
            RMSE of the output layer for each packet, float64, shape (n,).

        Raises:
            ColumnError: a column is missing, has another length or holds no numbers.
            ValueError: the feature map has not been learnt yet.
        """
        return self.network.score(self.features(batch))[0]

    def save(self, path: Path, **notes: Any) -> None:
        """Write the trained model to a file.

        Args:
            path: file to write; an existing one is replaced.
            notes: values to keep beside the network, fit for JSON.

        Raises:
            ModelFileError: training is not complete, or the file cannot be written.
        """
        save_model(path, self.network, notes)

    def load(self, path: Path) -> None:
        """Replace the network by a saved model.  The packet statistics are not part of it and stay as they
        are.

        Args:
            path: a file written by `save`.

        Raises:
            ModelFileError: the file cannot be read, is damaged or has another version.
        """
        self.network = load_model(path, clip=self._clip, kernel=load_kernel()).network

    def _row(self, packet: Mapping[str, int]) -> npt.NDArray[np.float64]:
        batch = {
            name: np.array([packet.get(name, -1 if kind[0] == "i" else 0)], dtype=kind)
            for name, kind in _KINDS.items()
        }
        return self.features(batch)
