"""A download resumes where it broke off, and a wrong file never gets the right name."""

import hashlib
import resource
import shutil
import signal
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from sdnator.datasets.fetch import (
    BadSource,
    ChecksumMismatch,
    DiskFull,
    Interrupted,
    NotThere,
    WrongContent,
    fetch,
)

CONTENT = bytes(range(256)) * 4_000
SHA256 = hashlib.sha256(CONTENT).hexdigest()


class Source:
    """A small web server that can break off, change its file, or forget how to serve ranges."""

    def __init__(self) -> None:
        self.content = CONTENT
        self.etag = '"one"'
        self.break_after: list[int] = []
        self.ranges = True
        self.tells_length = True
        self.content_type = ""
        self.wrong_by = 0
        self.asked: list[str | None] = []
        source = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                source.answer(self)

            def log_message(self, *_args: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}/mirai.pcap.gz"

    def answer(self, request: BaseHTTPRequestHandler) -> None:
        wanted = request.headers.get("Range")
        self.asked.append(wanted)
        if request.path.startswith("/missing"):
            request.send_error(404)
            return
        start = 0
        if wanted and self.ranges and request.headers.get("If-Range") == self.etag:
            start = int(wanted.removeprefix("bytes=").removesuffix("-"))
            if start >= len(self.content):
                request.send_error(416)
                return
        body = self.content[start:]
        request.send_response(206 if start else 200)
        if start:
            request.send_header(
                "Content-Range", f"bytes {start + self.wrong_by}-{len(self.content) - 1}/{len(self.content)}"
            )
        if self.content_type:
            request.send_header("Content-Type", self.content_type)
        if self.etag:
            request.send_header("ETag", self.etag)
        if self.tells_length:
            request.send_header("Content-Length", str(len(body)))
        request.end_headers()
        request.wfile.write(body[: self.break_after.pop(0)] if self.break_after else body)


@pytest.fixture
def source() -> Iterator[Source]:
    source = Source()
    thread = threading.Thread(target=source.server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield source
    source.server.shutdown()
    source.server.server_close()
    thread.join()


def test_plain_download(tmp_path, source):
    steps: list[tuple[int, int | None]] = []
    made = fetch(
        source.url, tmp_path / "new" / "f", sha256=SHA256.upper(), progress=lambda *step: steps.append(step)
    )
    assert made.path.read_bytes() == CONTENT
    assert (made.bytes, made.resumed_at, made.sha256) == (len(CONTENT), 0, SHA256)
    assert steps[-1] == (len(CONTENT), len(CONTENT))
    assert [path.name for path in made.path.parent.iterdir()] == ["f"]


def test_a_broken_connection_is_taken_up_again(tmp_path, source):
    source.break_after = [1_000, 300_000]
    assert fetch(source.url, tmp_path / "f", sha256=SHA256).path.read_bytes() == CONTENT
    assert source.asked == [None, "bytes=1000-", "bytes=301000-"]


def test_a_second_run_goes_on_where_the_first_ended(tmp_path, source):
    source.break_after = [1_000, 2_000]
    with pytest.raises(Interrupted, match=r"after 3,000 bytes .* run the command again"):
        fetch(source.url, tmp_path / "f", tries=2)
    assert not (tmp_path / "f").exists()
    made = fetch(source.url, tmp_path / "f", sha256=SHA256)
    assert (made.resumed_at, source.asked[-1]) == (3_000, "bytes=3000-")
    assert made.path.read_bytes() == CONTENT


def test_a_file_that_changed_meanwhile_starts_again(tmp_path, source):
    source.break_after = [1_000]
    with pytest.raises(Interrupted):
        fetch(source.url, tmp_path / "f", tries=1)
    source.content, source.etag = CONTENT[::-1], '"two"'
    assert fetch(source.url, tmp_path / "f").path.read_bytes() == CONTENT[::-1]


@pytest.mark.parametrize(("ranges", "etag"), [(False, '"one"'), (True, "")])
def test_servers_without_ranges_or_versions(tmp_path, source, ranges, etag):
    """Nothing can be resumed safely: the file is fetched from its start."""
    source.ranges, source.etag, source.break_after = ranges, etag, [1_000]
    assert fetch(source.url, tmp_path / "f", sha256=SHA256).path.read_bytes() == CONTENT


def test_a_server_that_tells_no_length(tmp_path, source):
    source.tells_length = False
    assert fetch(source.url, tmp_path / "f", sha256=SHA256).bytes == len(CONTENT)


def test_a_part_of_another_url_is_not_used(tmp_path, source):
    source.break_after = [1_000]
    with pytest.raises(Interrupted):
        fetch(source.url, tmp_path / "f", tries=1)
    fetch(source.url + "?other", tmp_path / "f", sha256=SHA256)
    assert source.asked == [None, None]


def test_a_part_longer_than_the_file_starts_again(tmp_path, source):
    source.break_after = [1_000]
    with pytest.raises(Interrupted):
        fetch(source.url, tmp_path / "f", tries=1)
    with (tmp_path / ".f.part").open("ab") as part:
        part.write(bytes(len(CONTENT)))
    assert fetch(source.url, tmp_path / "f", sha256=SHA256).bytes == len(CONTENT)


def test_a_wrong_checksum_leaves_nothing(tmp_path, source):
    with pytest.raises(ChecksumMismatch, match="expected 00"):
        fetch(source.url, tmp_path / "f", sha256="00")
    assert list(tmp_path.iterdir()) == []


def test_bad_sources(tmp_path, source):
    with pytest.raises(BadSource, match="not an http"):
        fetch("file:///etc/passwd", tmp_path / "f")
    with pytest.raises(NotThere, match="404"):
        fetch(source.url.replace("/mirai", "/missing"), tmp_path / "f")
    with pytest.raises(Interrupted, match="refused"):
        fetch("http://127.0.0.1:1/x", tmp_path / "f", tries=1)


def test_a_web_page_instead_of_the_file(tmp_path, source):
    """A portal's page is refused before anything is stored."""
    source.content, source.content_type = b"<!DOCTYPE html>please register", "text/html; charset=utf-8"
    with pytest.raises(WrongContent, match="a web page came"):
        fetch(source.url, tmp_path / "f")
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_is_too_small_is_told_before_the_download(tmp_path, source, monkeypatch):
    """What is missing and what is free; nothing was downloaded."""
    monkeypatch.setattr("shutil.disk_usage", lambda _path: shutil._ntuple_diskusage(10, 5, 5))
    with pytest.raises(DiskFull, match=r"1,024,000 bytes are missing, 5 bytes are free"):
        fetch(source.url, tmp_path / "f")
    assert not (tmp_path / "f").exists()


def test_a_disk_that_fills_up_keeps_what_has_come(tmp_path, source):
    """A limit on the size of files stands for the full disk; the next try goes on from there."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, before[1]))
    try:
        with pytest.raises(DiskFull, match="the disk is full"):
            fetch(source.url, tmp_path / "f")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    assert fetch(source.url, tmp_path / "f", sha256=SHA256).resumed_at == 300_000


def test_a_note_that_was_cut_off_starts_again(tmp_path, source):
    """A crash may leave half a note: nothing says what the bytes at hand belong to."""
    source.break_after = [1_000]
    with pytest.raises(Interrupted):
        fetch(source.url, tmp_path / "f", tries=1)
    (tmp_path / ".f.part.json").write_text('{"url": "ht')
    assert fetch(source.url, tmp_path / "f", sha256=SHA256).resumed_at == 0


def test_another_part_than_was_asked_for_is_not_appended(tmp_path, source):
    """A server that sends some other range: the file is fetched from its start."""
    source.break_after, source.wrong_by = [1_000], 7
    assert fetch(source.url, tmp_path / "f", sha256=SHA256).path.read_bytes() == CONTENT
    assert source.asked == [None, "bytes=1000-", None]
