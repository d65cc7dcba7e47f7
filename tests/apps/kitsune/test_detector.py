"""The whole of Kitsune on the real packets: published scores, three alerts of the gateway, nobody to block."""

import msgspec
import numpy as np
import pytest

from apps.kitsune.detector import SCORED, TRAIN, Detector, DetectorSettings
from apps.kitsune.kernel import load_kernel
from apps.kitsune.model_file import NotAModelError, load_model, save_model
from apps.messages import Alert
from due import RecordBatch
from sdnator.testing.packet_rows import blank, part
from tests.apps.kitsune.real_packets import real
from tests.apps.kitsune.test_afterimage import require_reference_arithmetic
from tests.requirements import shared_data

SETTINGS = DetectorSettings(fm_grace=2_000, ad_grace=10_000, mode="reference")


@pytest.fixture(scope="module")
def packets():
    return real()


def run(detector, batch, step=512):
    scored, alerts = [], []
    for start in range(0, len(batch), step):
        result, found = detector.process(part(batch, start, start + step), "s1")
        scored.append(result)
        alerts += found
    return np.concatenate([result.scores for result in scored]), alerts + detector.finish()


def alert_names(alerts):
    return [alert.id for alert in alerts]


@pytest.fixture(scope="module")
def outcome(packets):
    detector = Detector(SETTINGS, kernel=load_kernel())
    return detector, *run(detector, packets)


def test_all_scores_equal_the_published_ones(outcome):
    require_reference_arithmetic()
    _, scores, _ = outcome
    wanted = np.load(shared_data("kitsune/scores.npz"))["fm2000_ad10000_m10"]
    assert not scores[:12_001].any()
    assert np.abs(scores[12_001:] / wanted[12_001:] - 1).max() < 1e-12


def test_three_bursts_of_the_gateway_alert_and_do_not_block(outcome):
    _, scores, alerts = outcome
    assert np.count_nonzero(scores >= 1) == 33
    assert [(alert.packets, alert.over, alert.anomalous_seconds) for alert in alerts] == [
        (11, 11, n) for n in (1, 2, 3)
    ]
    assert {alert.role for alert in alerts} == {"gateway"}
    assert {alert.sender.ip for alert in alerts} == {"192.168.2.1"}
    assert all(alert.rate < 20 * alert.training_rate for alert in alerts)


def test_alerts_are_whole_messages_with_a_reason(outcome):
    _, scores, alerts = outcome
    for alert in alerts:
        assert Alert.from_value(alert.to_value()) == alert
        assert scores[alert.first_packet] >= 1
        assert "11 of 11 packets scored over 1" in alert.reason
        assert "autoencoders" in alert.reason
    assert len({alert.id for alert in alerts}) == 3


def test_bounded_mode_takes_the_same_decisions(packets, outcome):
    _, reference, alerts = outcome
    bounded = Detector(msgspec.structs.replace(SETTINGS, mode="bounded"), kernel=load_kernel())
    scores, found = run(bounded, packets)
    assert alert_names(found) == alert_names(alerts)
    assert np.abs(scores[12_001:] / reference[12_001:] - 1).max() < 1e-6


def test_batch_size_changes_nothing(packets, outcome):
    _, reference, alerts = outcome
    scores, found = run(Detector(SETTINGS, kernel=load_kernel()), packets, step=4_097)
    assert np.array_equal(scores, reference)
    assert [alert.to_value() for alert in found] == [alert.to_value() for alert in alerts]


def test_a_calibrated_line_holds_after_calibration(packets):
    settings = msgspec.structs.replace(SETTINGS, false_alarms_per_hour=1.0)
    detector = Detector(settings, kernel=load_kernel())
    lines = [
        detector.process(part(packets, start, start + 1000))[0].threshold for start in range(0, 38_000, 1000)
    ]
    assert lines[0] == 1.0
    assert 0.2 < lines[-1] < 1.0


def test_a_saved_model_needs_no_training_and_knows_the_house(tmp_path, packets, outcome):
    detector, scores, alerts = outcome
    detector.save(tmp_path / "model.npz")
    model = load_model(tmp_path / "model.npz", kernel=load_kernel())
    again = Detector(SETTINGS, model=model, kernel=load_kernel())
    found, second = run(again, packets)
    assert np.array_equal(found[12_001:], scores[12_001:])
    assert again.trained_at_us == int(packets["time_us"][12_000])
    assert [(alert.role, alert.training_rate) for alert in second] == [
        (alert.role, alert.training_rate) for alert in alerts
    ]


def test_a_model_of_version_0_1_gives_scores_and_alerts(tmp_path, packets, outcome):
    """Its notes hold neither behaviour nor drift: both are left out, and a warning says so once."""
    detector, scores, _ = outcome
    of_0_1 = ("senders", "benign", "trained_at_us", "training_warnings")
    notes = {name: value for name, value in detector.notes().items() if name in of_0_1}
    save_model(tmp_path / "old.npz", detector.model, notes)
    for path in (tmp_path / "old.npz", tmp_path / "again.npz"):
        opened = Detector(SETTINGS, model=load_model(path, kernel=load_kernel()), kernel=load_kernel())
        again, alerts = run(opened, packets)
        assert np.array_equal(again[12_001:], scores[12_001:])
        assert alerts
        assert not opened.take_evidence()
        assert sum("version 0.1" in warning for warning in opened.training_warnings) == 1
        opened.save(tmp_path / "again.npz")


def test_retraining_keeps_the_map_and_trains_again(tmp_path, packets, outcome):
    detector, _, _ = outcome
    detector.save(tmp_path / "model.npz")
    model = load_model(tmp_path / "model.npz", kernel=load_kernel())
    settings = msgspec.structs.replace(SETTINGS, fm_grace=100, ad_grace=900)
    again = Detector(settings, model=model, retrain=True, kernel=load_kernel())
    result, _ = again.process(part(packets, 0, 2_000))
    assert np.count_nonzero(result.state == TRAIN) == 1_001
    assert again.model.feature_map == detector.model.feature_map


def test_damaged_notes_are_refused(tmp_path, outcome):
    detector, _, _ = outcome
    save_model(tmp_path / "m.npz", detector.model, {"senders": {"roles": 3}})
    with pytest.raises(NotAModelError, match="notes are damaged"):
        Detector(SETTINGS, model=load_model(tmp_path / "m.npz"))


def small(mode="bounded", **changes):
    settings = DetectorSettings(fm_grace=20, ad_grace=100, mode=mode, **changes)
    return Detector(settings, kernel=load_kernel())


def steady(count, start_us=1_600_000_000_000_000, length=60):
    return blank(
        count,
        time_us=start_us + np.arange(count) * 10_000,
        length=np.full(count, length),
        eth_src=np.full(count, 1),
        eth_dst=np.full(count, 2),
        ip_version=np.full(count, 4),
        ip_src_lo=np.full(count, 0xC0A80202),
        ip_dst_lo=np.full(count, 0xC0A80201),
        udp_sport=np.full(count, 1000),
        udp_dport=np.full(count, 2000),
    )


@pytest.mark.parametrize("mode", ["reference", "bounded"])
def test_zero_length_frames_and_empty_batches(mode):
    detector = small(mode)
    assert len(detector.process(part(steady(5), 0, 0))[0].scores) == 0
    result, _ = detector.process(steady(300, length=0))
    assert np.isfinite(result.scores).all()
    assert np.count_nonzero(result.state == SCORED) == 300 - 121


@pytest.mark.parametrize("mode", ["reference", "bounded"])
@pytest.mark.parametrize("years", [-30, 30])
def test_a_clock_that_jumps_years(mode, years):
    detector = small(mode)
    detector.process(steady(300))
    jumped = steady(300, 1_600_000_000_000_000 + years * 31_557_600_000_000)
    result, _ = detector.process(jumped)
    assert np.isfinite(result.features).all()
    detector.finish()
    assert detector.senders.clock_jumps == (years < 0)


def test_a_capture_shorter_than_training_scores_nothing():
    detector = small()
    result, alerts = detector.process(steady(50))
    assert not result.scores.any()
    assert alerts == detector.finish() == []


def test_a_constant_feature_that_moves_stays_finite_and_alerts():
    found = {}
    for mode in ("reference", "bounded"):
        detector = small(mode)
        detector.process(steady(300))
        later = steady(200, 1_600_000_003_000_000, length=1400)
        result, alerts = detector.process(later)
        found[mode] = result.scores.max(), len(alerts + detector.finish())
    assert found["reference"][0] > 1e9
    assert found["bounded"][0] < 1e7
    assert found["reference"][1] == found["bounded"][1] > 0


def test_times_in_seconds_that_are_not_numbers_do_not_stop_bounded_mode():
    detector = small()
    batch = steady(300)
    times = batch["time_us"] / 1e6
    times[150:200] = np.nan
    features = detector.afterimage.update(RecordBatch({**batch, "time_s": times}))
    assert np.isfinite(features).all()


@pytest.mark.parametrize(
    "wrong",
    [{"fm_grace": 0}, {"threshold": 0.0}, {"threshold": float("nan")}, {"max_streams": 1}, {"clip": -1.0}],
)
def test_settings_without_sense_are_named(wrong):
    name, value = next(iter(wrong.items()))
    with pytest.raises(ValueError, match=f"{name}={value}: must be"):
        DetectorSettings(**wrong)
    if value == value:  # noqa: PLR0124 - JSON has no NaN
        with pytest.raises(msgspec.ValidationError, match=name):
            msgspec.json.decode(msgspec.json.encode(wrong), type=DetectorSettings)
