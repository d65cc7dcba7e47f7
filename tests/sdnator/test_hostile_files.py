"""Captures, tables, labels and settings from anywhere: what they hold, or the one declared error; bounded memory."""

import gzip
import io
import struct
import tracemalloc
import zipfile
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sdnator.capture import captures, labels, pcap_records, tshark_tsv
from sdnator.capture.captures import Capture, CaptureError, NotACapture
from sdnator.capture.labels import LabelsError, MalformedLabels, read_labels
from sdnator.capture.packet_sources import CaptureSource
from sdnator.capture.tshark_tsv import MalformedTsv, TsvError
from sdnator.config import config_file
from sdnator.config.config_file import WrongConfiguration
from sdnator.datasets.unpacking import UnpackError, extract
from sdnator.replay.survey import survey
from sdnator.testing.capture_samples import CAPTURES, block, interface, packet, section
from sdnator.testing.table_samples import LABELS, TSHARK_HEADER, TSHARK_UDP

MUTATIONS = st.lists(
    st.tuples(st.floats(0, 1), st.integers(0, 8), st.binary(max_size=8)), min_size=1, max_size=4
)
NUMBERS = st.sampled_from(
    [b"\xff\xff\xff\xff", b"\x80\0\0\0", b"\0\0\0\x80", b"\xff\xff\xff\x7f", b"\0\0\0\0"]
)
QUICK = settings(
    max_examples=120,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def _mutated(content: bytes, mutations: list[tuple[float, int, bytes]]) -> bytes:
    changed = bytearray(content)
    for place, length, replacement in mutations:
        at = int(place * len(changed))
        changed[at : at + length] = replacement
    return bytes(changed)


def _number_at(content: bytes, place: float, number: bytes) -> bytes:
    at = int(place * (len(content) - 4)) & ~3
    return content[:at] + number + content[at + 4 :]


@QUICK
@given(form=st.sampled_from(sorted(CAPTURES)), packed=st.booleans(), mutations=MUTATIONS)
def test_mutated_captures(tmp_path, form, packed, mutations):
    """Frames within their limits, then the end, a note where it is cut, or CaptureError."""
    path = tmp_path / "c"
    path.write_bytes(_mutated(gzip.compress(CAPTURES[form]) if packed else CAPTURES[form], mutations))
    _read(path)


@QUICK
@given(form=st.sampled_from(sorted(CAPTURES)), place=st.floats(0, 1), number=NUMBERS)
def test_captures_with_senseless_numbers(tmp_path, form, place, number):
    """Lengths, counts, times and options at the edges of 32 bits."""
    path = tmp_path / "c"
    path.write_bytes(_number_at(CAPTURES[form], place, number))
    _read(path)


def _read(path: Path) -> None:
    with suppress(CaptureError):
        surveyed = survey(path)
        assert surveyed.packets == sum(len(batch["length"]) for batch in CaptureSource(path))
        with Capture(path) as capture:
            for frame in capture:
                assert len(frame.data) <= frame.length <= pcap_records.MAX_FRAME
                assert 0 <= frame.time_ns < 1 << 63


@QUICK
@given(mutations=MUTATIONS, packed=st.booleans())
def test_mutated_tables(tmp_path, mutations, packed):
    """Columns that fit their types, or TsvError; never a number that numpy cannot hold."""
    path = tmp_path / "t"
    content = _mutated(f"{TSHARK_HEADER}\n{TSHARK_UDP}\n{TSHARK_UDP}\n".encode(), mutations)
    path.write_bytes(gzip.compress(content) if packed else content)
    with suppress(TsvError):
        for batch in tshark_tsv.read_batches(path):
            assert len(batch["time_us"]) <= 2


@pytest.mark.parametrize(
    ("column", "cell"),
    [
        (0, "99999999999.0"),
        (0, "1.-5"),
        (1, "4294967296"),
        (2, "-a:bb:cc:dd:ee:ff"),
        (2, "1_:00:00:00:00:0_"),
        (8, "2147483648"),
    ],
)
def test_numbers_that_no_column_holds(tmp_path, column, cell):
    """Out of range, with a sign or underscores: an error with line and column, no overflow later on."""
    cells = TSHARK_UDP.split("\t")
    cells[column] = cell
    (tmp_path / "t").write_text(TSHARK_HEADER + "\n" + "\t".join(cells) + "\n")
    with pytest.raises(MalformedTsv, match=rf"line 2, column {tshark_tsv.COLUMNS[column]}"):
        list(tshark_tsv.read_batches(tmp_path / "t"))


@QUICK
@given(form=st.sampled_from(sorted(LABELS)), packed=st.booleans(), mutations=MUTATIONS)
def test_mutated_labels(tmp_path, form, packed, mutations):
    """Labels, or LabelsError, also where the gzip stream itself is damaged."""
    content = LABELS[form].encode()
    path = tmp_path / "l"
    path.write_bytes(_mutated(gzip.compress(content) if packed else content, mutations))
    with suppress(LabelsError):
        assert len(read_labels(path)) > 0


@settings(QUICK, max_examples=60)
@given(mutations=MUTATIONS)
def test_mutated_settings(tmp_path, mutations):
    """A configuration, or WrongConfiguration with every fault and its place."""
    path = tmp_path / "sdnator.toml"
    path.write_bytes(
        _mutated(b'[firewall]\ndry_run = true\n[[switches]]\nname = "s1"\nports = ["1=a"]\n', mutations)
    )
    try:
        config_file.load(path, {})
    except WrongConfiguration as error:
        faults = error.faults
        assert faults
        assert all(fault.place.startswith(str(path)) for fault in faults)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"a = " + b"[" * 50_000, "nested too deeply"),
        (b"a = " + b"9" * 5_000, "a number has too many digits"),
        (b"# " + b"x" * 300_000, "larger than 262,144 bytes"),
        (b"\xff\xfe", "not UTF-8 text"),
    ],
)
def test_settings_that_are_none(tmp_path, content, words):
    """Too deep, too large, no text: the same error as for a wrong option."""
    path = tmp_path / "sdnator.toml"
    path.write_bytes(content)
    with pytest.raises(WrongConfiguration, match=words):
        config_file.load(path, {})
    with pytest.raises(WrongConfiguration, match="No such file"):
        config_file.load(tmp_path / "none.toml", {})


def test_interfaces_of_a_section_have_a_limit(tmp_path):
    """Packets before the flood of interfaces are used; it is named with its offset."""
    good = section("<") + interface("<", 6) + packet("<", 5_000_000, b"\1" * 60)
    (tmp_path / "c").write_bytes(good + interface("<", 6) * pcap_records.MAX_INTERFACES)
    with Capture(tmp_path / "c") as capture:
        assert len(list(capture)) == 1
    assert "interfaces are described" in str(capture.cut)


def test_times_that_do_not_fit_are_damage(tmp_path):
    """An interface whose clock is offset by 2^62 seconds gives no times that numpy could hold."""
    body = struct.pack("<HHIHHqHH", 1, 0, 0, 14, 8, 1 << 62, 0, 0)
    content = section("<") + block("<", 1, body) + packet("<", 5_000_000, b"\1" * 60)
    (tmp_path / "c").write_bytes(content)
    with pytest.raises(NotACapture, match="time of a packet is out of range"):
        Capture(tmp_path / "c")


def test_a_gzip_bomb_ends_early(tmp_path, monkeypatch):
    """What unpacks to over five hundred times its size is cut there, and said; memory stays small."""
    monkeypatch.setattr(pcap_records, "BOMB_BYTES", 1 << 20)
    head = CAPTURES["pcap-us-little"]
    record = struct.pack("<4I", 0, 0, 60_000, 60_000) + bytes(60_000)
    (tmp_path / "c.gz").write_bytes(gzip.compress(head + record * 1_000, 9))
    tracemalloc.start()
    with Capture(tmp_path / "c.gz") as capture:
        packets = sum(1 for _ in capture)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert "more than 500 times its size" in str(capture.cut)
    assert packets < 900
    assert peak < 16 << 20


def test_captures_and_labels_have_a_longest(tmp_path, monkeypatch):
    """Everything about each packet is held in memory: so many, and no more."""
    monkeypatch.setattr(captures, "MAX_PACKETS", 2)
    (tmp_path / "c").write_bytes(CAPTURES["pcap-us-little"])
    with pytest.raises(CaptureError, match="more than 2 packets; split it"):
        survey(tmp_path / "c")
    monkeypatch.setattr(labels, "MAX_LABELS", 2)
    (tmp_path / "l").write_text(LABELS["bare"])
    with pytest.raises(MalformedLabels, match="more than 2 labels"):
        read_labels(tmp_path / "l")


@pytest.mark.parametrize("reader", [read_labels, lambda path: list(tshark_tsv.read_rows(path))])
def test_lines_without_an_end(tmp_path, reader):
    """A gigabyte without a line break is not read into memory to find out that it is no table."""
    (tmp_path / "l.gz").write_bytes(gzip.compress(TSHARK_HEADER.encode() + b"\n" + b"0" * (32 << 20)))
    tracemalloc.start()
    with pytest.raises((LabelsError, TsvError)):
        reader(tmp_path / "l.gz")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 << 20


def _zip(method, name="in/capture.pcap"):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as packed:
        packed.writestr(name, b"abc" * 99)
    return bytearray(file.getvalue())


@pytest.mark.parametrize(
    ("method", "at", "number"),
    [
        (zipfile.ZIP_LZMA, 49, b"\xff" * 4),  # properties of the stream
        (zipfile.ZIP_BZIP2, 49, b"\xff" * 4),
        (zipfile.ZIP_STORED, 6, b"\0\x08"),  # the local name in UTF-8, which it is not
        (zipfile.ZIP_STORED, -59, b"\xff"),  # the version that is needed
    ],
)
def test_zip_files_that_python_reads_in_its_own_way(tmp_path, method, at, number):
    """Damage of each kind is UnpackError, and no half file stays."""
    content = _zip(method)
    if number == b"\xff":
        at = content.index(b"PK\1\2") + 6
    content[at : at + len(number)] = number
    if at == 6:
        content[30:45] = b"\xff" * 15
    (tmp_path / "d.zip").write_bytes(content)
    (tmp_path / "out").mkdir()
    with pytest.raises(UnpackError):
        extract(tmp_path / "d.zip", ["capture.pcap"], tmp_path / "out")
    assert not list((tmp_path / "out").iterdir())


@QUICK
@given(
    method=st.sampled_from([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]),
    mutations=MUTATIONS,
)
def test_mutated_zip_files(tmp_path, method, mutations):
    (tmp_path / "d.zip").write_bytes(_mutated(bytes(_zip(method)), mutations))
    with suppress(UnpackError):
        extract(tmp_path / "d.zip", ["capture.pcap"], tmp_path)
