"""A detector that is dumped and loaded goes on as if nothing had happened, wherever in a stream that is."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apps.evidence import Evidence
from apps.kitsune.checkpoint import MARK, VERSION, dump, load
from apps.kitsune.detector import Detector, DetectorSettings
from apps.kitsune.kernel import load_kernel
from apps.kitsune.packed_arrays import CheckpointError, pack, unpack
from due import RecordBatch
from tests.apps.kitsune.random_traffic import traffic

NUMBERS = (np.nan, np.inf, -np.inf, -1.0, -1e300, 1e75, 1e300, 1e-310, 1e-200)
TRAINING = {"fm_grace": 60, "ad_grace": 240, "calibration_packets": 200, "threshold": 0.05}
SMALL = {"max_streams": 12, "max_links": 9, "horizon": 20.0}


def batches(seed: int, count: int, rows: int = 70, hosts: int = 8) -> list[RecordBatch]:
    random = np.random.default_rng(seed)
    return [traffic(random, rows, 400.0 * number, hosts) for number in range(count)]


def results(detector: Detector, batch: RecordBatch, switch: str = "s1") -> tuple[bytes, ...]:
    """Everything that a batch yields, as bytes."""
    scored, alerts = detector.process(batch, switch)
    evidence = detector.take_evidence()
    arrays = (scored.scores, scored.state, scored.features)
    return (
        *(each.tobytes() for each in arrays),
        repr((scored.over, scored.threshold, alerts, evidence)).encode(),
    )


def again(detector: Detector) -> Detector:
    return load(dump(detector), detector.settings, load_kernel())[0]


def in_order(value):
    """A value in which lists that come from sets are in one order."""
    if isinstance(value, dict):
        return {name: in_order(each) for name, each in value.items()}
    return sorted(map(repr, map(in_order, value))) if isinstance(value, list | tuple) else value


@pytest.mark.parametrize("mode", ["bounded", "reference"])
@pytest.mark.parametrize("limits", [{}, SMALL], ids=["wide", "narrow"])
@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 10_000), moves=st.sets(st.integers(0, 13), max_size=4), hosts=st.integers(2, 8))
def test_results_are_bit_equal_wherever_the_detector_moves(mode, limits, seed, moves, hosts):
    options = DetectorSettings(mode=mode, **TRAINING, **limits)
    stays, moving = Detector(options), Detector(options)
    for number, batch in enumerate(batches(seed, 14, hosts=hosts)):
        if number in moves:
            moving = again(moving)
        assert results(moving, batch, f"s{number % 2}") == results(stays, batch, f"s{number % 2}"), number
    assert in_order(again(moving).notes()) == in_order(stays.notes())
    assert repr(again(moving).finish()) == repr(stays.finish())


def trained(seed: int = 1, count: int = 9) -> Detector:
    detector = Detector(DetectorSettings(mode="bounded", **TRAINING, **SMALL))
    for batch in batches(seed, count):
        results(detector, batch)
    return detector


def test_what_was_kept_beside_comes_back():
    detector = trained(count=2)
    assert load(dump(detector, {"a": [1]}), detector.settings, load_kernel())[1] == {"a": [1]}


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"fm_grace": 61}, "fm_grace=60, not 61"),
        ({"max_streams": 13}, "max_streams=12, not 13"),
        ({"mode": "reference"}, "mode=bounded, not reference"),
    ],
)
def test_a_checkpoint_belongs_to_its_settings(change, text):
    detector = trained(count=2)
    other = DetectorSettings(**{"mode": "bounded", **TRAINING, **SMALL, **change})
    with pytest.raises(CheckpointError, match=text):
        load(dump(detector), other, load_kernel())


def test_the_threshold_may_change():
    detector = trained(count=2)
    other = DetectorSettings(**{"mode": "bounded", **TRAINING, **SMALL, "threshold": 7.0})
    assert load(dump(detector), other, load_kernel())[0].threshold == 7.0


def test_other_versions_and_other_bytes_are_refused():
    data = dump(trained(count=2))
    options = DetectorSettings(mode="bounded", **TRAINING, **SMALL)
    header, arrays = unpack(data, MARK, VERSION)
    newer = pack(MARK, VERSION + 1, header, arrays)
    for wrong, text in (
        (newer, f"version {VERSION + 1}"),
        (b"PK" + data, "not a checkpoint of Kitsune"),
        (b"", "not a checkpoint of Kitsune"),
        (data[:-5], "damaged checkpoint"),
        (data + b"x", "its end is not where it should be"),
    ):
        with pytest.raises(CheckpointError, match=text):
            load(wrong, options, load_kernel())


@settings(max_examples=100, deadline=None)
@given(data=st.data(), stage=st.sampled_from([1, 3, 9]))
def test_a_damaged_checkpoint_is_refused_or_works(data, stage):
    """Bytes of the kernel's states and values of the header, changed at random."""
    header, arrays = unpack(checkpoints()[stage], MARK, VERSION)
    name = data.draw(st.sampled_from(["afterimage", "senders", "behaviour", "victims", "header"]))
    if name == "header":
        part = data.draw(st.sampled_from(sorted(header.keys() - {"arrays"})))
        header[part] = changed(header[part], data)
    else:
        raw = arrays[name]
        for _ in range(data.draw(st.integers(1, 4))):
            at = data.draw(st.integers(0, len(raw) - 1))
            width = data.draw(st.sampled_from([1, 4, 8]))
            word = data.draw(st.sampled_from(WORDS)).to_bytes(8, "little", signed=True)[:width]
            raw[at : at + width] = np.frombuffer(word, np.uint8)[: len(raw) - at]
        arrays[name] = raw[: data.draw(st.integers(0, len(raw)))] if data.draw(st.booleans()) else raw
    options = DetectorSettings(mode="bounded", **TRAINING, **SMALL)
    try:
        detector, _ = load(pack(MARK, VERSION, header, arrays), options, load_kernel())
    except CheckpointError:
        return
    with np.errstate(all="ignore"):
        for batch in batches(5, 3):
            results(detector, batch)
        load(dump(detector), options, load_kernel())


@pytest.mark.parametrize("name", ["afterimage", "behaviour"])
@settings(max_examples=60, deadline=None)
@given(stage=st.sampled_from([1, 3, 9]), place=st.integers(0), number=st.sampled_from(NUMBERS))
def test_damaged_statistics_are_refused_or_yield_numbers(name, stage, place, number):
    """Training or evidence ended with an error in the middle of the traffic, and again after each restart."""
    header, arrays = unpack(checkpoints()[stage], MARK, VERSION)
    at = place * 4 % (len(arrays[name]) - 8)
    arrays[name][at : at + 8] = np.frombuffer(np.float64(number).tobytes(), np.uint8)
    options = DetectorSettings(mode="bounded", **TRAINING, **SMALL)
    try:
        detector, _ = load(pack(MARK, VERSION, header, arrays), options, load_kernel())
    except CheckpointError:
        return
    for batch in batches(5, 3):
        scored, _ = detector.process(batch, "s1")
        assert np.isfinite(np.square(scored.features)).all()
        for evidence in detector.take_evidence():
            assert Evidence.from_value(evidence.to_value()) == evidence


@pytest.mark.parametrize("number", [np.nan, np.inf, 1e300])
def test_times_that_are_none_are_refused(number):
    """Evidence that begins at no time ended Kitsune."""
    header, arrays = unpack(checkpoints()[9], MARK, VERSION)
    data = arrays["behaviour"].tobytes()
    for time in {time for batch in batches(1, 9) for time in (batch["time_us"] / 1e6).tolist()}:
        data = data.replace(np.float64(time).tobytes(), np.float64(number).tobytes())
    damaged = {**arrays, "behaviour": np.frombuffer(data, np.uint8)}
    options = DetectorSettings(mode="bounded", **TRAINING, **SMALL)
    with pytest.raises(CheckpointError):
        load(pack(MARK, VERSION, header, damaged), options, load_kernel())


@pytest.mark.parametrize("name", [None, -1, [1, None], "s1", ["s9", 1, 2, 3]])
@pytest.mark.parametrize("table", [0, 1], ids=["subjects", "kinds"])
def test_names_that_mean_nothing_are_refused_before_training_ends(table, name):
    """The end of training hands them to C: Kitsune died there, and again after each restart."""
    header, arrays = unpack(checkpoints()[1], MARK, VERSION)
    named = [tables[table] for tables in header["maxima"] if tables[table]]
    assert named
    for pairs in named:
        pairs[0][0] = name
    options = DetectorSettings(mode="bounded", **TRAINING, **SMALL)
    with pytest.raises(CheckpointError):
        load(pack(MARK, VERSION, header, arrays), options, load_kernel())


WORDS = (0, 1, 2, -1, -2, 7, 255, 65_535, 2**31 - 1, -(2**31), 2**63 - 1, -(2**63))


@cache
def checkpoints() -> dict[int, bytes]:
    return {count: dump(trained(count=count)) for count in (1, 3, 9)}


def changed(value, data):
    """A value of JSON with one part replaced."""
    other = st.sampled_from([None, True, -1, 0, 1, 2**70, 1.5, "s1", "", [], {}, [[1, 2]], [None]])
    if isinstance(value, dict | list) and value and data.draw(st.integers(0, 9)):
        copy = value.copy()
        key = data.draw(st.sampled_from(sorted(copy) if isinstance(copy, dict) else range(len(copy))))
        copy[key] = changed(copy[key], data)
        return copy
    return data.draw(other)
