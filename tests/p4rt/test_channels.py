"""Channels to switches are made in one place, and plain ones over TCP only where somebody said so."""

import ast
from pathlib import Path

import pytest

from p4rt import INSECURE, ChannelSecurity, InsecureChannel, open_channel

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("apps", "benchmarks", "coordinator", "dataplane", "due", "examples", "p4rt", "sdnator")


def _named(path: Path, name: str) -> bool:
    found = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    return any(getattr(each, "attr", getattr(each, "id", "")) == name for each in found)


@pytest.mark.parametrize("name", ["insecure_channel", "secure_channel"])
def test_one_file_opens_channels(name):
    files = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]
    assert len(files) > 300
    assert [path for path in files if _named(path, name)] == [ROOT / "p4rt" / "channels.py"]


@pytest.mark.parametrize("security", [None, ChannelSecurity(), ChannelSecurity(certificate="c", key="k")])
def test_tcp_without_a_word_about_tls_is_refused_and_says_what_to_write(security):
    with pytest.raises(
        InsecureChannel, match=r"10\.0\.0\.2:9559.*tls_ca.*sdnator cert init.*insecure = true"
    ):
        open_channel("10.0.0.2:9559", security)


def test_a_unix_socket_needs_nothing_and_a_lab_says_so(tmp_path):
    for address, security in ((f"unix:{tmp_path}/s", None), ("127.0.0.1:1", INSECURE)):
        (security or ChannelSecurity()).check(address)
        with open_channel(address, security):
            pass


def test_files_that_cannot_be_used_are_named(tmp_path):
    with pytest.raises(InsecureChannel, match=r"TLS file /nowhere/ca\.pem: No such file"):
        open_channel("127.0.0.1:1", ChannelSecurity(ca="/nowhere/ca.pem"))
    with pytest.raises(InsecureChannel, match="belong together"):
        ChannelSecurity(ca=str(tmp_path / "ca.pem"), key="k").check("127.0.0.1:1")
