"""Files and streams that are fetched, restored or replayed: archives, data sets, queries, what feeds a switch's ports."""

import bz2
import gzip
import io
import json
import random
import shutil
import tarfile
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from apps.p4runtime_ctrl.errors import CaptureTimesError
from apps.p4runtime_ctrl.southbound.capture_times import CaptureTimes
from apps.sonata_adapter.errors import QueryError
from apps.sonata_adapter.query.templates import SUFFIX, QueryFolder
from benchmarks.hostile_due import FRAMES as FRAMES_OF_DUE
from benchmarks.hostile_files import in_file, temporary_folder
from benchmarks.hostile_mutation import mutate_bytes, mutate_json, mutate_text, mutate_value
from benchmarks.hostile_target import DecoderTarget
from dataplane.ports.capture_port import BlockReader, CapturePortError, pack_block
from dataplane.ports.pcap_port import PcapReader
from dataplane.ports.port import PortError
from due import Item
from due.codec import decode_value, encode_value
from due.drivers import mongodb
from due.drivers.query import parse
from due.errors import DecodeError
from sdnator.cli import backup_commands
from sdnator.config import config_file
from sdnator.config.config_file import WrongConfiguration
from sdnator.datasets import local_sets
from sdnator.datasets.unpacking import UnpackError, check_gzip, content_of, extract, unpack_bzip2
from sdnator.errors import BadInput
from sdnator.testing.capture_samples import pcap

_NOW = 1_700_000_000_000_000_000
_MANIFEST = {"schema": 1, "version": "1", "made": "2026", "files": ["sdnator.toml", "models/a.npz"]}
_LARGEST_MANIFEST = 1 << 16


def _backup(path: Path) -> None:
    """Everything of a restore but the last step, that puts files into their places."""
    folder = temporary_folder() / "restored"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    manifest, files = backup_commands._unpacked(path, folder)
    for name, file in files.items():
        assert folder in backup_commands._place(name, folder).parents or name == "sdnator.toml"
        assert file.resolve().is_relative_to(folder.resolve())
    json.dumps(manifest)


def _tar(manifest: bytes, names: Sequence[str]) -> bytes:
    made = io.BytesIO()
    with tarfile.open(fileobj=made, mode="w") as tar:
        for name, content in (("manifest.json", manifest), *((name, b"x" * 20) for name in names)):
            about = tarfile.TarInfo(name)
            about.size = len(content)
            tar.addfile(about, io.BytesIO(content))
    return gzip.compress(made.getvalue(), 1, mtime=0)


def _mutate_backup(chance: random.Random, seeds: Sequence[bytes]) -> bytes:
    """Half of them with another manifest or other names; a byte in the packed file would mostly be damage alone."""
    what = chance.random()
    if what < 0.3:
        return mutate_bytes(chance, seeds)
    if what < 0.5:
        return gzip.compress(mutate_bytes(chance, [gzip.decompress(seed) for seed in seeds[:1]]), 1, mtime=0)
    manifest = mutate_json(chance, [json.dumps(_MANIFEST).encode()])
    odd = ("../x", "/x", "models/..", "models/a/b", "models/\n", "models/a.npz", "archive.db", "sdnator.toml")
    return _tar(manifest[:_LARGEST_MANIFEST], chance.choices(odd, k=chance.randint(0, 4)))


def _zip(path: Path) -> None:
    folder = temporary_folder() / "extracted"
    folder.mkdir(exist_ok=True)
    for found in extract(path, ["capture.pcap", "Labels"], folder):
        assert found.parent == folder


def _zips() -> tuple[bytes, ...]:
    made = []
    for method in (zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w", method) as packed:
            packed.writestr("in/capture.pcap", pcap("<", nano=False)[:200])
            packed.writestr("Labels.gz", gzip.compress(b"1\n2\n", mtime=0))
        made.append(file.getvalue())
    return tuple(made)


def _fetched(path: Path) -> None:
    if content_of(path) == "bzip2":
        unpack_bzip2(path, path.with_name("unpacked"))
    else:
        check_gzip(path)


def _record(path: Path) -> None:
    local_sets._read(path).get("capture")


def _queries(data: bytes) -> None:
    folder = temporary_folder() / "queries"
    folder.mkdir(exist_ok=True)
    (folder / f"mine{SUFFIX}").write_bytes(data)
    QueryFolder(folder).templates()


def _times(path: Path) -> None:
    CaptureTimes.load(path).of(np.array([5, 9, 2**63], "u8"))


def _time_file() -> bytes:
    made = io.BytesIO()
    np.save(made, np.arange(5, dtype="i8") + _NOW // 1000)
    return made.getvalue()


def _blocks(data: bytes) -> None:
    """As a socket gives them: in two pieces."""
    reader, half = BlockReader(), len(data) // 2
    for part in (data[:half], data[half:]):
        reader.feed(part)
        found = reader.take(100)
        assert len(list(found.frames())) == len(found)


def _port(path: Path) -> None:
    reader = PcapReader(path)
    try:
        while reader.read() is not None:
            pass
    finally:
        reader.close()


def _variables(data: bytes) -> None:
    """Lines of NAME=VALUE in the environment."""
    given = (line.partition("=") for line in data.decode("utf-8", "replace").split("\n")[:20])
    config_file.load(None, {f"SDNATOR_{name}": value for name, equals, value in given if equals})


_QUERY = parse({"dataKey": "a.b.*", "value.n": {"$gte": 0}})
_ITEM = Item("a.b.app", {"n": 5}, _NOW, _NOW, "app", "i", 3)


def _document(data: bytes) -> None:
    """What a MongoDB server says it has; of more errors than these a reader would know nothing."""
    value = decode_value(data)
    if isinstance(value, dict):
        list(mongodb._items(value, _QUERY))


def _documents() -> tuple[bytes, ...]:
    made = (mongodb._item_document(_ITEM), {**mongodb._item_document(_ITEM), "payload": FRAMES_OF_DUE[1]})
    return tuple(
        encode_value({**one, **{k: int(v) for k, v in one.items() if isinstance(v, int)}}) for one in made
    )


_BLOCK = pack_block([5, 6], [60, 61], [bytes(60), bytes(50)])
_OWN_QUERY = b"query mine(window=3s, threshold=40):\n    filter tcp.flags & 23 == 2\n    map dst = ip.dst\n    reduce by dst: count = count()\n    filter count >= threshold\n"
_SETTINGS = b"FIREWALL_RULES_DRY_RUN=true\nKITSUNE_THRESHOLD=1.5\nFIREWALL_RULES_ALLOW=10.0.0.1,10.0.0.0/8\nKITSUNE_FM_GRACE=7\n"

TARGETS = (
    DecoderTarget(
        "backup",
        in_file("b", _backup),
        (BadInput,),
        (_tar(json.dumps(_MANIFEST).encode(), _MANIFEST["files"]),),  # type: ignore[arg-type]
        _mutate_backup,
    ),
    DecoderTarget("data set zip", in_file("z", _zip), (UnpackError,), _zips()),
    DecoderTarget(
        "data set gzip",
        in_file("g", _fetched),
        (UnpackError,),
        (gzip.compress(b"abc" * 99, mtime=0), bz2.compress(b"abc" * 99)),
    ),
    DecoderTarget(
        "data set record",
        in_file("r", _record),
        (BadInput,),
        (b'{"capture": "a", "labels": null}',),
        mutate_json,
    ),
    DecoderTarget("query file", _queries, (QueryError,), (_OWN_QUERY,), mutate_text),
    DecoderTarget("capture times", in_file("n", _times), (CaptureTimesError,), (_time_file(),)),
    DecoderTarget("capture port", _blocks, (CapturePortError,), (_BLOCK, _BLOCK * 3)),
    DecoderTarget(
        "pcap port", in_file("p", _port), (PortError,), (pcap("<", nano=False), pcap(">", nano=True))
    ),
    DecoderTarget("settings in variables", _variables, (WrongConfiguration,), (_SETTINGS,), mutate_text),
    DecoderTarget(
        "archive document",
        _document,
        (DecodeError, KeyError, TypeError, ValueError, AttributeError, ArithmeticError),
        _documents(),
        mutate_value,
    ),
)
