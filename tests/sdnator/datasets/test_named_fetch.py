"""Public data sets come from a server with the publishers' paths, from a mirror, or from files that are here."""

import bz2
import gzip
import hashlib
import io
import signal
import socket
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from sdnator.capture.captures import CaptureWriter
from sdnator.capture.labels import read_labels
from sdnator.cli.main import app
from sdnator.datasets import frames, local_sets
from sdnator.datasets.catalogue import CATALOGUE
from sdnator.datasets.names import named_capture
from sdnator.errors import BadInput
from sdnator.testing.waiting import wait_for
from tests.sdnator.datasets.publisher import UCI, Publisher, serving

T0 = 1_313_000_000 * 10**9 - 10**9 * (1_313_000_000 % 60)
LABELS = '"","x"\n' + "".join(f'"{number + 1}",{int(number >= 40)}\n' for number in range(60))


def _capture(folder: Path) -> bytes:
    """Sixty packets, a second apart, of 10.0.0.66 to a telnet server."""
    path = folder / "made.pcap"
    with CaptureWriter(path) as writer:
        for number in range(60):
            segment = b"\x0f\xa0\x00\x17" + bytes(8) + b"\x50\x02" + bytes(6)
            packet = frames.ipv4(bytes((10, 0, 0, 66)), bytes((10, 0, 0, 2)), 6, segment)
            frame = frames.ethernet(b"\2" * 6, b"\4" * 6, 0x0800, packet)
            writer.write(T0 + number * 10**9, frame)
    content = path.read_bytes()
    path.unlink()
    return content


@pytest.fixture
def publisher() -> Iterator[Publisher]:
    with serving() as publisher:
        yield publisher


@pytest.fixture
def capture(tmp_path: Path) -> bytes:
    return _capture(tmp_path)


@pytest.fixture(autouse=True)
def _own_data_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "share"))
    monkeypatch.chdir(tmp_path)


def _run(*words: object) -> str:
    result = CliRunner().invoke(app, ["dataset", *map(str, words)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def _fail(*words: object) -> str:
    with pytest.raises(BadInput) as caught:
        CliRunner().invoke(app, ["dataset", *map(str, words)], catch_exceptions=False)
    return str(caught.value)


def _serve_mirai(publisher: Publisher, capture: bytes) -> None:
    publisher.files[f"{UCI}/mirai/Mirai_pcap.pcap.gz"] = gzip.compress(capture, mtime=0)
    publisher.files[f"{UCI}/mirai/Mirai_labels.csv.gz"] = gzip.compress(LABELS.encode(), mtime=0)


def test_mirai_by_name_from_a_mirror(publisher, capture):
    """Two files with the publisher's paths; afterwards the name stands for capture, labels, training."""
    _serve_mirai(publisher, capture)
    with pytest.raises(BadInput, match="run `sdnator dataset fetch mirai`"):
        named_capture(Path("mirai"))
    said = _run("fetch", "mirai", "--mirror", publisher.url)
    digest = hashlib.sha256(gzip.compress(capture, mtime=0)).hexdigest()
    assert f"SHA-256 {digest} (pinned from now on)" in said
    assert "CC BY 4.0" in said
    assert "60 labels, but the publication mentions 764,137 packets" in said
    found = named_capture(Path("mirai"))
    assert found.labels is not None
    assert len(read_labels(found.labels)) == 60
    assert (found.training.fm_grace, found.training.ad_grace) == (5_000, 50_000)
    assert found.capture.name == "Mirai_pcap.pcap.gz"
    assert "is here already" in _run("fetch", "mirai", "--mirror", publisher.url)
    assert len(publisher.asked) == 2


def test_a_file_of_that_name_wins(publisher, capture, tmp_path):
    """A real file called mirai is taken, and that is said."""
    (tmp_path / "mirai").write_bytes(capture)
    found = named_capture(Path("mirai"))
    assert (found.capture, found.training) == (Path("mirai"), None)
    assert "taken as the file" in found.note


def test_other_names_and_folders_of_a_mirror(publisher, capture):
    """Spaces or underscores, pcapng or pcap, with the publisher's path or the set's folder alone."""
    publisher.files["/os_scan/OS Scan_pcap.pcap.gz"] = gzip.compress(capture)
    publisher.files["/os_scan/OS_Scan_labels.csv.gz"] = gzip.compress(LABELS.encode())
    _run("fetch", "os_scan", "--mirror", publisher.url)
    found = named_capture(Path("os_scan"))
    assert found.capture.name == "OS_Scan_pcap.pcap.gz"
    assert found.training.fm_grace + found.training.ad_grace == 1_000_000


def test_a_download_goes_on_where_it_ended(publisher, capture):
    """The connection breaks off five times; the next run asks for the rest only."""
    _serve_mirai(publisher, capture)
    publisher.break_after = [10] * 5
    assert "run the command again to continue" in _fail("fetch", "mirai", "--mirror", publisher.url)
    _run("fetch", "mirai", "--mirror", publisher.url)
    assert publisher.asked[5][1] == "bytes=50-"


def test_what_is_not_the_file(publisher, capture):
    """404, a portal's page, a truncated gzip and something else: each its own clear error."""
    assert "not found at" in (text := _fail("fetch", "mirai", "--mirror", publisher.url))
    assert "nor at 5 other addresses" in text, "all of them would fill a screen"
    assert "--whole (17.7 GB)" in text
    place = f"{UCI}/mirai/Mirai_pcap.pcap.gz"
    publisher.pages[place] = b"<html>Please register</html>"
    assert "a web page came" in _fail("fetch", "mirai", "--mirror", publisher.url)
    publisher.pages.clear()
    for content, words in (
        (gzip.compress(capture)[:-50], "truncated"),
        (b"\0\1\2\3" * 99, "neither a capture nor labels"),
        (b"<!DOCTYPE html><p>moved", "a web page, not a file"),
        (gzip.compress(b"no capture"), "mirai"),
    ):
        publisher.files[place] = content
        assert words in _fail("fetch", "mirai", "--mirror", publisher.url)
    _serve_mirai(publisher, capture)
    _run("fetch", "mirai", "--mirror", publisher.url)


def test_a_pinned_checksum_must_match(publisher, capture, tmp_path):
    """Another file under the same name is refused, thrown away, and accepted with --repin."""
    _serve_mirai(publisher, capture)
    _run("fetch", "mirai", "--mirror", publisher.url)
    for path in (tmp_path / "share" / "sdnator" / "datasets" / "mirai").iterdir():
        path.unlink()
    assert "the file is gone" in _fail_named("mirai")
    publisher.files[f"{UCI}/mirai/Mirai_pcap.pcap.gz"] = gzip.compress(capture, 1, mtime=5)
    text = _fail("fetch", "mirai", "--mirror", publisher.url)
    assert "--repin" in text
    assert "checksums.json" in text
    assert "pinned from now on" in _run("fetch", "mirai", "--mirror", publisher.url, "--repin")


def _fail_named(name: str) -> str:
    with pytest.raises(BadInput) as caught:
        named_capture(Path(name))
    return str(caught.value)


def _whole_set(capture: bytes) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("../../evil.txt", "no")
        file.writestr("OS Scan/OS_Scan_pcap.pcapng", capture[:-20])
        file.writestr("Mirai Botnet/Mirai_pcap.pcap", capture)
        file.writestr("Mirai Botnet/mirai_labels.csv", "0\n" * 60)
    return packed.getvalue()


def test_the_whole_set_gives_the_members_that_are_needed(publisher, capture, tmp_path):
    """Only capture and labels leave the archive, under our names; nothing else is written anywhere."""
    path = "/static/public/516/kitsune+network+attack+dataset.zip"
    publisher.files[path] = _whole_set(capture)
    _run("fetch", "mirai", "--mirror", publisher.url, "--whole", "--into", tmp_path / "here")
    names = {each.name for each in (tmp_path / "here").iterdir()}
    assert names == {"Mirai_pcap.pcap", "Mirai_labels.csv", "kitsune+network+attack+dataset.zip"}
    assert not list(tmp_path.parent.rglob("evil.txt"))
    assert "there is no archive" in _fail("fetch", "iot23_1_1", "--mirror", publisher.url, "--whole")


def test_files_that_are_here(capture, tmp_path):
    """A zip, or capture and labels one after the other; they stay where they are."""
    (tmp_path / "k.zip").write_bytes(_whole_set(capture))
    _run("fetch", "mirai", "--from", tmp_path / "k.zip", "--into", tmp_path / "out")
    assert named_capture(Path("mirai")).capture == tmp_path / "out" / "Mirai_pcap.pcap"
    (tmp_path / "mine.pcap").write_bytes(capture)
    (tmp_path / "mine.csv").write_text(LABELS)
    assert "no labels" in _run("fetch", "fuzzing", "--from", tmp_path / "mine.pcap")
    _run("fetch", "fuzzing", "--from", tmp_path / "mine.csv")
    found = named_capture(Path("fuzzing"))
    assert (found.capture, found.labels) == (tmp_path / "mine.pcap", tmp_path / "mine.csv")
    assert "none of" in _fail("fetch", "syn_dos", "--from", tmp_path / "k.zip")
    assert "no capture among" in _fail("fetch", "syn_dos", "--from", tmp_path / "mine.csv")


@pytest.mark.parametrize("damage", ["truncated", "flipped"])
def test_a_damaged_archive(capture, tmp_path, damage):
    """A zip that is cut or whose member fails its checksum leaves no half file."""
    content = bytearray(_whole_set(capture))
    at = content.index(b"Mirai_pcap.pcap") + 40
    content[at : at + 4] = b"\xff" * 4
    (tmp_path / "k.zip").write_bytes(content if damage == "flipped" else content[:-300])
    text = _fail("fetch", "mirai", "--from", tmp_path / "k.zip", "--into", tmp_path / "out")
    assert "again" in text
    assert not list((tmp_path / "out").iterdir())


def _flow_rows() -> dict[str, str]:
    """The last twenty seconds as an attack, in the three published forms."""
    start = T0 // 10**9 + 40
    zeek = (
        "#fields\tts\tid.orig_h\tid.orig_p\tid.resp_h\tid.resp_p\tproto\tduration\ttunnel_parents   label   "
        f"detailed-label\n{start + 1}.0\t10.0.0.66\t4000\t10.0.0.2\t23\ttcp\t20.0\t(empty)   Malicious   DDoS\n"
    )
    names = "StartTime,Dur,Proto,SrcAddr,Sport,Dir,DstAddr,Dport,State,sTos,dTos,TotPkts,TotBytes,SrcBytes,Label\n"
    return {"iot23_1_1": zeek, "ctu13_1": names}


def test_flow_labels_become_packet_labels(publisher, capture, tmp_path):
    """IoT-23: Zeek's labels beside the capture; the written labels are one a packet."""
    base = "/publicDatasets/IoT-23-Dataset/IndividualScenarios/CTU-IoT-Malware-Capture-1-1"
    publisher.files[f"{base}/2018-05-09-192.168.100.103.pcap"] = capture
    publisher.files[f"{base}/bro/conn.log.labeled"] = _flow_rows()["iot23_1_1"].encode()
    assert "20 of 60 packets belong to an attack; 1 of 1" in _run(
        "fetch", "iot23_1_1", "--mirror", publisher.url
    )
    found = named_capture(Path("iot23_1_1"))
    assert read_labels(found.labels, 60).attack.nonzero()[0].tolist() == list(range(40, 60))
    assert "use --model" in found.note
    other = base.replace("1-1", "3-1")
    publisher.files[f"{other}/2018-05-21_capture.pcap"] = capture
    publisher.files[f"{other}/bro/conn.log.labeled"] = (
        _flow_rows()["iot23_1_1"].replace("20.0", "5.0").encode()
    )
    assert "8 of 60 packets" in _run("fetch", "iot23_3_1", "--mirror", publisher.url)


def test_packed_captures_and_archives_of_labels(publisher, capture, tmp_path):
    """CTU-13 packs captures with bzip2; CICIDS2017 has its tables in a zip, in a folder with a space behind."""
    base = "/publicDatasets/CTU-Malware-Capture-Botnet-42"
    local = _local(T0 // 10**9 + 41, 2)
    row = f"{local.replace('-', '/')}.0,20.0,tcp,10.0.0.66,4000,   ->,10.0.0.2,23,S_,0,,1,60,60,flow=From-Botnet-V42\n"
    publisher.files[f"{base}/capture20110810.truncated.pcap.bz2"] = bz2.compress(capture)
    table = f"{base}/detailed-bidirectional-flow-labels/capture20110810.binetflow"
    publisher.files[table] = (_flow_rows()["ctu13_1"] + row).encode()
    assert "20 of 60 packets" in _run("fetch", "ctu13_1", "--mirror", publisher.url)

    year, month, day = _local(T0 // 10**9, -3)[:10].split("-")
    hour = int(_local(T0 // 10**9, -3)[11:13])
    assert 8 <= hour <= 19
    moment = f"{int(day)}/{int(month)}/{year} {(hour - 1) % 12 + 1}:{_local(T0 // 10**9, -3)[14:16]}"
    header = "Flow ID, Source IP, Source Port, Destination IP, Destination Port, Protocol, Timestamp, Flow Duration, Label\n"
    rows = f"a,10.0.0.66,4000,10.0.0.2,23,6,{moment},1000,FTP-Patator\n"
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as file:
        file.writestr("TrafficLabelling /Tuesday-WorkingHours.pcap_ISCX.csv", header + rows)
        file.writestr("TrafficLabelling /Monday-WorkingHours.pcap_ISCX.csv", header)
    cic = "/CICDataset/CIC-IDS-2017/Dataset/CIC-IDS-2017"
    publisher.files[f"{cic}/PCAPs/Tuesday-WorkingHours.pcap"] = capture
    publisher.files[f"{cic}/CSVs/GeneratedLabelledFlows.zip"] = packed.getvalue()
    assert "60 of 60 packets" in _run("fetch", "cicids2017_tuesday", "--mirror", publisher.url)


def _local(seconds: int, offset: int) -> str:
    from datetime import UTC, datetime

    return datetime.fromtimestamp(seconds + offset * 3600, UTC).strftime("%Y-%m-%d %H:%M:%S")


def test_label_command(capture, tmp_path):
    """Labels for a capture of one's own, from a table of flows."""
    (tmp_path / "c.pcap").write_bytes(capture)
    (tmp_path / "conn.log").write_text(_flow_rows()["iot23_1_1"])
    assert "20 of 60 packets" in _run("label", tmp_path / "c.pcap", tmp_path / "conn.log")
    assert len(read_labels(tmp_path / "c.labels.csv", 60)) == 60


def test_list_and_show():
    """Nineteen names with what is known of them; what nobody has fetched while writing says so."""
    listed = _run("list")
    assert all(name in listed for name in CATALOGUE)
    assert max(map(len, listed.splitlines())) <= 100
    shown = _run("show", "mirai")
    for words in (
        "CC BY 4.0",
        "764,137",
        "not verified",
        "Mirai_pcap.pcap.gz",
        "first 55,000 packets",
        "NDSS 2018",
    ):
        assert words in shown
    assert '"name": "os_scan"' in _run("list", "--json")
    assert "`sdnator dataset list`" in _fail("show", "venus")
    assert "not an http" in _fail("fetch", "mirai", "--mirror", "ftp://x")


def test_every_entry_of_the_catalogue_is_complete():
    """Sources, licence and citation for each; no file name would leave its folder."""
    for each in CATALOGUE.values():
        assert each.capture.urls
        assert each.labels.urls
        assert each.publication.licence
        assert each.publication.citation
        assert not each.verified
        for member in (*each.capture.members, *each.labels.members):
            assert "/" not in member


def test_damaged_records_say_what_to_do(tmp_path):
    """A record that is no JSON names the file."""
    local_sets.folder().mkdir(parents=True)
    (local_sets.folder() / "mirai.json").write_text("{")
    assert "delete it" in _fail_named("mirai")
    (local_sets.folder() / "mirai.json").write_text("[" * 5000)
    assert "delete it" in _fail_named("mirai")
    (local_sets.folder() / "mirai.json").write_text("[1]")
    assert "not a record" in _fail_named("mirai")


def test_who_interrupts_a_download_is_told_that_it_goes_on(tmp_path, monkeypatch):
    """Ctrl-C in the real program, once some bytes of the capture are here."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"http://127.0.0.1:{server.getsockname()[1]}"
        command = [sys.executable, "-m", "sdnator.cli.main", "dataset", "fetch", "mirai", "--mirror", url]
        process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
        connection, _ = server.accept()
        with connection:
            connection.recv(4096)
            connection.sendall(
                b'HTTP/1.1 200 OK\r\nETag: "1"\r\nContent-Length: 5000000\r\n\r\n' + bytes(300_000)
            )
            folder = tmp_path / "data" / "sdnator" / "datasets" / "mirai"
            wait_for(lambda: any(each.stat().st_size for each in folder.glob(".*.part")))
            process.send_signal(signal.SIGINT)
            said = process.communicate(timeout=60)[1]
    assert process.returncode == 130
    assert "what has been downloaded is kept; run the command again to continue" in said
