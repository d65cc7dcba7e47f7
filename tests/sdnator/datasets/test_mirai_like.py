"""The generated capture resembles the public one, in its traffic and in what Kitsune makes of it."""

import numpy as np
import pytest

from apps.kitsune.afterimage import AfterImage
from apps.kitsune.kernel import load_kernel
from apps.kitsune.kitnet import KitNet
from apps.packets import read_frames
from due import RecordBatch
from sdnator.capture.captures import Capture
from sdnator.capture.labels import read_labels
from sdnator.datasets import hosts, mirai_like
from sdnator.datasets.attack import AttackPlan
from sdnator.datasets.mirai_like import MiraiLikeOptions, generate, make
from sdnator.datasets.traffic import WireFrame
from sdnator.errors import BadInput
from sdnator.replay.summary import roc_auc

SHORT = MiraiLikeOptions(benign_seconds=40, attack_seconds=30)


def _batch(frames: list[WireFrame]) -> RecordBatch:
    number = len(frames)
    return read_frames(
        [frame.data for frame in frames],
        lengths=[frame.length for frame in frames],
        times_us=[mirai_like.START_S * 1_000_000 + frame.time for frame in frames],
        ports=[1] * number,
        sequence=range(1, number + 1),
        arrival=range(number),
    )


def test_what_is_written(tmp_path):
    """Capture and labels agree; the same options give the same bytes; nothing else is left."""
    steps: list[int] = []
    made = make(SHORT, tmp_path / "a.pcap", steps.append)
    again = make(SHORT, tmp_path / "b.pcap.gz")
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "a.labels.csv",
        "a.pcap",
        "b.labels.csv",
        "b.pcap.gz",
    ]
    with Capture(made.capture) as one, Capture(again.capture) as other:
        found = list(one)
        assert found == list(other)
    labels = read_labels(made.labels, made.packets)
    assert len(found) == made.packets >= steps[-1] > 1_000
    assert labels.first_attack == made.first_attack
    assert int(labels.attack.sum()) == made.attack_packets > 0
    assert labels.attackers <= {hosts.INFECTED.mac_text, hosts.INTRUDER.mac_text}
    for index in np.flatnonzero(labels.attack)[:50]:
        assert found[index].data[6:12].hex(":") == labels.attacker(int(index))
    assert made.labels.read_bytes() == again.labels.read_bytes()
    assert [frame.time_ns for frame in found] == sorted(frame.time_ns for frame in found)


def test_limits(tmp_path):
    """A capture ends at its most packets; without an attack nothing is labelled; nothing at all is refused."""
    made = make(MiraiLikeOptions(benign_seconds=40, attack_seconds=0, max_packets=500), tmp_path / "a.pcap")
    assert (made.packets, made.attack_packets, made.first_attack) == (500, 0, None)
    alone = make(MiraiLikeOptions(background=False, attack_seconds=20), tmp_path / "b.pcap")
    assert alone.first_attack == 0
    with pytest.raises(BadInput, match="no packet to write"):
        make(MiraiLikeOptions(benign_seconds=0, attack_seconds=0), tmp_path / "c.pcap")
    assert not (tmp_path / "c.pcap").exists()


def test_a_broken_run_leaves_no_capture(tmp_path, monkeypatch):
    def interrupted(_options):
        yield WireFrame(0, 60, bytes(60), "")
        raise KeyboardInterrupt

    monkeypatch.setattr(mirai_like, "generate", interrupted)
    with pytest.raises(KeyboardInterrupt):
        make(SHORT, tmp_path / "a.pcap")
    assert list(tmp_path.iterdir()) == []


def _share(chosen) -> float:
    return float(np.mean(chosen))


@pytest.mark.parametrize("seed", [1, 77])
def test_the_house_resembles_the_public_capture(seed):
    """The figures of the first 38,363 packets of the public set, within a fifth or so."""
    frames = list(generate(MiraiLikeOptions(seed=seed, benign_seconds=1_400, attack_seconds=0)))
    batch = _batch(frames)
    gaps = np.diff(batch["time_us"]) / 1e3
    quoted = batch["quoted"] == 1
    assert len(frames) / 1_400 == pytest.approx(27, rel=0.1)
    assert np.median(gaps) == pytest.approx(0.9, abs=0.5)
    assert batch["length"].mean() == pytest.approx(84, rel=0.1)
    assert _share((batch["udp_sport"] >= 0) & ~quoted) == pytest.approx(0.53, abs=0.05)
    assert _share((batch["tcp_sport"] >= 0) & ~quoted) == pytest.approx(0.17, abs=0.04)
    assert _share(quoted) == pytest.approx(0.145, abs=0.03)
    assert _share((batch["icmp_type"] == 8) | (batch["icmp_type"] == 0)) == pytest.approx(0.08, abs=0.02)
    assert _share(batch["arp_op"] >= 0) == pytest.approx(0.05, abs=0.03)
    assert _share((batch["ip_version"] == 0) & (batch["arp_op"] < 0)) == pytest.approx(0.02, abs=0.01)
    assert _share(batch["ip_version"] == 6) == pytest.approx(0.006, abs=0.003)
    assert len(np.unique(batch["eth_src"])) == 17  # the 18th is the intruder


def _scores(frames: list[WireFrame]) -> tuple[np.ndarray, int]:
    kernel = load_kernel()
    batch, features, net = _batch(frames), AfterImage(kernel=kernel), KitNet(kernel=kernel)
    parts = [
        net.process(features.update({name: batch[name][at : at + 4_096] for name in batch.columns}))[0]
        for at in range(0, len(frames), 4_096)
    ]
    return np.concatenate(parts), net.training_packets


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "plan"),
    [
        (1, AttackPlan()),
        (2, AttackPlan()),
        (10, AttackPlan()),
        (4, AttackPlan(scan=False, floods=("syn",), answer_all=True)),
    ],
)
def test_kitsune_finds_it_hard_but_not_too_hard(seed, plan):
    """Default training: benign median near 0.01, attack median between 2 and 50, AUC from 0.90 to 0.99."""
    frames = list(generate(MiraiLikeOptions(seed=seed, plan=plan)))
    assert len(frames) <= mirai_like.MAX_PACKETS
    score, trained = _scores(frames)
    attack = np.array([bool(frame.attacker) for frame in frames])
    onset = int(np.argmax(attack))
    assert onset >= 70_000
    assert float(np.median(score[trained:onset])) == pytest.approx(0.01, rel=0.5)
    assert 2 <= float(np.median(score[attack])) <= 50
    if plan == AttackPlan():
        assert float(np.median(score[trained:][~attack[trained:]])) == pytest.approx(0.01, rel=0.5)
        area = roc_auc(attack[trained:], score[trained:])
        assert area is not None
        assert 0.90 <= area <= 0.99
