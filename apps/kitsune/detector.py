"""Kitsune without I/O: takes record batches, returns scores and alerts."""

import math
from collections import deque
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
import numpy.typing as npt

from apps.evidence import Evidence
from apps.kitsune.accused import LEAST_NATS, Accused
from apps.kitsune.afterimage import HORIZON_S, MAX_LINKS, MAX_STREAMS, AfterImage, FeatureRoom, Mode
from apps.kitsune.behaviour.behaviour import CALIBRATION_PACKETS
from apps.kitsune.behaviour.findings import Finding
from apps.kitsune.behaviour.fingerprints import SynFingerprints
from apps.kitsune.behaviour.native import NativeBehaviour
from apps.kitsune.behaviour.rows import SenderId, parts_of
from apps.kitsune.drift import BLOCK_S, TRAINING_BLOCKS, TRAINING_SAMPLE, Drift
from apps.kitsune.evidence import SenderFacts, evidence_of, facts_of
from apps.kitsune.kernel import Columns, Kernel, load_kernel
from apps.kitsune.kernel_rows import KernelRows, RowRoom
from apps.kitsune.kitnet import KitNet
from apps.kitsune.model_file import Model, NotAModelError, save_model
from apps.kitsune.names import ip_text, mac_text
from apps.kitsune.reasons import Explanation, explanations, reason
from apps.kitsune.senders import AnomalousSecond, Senders
from apps.kitsune.threshold import Benign, Calibration
from apps.kitsune.training_check import TrainingCheck
from apps.kitsune.victims import VictimRates
from apps.messages import Alert, Sender

TRAIN: Final = 0
SCORED: Final = 1


class DetectorSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the detector."""

    fm_grace: int = 5_000
    """Packets from which the feature map is learnt."""
    ad_grace: int = 50_000
    """Packets from which the autoencoders learn, after the feature map."""
    max_ae: int = 10
    """Maximum number of features per autoencoder."""
    mode: Mode = "bounded"
    """`reference`: exact as published, state and cost grow; `bounded`: both are limited."""
    threshold: float = 1.0
    """Score from which a packet is anomalous (1.0 is the paper's)."""
    false_alarms_per_hour: float = 0.0
    """Greater than 0: once enough packets are scored, the threshold is set so that this many benign packets an
    hour are expected above it; until then `threshold` applies."""
    calibration_packets: int = 10_000
    """Scored packets after training that are assumed to be benign and set the threshold."""
    max_streams: int = MAX_STREAMS
    """Bounded mode: maximum number of streams in each of four tables."""
    max_links: int = MAX_LINKS
    """Bounded mode: maximum number of links in each of two tables."""
    horizon: float = HORIZON_S
    """Bounded mode: seconds after which an idle stream is forgotten."""
    clip: float = 1e6
    """Bounded mode: limit of scaled features, so that one that was constant in training keeps the score finite."""

    def __post_init__(self) -> None:
        least = {
            "fm_grace": 1,
            "ad_grace": 1,
            "max_ae": 1,
            "calibration_packets": 2,
            "max_streams": 2,
            "max_links": 1,
            "false_alarms_per_hour": 0,
        }
        for name, value in least.items():
            if not getattr(self, name) >= value:
                raise ValueError(f"{name}={getattr(self, name)}: must be at least {value}")
        for name in ("threshold", "horizon", "clip"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}={getattr(self, name)}: must be greater than 0")

    @property
    def scale_limit(self) -> float:
        """`clip` in bounded mode; 0 (none) in reference mode."""
        return self.clip if self.mode == "bounded" else 0.0


_DEFAULTS: Final = DetectorSettings()
_SCORES_ONLY: Final = (
    "the model was saved by version 0.1, which learnt no behaviour: it gives scores and alerts, but no evidence; "
    "train again to have both"
)


@dataclass(frozen=True, slots=True)
class Scored:
    """The result for a batch, row by row."""

    scores: npt.NDArray[np.float64]
    """RMSE of the output layer; 0.0 for training packets."""
    state: npt.NDArray[np.uint8]
    """`TRAIN` or `SCORED`."""
    features: npt.NDArray[np.float64]
    """The 100 features of each packet."""
    over: int
    """Packets at or above the threshold."""
    threshold: float
    """The threshold that was applied."""


class Detector:
    """Scores every packet in the order given and raises alerts per sender and second.

    Args:
        settings: all options.
        model: a saved model; then nothing is trained.
        retrain: go on training the saved model, with its feature map, on the first packets.
        kernel: None loads the one that was built.
    """

    def __init__(
        self,
        settings: DetectorSettings = _DEFAULTS,
        *,
        model: Model | None = None,
        retrain: bool = False,
        kernel: Kernel | None = None,
    ) -> None:
        self.settings = settings
        kernel = kernel or load_kernel()
        self.afterimage = AfterImage(
            settings.mode,
            max_streams=settings.max_streams,
            max_links=settings.max_links,
            horizon=settings.horizon,
            kernel=kernel,
        )
        self.training_warnings: list[str] = []
        self._check = TrainingCheck()
        self._trained_at_us = 0
        self._kernel = kernel
        self._room, self._feature_room = RowRoom(), FeatureRoom()
        self.senders = Senders(kernel)
        self.behaviour = NativeBehaviour(settings.fm_grace + settings.ad_grace + 1, kernel)
        self.fingerprints = SynFingerprints(kernel)
        self.victims = VictimRates(kernel)
        self._evidence: list[Evidence] = []
        self._tail: deque[npt.NDArray[np.float64]] = deque()
        """Features of the last packets of training."""
        self._sample: list[npt.NDArray[np.float64]] = []
        """Features of some packets of training."""
        self.calibration = Calibration(settings.calibration_packets)
        self.accused = Accused()
        self.drift: Drift | None = None
        """None during training."""
        self.drift_changed = False
        """Scores have drifted, or have returned; reset once this is published."""
        self.trained_for: dict[str, Any] = {}
        """What the model belongs to; kept in its file."""
        self._knows_behaviour = True
        if model is None:
            self.model = KitNet(
                fm_grace=settings.fm_grace,
                ad_grace=settings.ad_grace,
                max_ae=settings.max_ae,
                clip=settings.scale_limit,
                kernel=kernel,
            )
        elif retrain:
            self.model = model.network
            self.model.retrain(settings.fm_grace, settings.ad_grace)
        else:
            self._take(model)
        self.threshold = self._threshold()

    @property
    def trained(self) -> int:
        """Packets used for training so far."""
        return self.model.trained

    def process(
        self, batch: Columns, switch: str = "", features: npt.NDArray[np.float64] | None = None
    ) -> tuple[Scored, list[Alert]]:
        """Trains on or scores a batch; alerts are for the seconds that this batch has completed.

        Args:
            batch: packet columns, in capture order.
            switch: where they were seen.
            features: of each packet, where another detector has measured them; its statistics are then in use.
        """
        rows = KernelRows(self._kernel, batch, self._room)
        if features is None:
            features = self.afterimage.update(rows, self._feature_room)
        before = self.model.trained
        scores, errors = self.model.process(features)
        trained = self.model.trained - before
        if trained:
            self._check.see(rows, trained)
            self._trained_at_us = int(rows["time_us"][trained - 1])
            self._keep_tail(features[:trained])
            self._keep_sample(features[:trained], before)
        states = bytearray((TRAIN,)) * trained + bytearray((SCORED,)) * (len(scores) - trained)
        threshold = self.threshold

        anomalous = self.senders.add(
            rows,
            switch,
            scores=scores,
            trained=trained,
            threshold=threshold,
            evidence=partial(self._explanations, features, errors, trained),
        )
        self.victims.add(rows, trained)
        findings: list[Finding] = []
        if self._knows_behaviour:
            findings = self.behaviour.add(
                rows,
                switch,
                scores,
                trained,
                self._rescored,
                threshold,
                self.senders.blocked,
            )
            marked = self.fingerprints.add(rows, switch, trained, len(self.behaviour.senders))
            if marked:  # in order of time: what comes first may decide
                findings += filter(self._is_here, marked)
                findings.sort(key=lambda finding: finding.time)
        self._evidence += self._as_evidence(findings)
        self._follow_drift(rows, scores, trained, findings)
        scored = scores[trained:]
        over = rows.over(trained, scores, threshold)
        if trained and self.model.is_trained:
            self.training_warnings = self._check.warnings(self.senders.known())
        if self.calibration.add(scored, rows.seconds[trained:]):
            self.threshold = self._threshold()
        state = np.frombuffer(states, np.uint8)
        return Scored(scores, state, features, over, threshold), [self._alert(second) for second in anomalous]

    def take_evidence(self) -> list[Evidence]:
        """What was found since the last call."""
        taken, self._evidence = self._evidence, []
        return taken

    def _explanations(
        self,
        features: npt.NDArray[np.float64],
        errors: npt.NDArray[np.float64],
        trained: int,
        chosen: npt.NDArray[np.int32],
    ) -> list[Explanation]:
        return explanations(self.model.moved_most(features, errors, chosen, trained))

    def _keep_tail(self, features: npt.NDArray[np.float64]) -> None:
        self._tail.append(features[-CALIBRATION_PACKETS:].copy())
        while sum(map(len, self._tail)) - len(self._tail[0]) >= CALIBRATION_PACKETS:
            self._tail.popleft()

    def _rescored(self) -> npt.NDArray[np.float64]:
        """Scores of the last packets of training, now that the model is trained."""
        if not self._tail or not self._sample:
            return np.zeros(0)  # a model of an earlier version, which knows scores only
        features = np.concatenate(list(self._tail))[-CALIBRATION_PACKETS:]
        self._tail.clear()
        scores, _ = self.model.score(features)
        sample, _ = self.model.score(np.concatenate(self._sample))
        self._sample.clear()
        self.drift = Drift.of(sample)
        return scores

    def _keep_sample(self, features: npt.NDArray[np.float64], before: int) -> None:
        """Packets of all of training, evenly spaced."""
        step = max(1, self.model.training_packets // (TRAINING_BLOCKS * TRAINING_SAMPLE))
        chosen = np.arange(before, before + len(features)) % step == 0
        if chosen.any():
            self._sample.append(features[chosen].copy())

    def _follow_drift(
        self, rows: KernelRows, scores: npt.NDArray[np.float64], trained: int, findings: list[Finding]
    ) -> None:
        """Benign scores only: those of senders without evidence against them."""
        for finding in findings:
            if finding.sender is not None and not finding.supporting and finding.total >= LEAST_NATS:
                self.accused.accuse(finding.sender[2], finding.time)
        if self.drift is None or trained == len(scores):
            return
        now = float(rows.seconds[-1])
        count, above, first, last = rows.benign(trained, scores, self.drift.threshold, self.accused.macs(now))
        if not count:
            return
        if first // BLOCK_S == last // BLOCK_S and math.isfinite(first):
            self.drift_changed |= self.drift.count(int(first // BLOCK_S), count, above)
            return
        benign = self.accused.benign(rows, now)
        chosen = slice(trained, None) if benign is None else benign & (np.arange(len(scores)) >= trained)
        self.drift_changed |= self.drift.add(scores[chosen], rows.seconds[chosen])

    def _is_here(self, finding: Finding) -> bool:
        """Whether the sender is in this network: of those behind a router the Internet is full."""
        sender = finding.sender
        return sender is not None and not self.senders.roles.is_routed(sender[2], parts_of(sender[3]))

    def _as_evidence(self, findings: list[Finding]) -> list[Evidence]:
        facts: dict[SenderId, SenderFacts] = {}
        found = []
        for finding in findings:
            sender, usual = finding.sender, None
            if sender is None:
                usual = self.victims.usual(finding.victim, finding.service)
                known = SenderFacts(rate=usual.rate, training_rate=usual.training_rate)
            else:
                if finding.statistic == "one_way":
                    usual = self.victims.usual(finding.victim, finding.service)
                known = facts.get(sender) or facts.setdefault(sender, self._facts_of(sender))
            found.append(evidence_of(finding, known, usual))
        return found

    def _facts_of(self, sender: SenderId) -> SenderFacts:
        switch, port, mac, address = sender
        rate, training_rate = self.senders.rates((switch, port, mac, parts_of(address)))
        return facts_of(
            sender,
            self.senders.roles,
            proven=self.behaviour.proven(address),
            forged=self.behaviour.forged(sender),
            rate=float(rate),
            training_rate=float(training_rate),
        )

    def notes(self) -> dict[str, Any]:
        """The data that a model file keeps besides the network."""
        benign = self.calibration.benign
        return {
            "senders": self.senders.to_state(),
            "behaviour": self.behaviour.to_state() if self._knows_behaviour else None,
            "fingerprints": self.fingerprints.to_state(),
            "victims": self.victims.to_state(),
            "benign": None if benign is None else benign.to_state(),
            "trained_at_us": self._trained_at_us,
            "training_warnings": self.training_warnings,
            "drift": None if self.drift is None else self.drift.to_state(),
            "trained_for": self.trained_for,
        }

    def save(self, path: Path) -> None:
        """Writes the trained model; raises `ModelFileError`."""
        save_model(path, self.model, self.notes())

    @property
    def trained_at_us(self) -> int:
        """Capture time of the last training packet."""
        return self._trained_at_us

    def _take(self, model: Model) -> None:
        self.model = model.network
        notes = model.notes
        try:
            benign = Benign(**notes["benign"]) if notes.get("benign") else None
            self.senders = Senders.from_state(notes.get("senders"), self._kernel)
            self._knows_behaviour = bool(notes.get("behaviour"))
            if self._knows_behaviour:
                self.behaviour = NativeBehaviour.restored(notes["behaviour"], self._kernel)
            # a model of an earlier version has not counted SYNs: they are no more than its packets
            self.fingerprints.restore(notes.get("fingerprints", (self.model.training_packets, 0)))
            self.victims = VictimRates.from_state(notes.get("victims", ()), self._kernel)
            if notes.get("drift"):
                self.drift = Drift.from_state(notes["drift"])
            self.trained_for = dict(notes.get("trained_for") or {})
            self._trained_at_us = int(notes.get("trained_at_us", 0))
            self.training_warnings = [str(warning) for warning in notes.get("training_warnings", ())]
            if not self._knows_behaviour and _SCORES_ONLY not in self.training_warnings:
                self.training_warnings.append(_SCORES_ONLY)
        except (KeyError, TypeError, ValueError) as error:
            raise NotAModelError(
                f"the model's notes are damaged ({error}); train again and save the result"
            ) from error
        self.calibration = Calibration(self.settings.calibration_packets, benign)

    def _threshold(self) -> float:
        benign = self.calibration.benign
        if self.settings.false_alarms_per_hour and benign is not None:
            return benign.threshold(self.settings.false_alarms_per_hour)
        return self.settings.threshold

    def finish(self) -> list[Alert]:
        """End of the packets: returns the alerts of the second that was still open."""
        return [self._alert(second) for second in self.senders.finish()]

    def _alert(self, second: AnomalousSecond) -> Alert:
        switch, port, mac, address = second.record.identity
        sender = Sender(switch=switch, port=port, mac=mac_text(mac), ip=ip_text(*address))
        return Alert(
            id=f"kitsune-{switch}-{port}-{sender.mac}-{sender.ip}-{second.second}",
            sender=sender,
            event_time=(second.second + 1) * 1_000_000_000,
            first_packet=second.tally.first_over,
            packets=second.tally.packets,
            over=second.tally.over,
            peak_score=second.tally.peak,
            anomalous_seconds=second.anomalous_seconds,
            rate=float(second.tally.packets),
            training_rate=float(second.record.training_rate),
            mac_addresses=self.senders.roles.addresses(mac),
            role=self.senders.roles.role(mac, address),
            reason=reason(second, self.threshold),
        )
