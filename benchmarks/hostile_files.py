"""Files from anywhere: captures, tables, labels, settings, models, the run file, rows of spools and archives."""

import fcntl
import gzip
import os
import sqlite3
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from apps.firewall.settings import Settings as FirewallSettings
from apps.kitsune.afterimage import WIDTH
from apps.kitsune.kernel import load_kernel
from apps.kitsune.kitnet import KitNet
from apps.kitsune.model_file import ModelFileError, load_model, save_model
from apps.kitsune.service import Settings as KitsuneSettings
from apps.p4runtime_ctrl.settings import Settings as ControllerSettings
from apps.sonata_adapter.service import Settings as SonataSettings
from benchmarks.hostile_due import FRAMES
from benchmarks.hostile_mutation import mutate_json, mutate_text
from benchmarks.hostile_target import DecoderTarget
from coordinator.service import Settings as CoordinatorSettings
from dataplane.p4runtime.trust import TrustError, read_trusted
from due import Item
from due.codec import encode_value
from due.config import Options
from due.drivers.spool import DiskSpool
from due.drivers.spool_reserve import SpoolReserve
from due.drivers.sqlite import SqliteArchive
from due.errors import BackendError, InvalidOption
from due.messages import PackedFrame
from due.service import read_struct
from sdnator.capture.captures import Capture, CaptureError
from sdnator.capture.labels import LabelsError, read_labels
from sdnator.capture.tshark_tsv import TsvError, read_batches
from sdnator.config import config_file
from sdnator.config.config_file import WrongConfiguration
from sdnator.datasets.flow_tables import FlowTableError, read_flow_table
from sdnator.errors import BadInput
from sdnator.replay.survey import survey
from sdnator.testing.capture_samples import CAPTURES
from sdnator.testing.table_samples import BINETFLOW, CICFLOWMETER, LABELS, TSHARK_HEADER, TSHARK_UDP, ZEEK
from sdnator.up.running import Running, find, write

_NOW = 1_700_000_000_000_000_000


@cache
def temporary_folder() -> Path:
    """One for all targets of this process."""
    return Path(tempfile.mkdtemp(prefix="hostile-"))


def in_file(name: str, read: Callable[[Path], object]) -> Callable[[bytes], object]:
    """A decoder of files as one of bytes."""

    def decode(data: bytes) -> object:
        path = temporary_folder() / name
        path.write_bytes(data)
        return read(path)

    return decode


def _both(contents: tuple[bytes, ...]) -> tuple[bytes, ...]:
    return (*contents, *(gzip.compress(content, mtime=0) for content in contents))


def _capture(path: Path) -> None:
    survey(path)
    with Capture(path) as capture:
        for frame in capture:
            assert len(frame.data) <= frame.length
            assert 0 <= frame.time_ns < 1 << 63


_KINDS: tuple[type[Any], ...] = (
    KitsuneSettings,
    FirewallSettings,
    ControllerSettings,
    SonataSettings,
    CoordinatorSettings,
    Options,
)


def _settings(path: Path) -> None:
    refused: list[str] = []  # not the errors, which would hold this frame, and it them
    for kind in _KINDS:
        try:
            read_struct(str(path), kind)
        except InvalidOption as error:
            refused.append(str(error))
    if len(refused) == len(_KINDS):
        raise InvalidOption(refused[0])


_SETTINGS = (
    b"{}",
    msgspec.json.encode(ControllerSettings(switches=(), program="p", p4info="i")),
    msgspec.json.encode(FirewallSettings()),
    msgspec.json.encode(KitsuneSettings()),
    msgspec.json.encode(CoordinatorSettings()),
    msgspec.json.encode(Options()),
)
_TOML = (
    b'[firewall.rules]\ndry_run = true\n[[switches]]\nname = "s1"\nports = ["1=null", "2=veth:b"]\n',
    b"[kitsune]\nfm_grace = 5000\nthreshold = 1.5\n",
)


def _toml(path: Path) -> object:
    return config_file.load(path, {})


def _table(path: Path) -> None:
    for _ in read_batches(path):
        pass


def _flows(path: Path) -> None:
    for _ in read_flow_table(path, clock_offset_hours=-3.0):
        pass


@cache
def _model_bytes() -> bytes:
    network = KitNet(WIDTH, fm_grace=120, ad_grace=120, max_ae=10, clip=0.0, kernel=load_kernel())
    network.process(np.random.default_rng(1).normal(size=(300, WIDTH)))
    path = temporary_folder() / "genuine.npz"
    save_model(path, network, {"senders": [], "trained_at_us": 5})
    return path.read_bytes()


def _run_file(data: bytes) -> None:
    folder = temporary_folder()
    if not hasattr(_run_file, "lock"):
        (folder / "run.lock").write_text(str(os.getpid()))
        lock = os.open(folder / "run.lock", os.O_RDWR)
        fcntl.flock(lock, fcntl.LOCK_EX)
        _run_file.lock = lock  # type: ignore[attr-defined]
    (folder / "run.json").write_bytes(data)
    find(folder)


def _run_bytes() -> bytes:
    running = Running(
        pid=1, started=_NOW, updates="redis://127.0.0.1:1", archive="sqlite:////a.db", coordinator="http://127.0.0.1:2",
        switch={"name": "s1", "ports": [1]}, parts={"kitsune": 7}, health={"kitsune": {"state": "running"}},
    )  # fmt: skip
    write(temporary_folder(), running)
    return (temporary_folder() / "run.json").read_bytes()


_FRAME = PackedFrame("a.b.app", "app", "i", 1, 1, _NOW, _NOW, _NOW, _NOW, False, FRAMES[1])
_SPOOLED = msgspec.msgpack.encode(_FRAME)


@cache
def _spool() -> DiskSpool:
    return DiskSpool(temporary_folder(), 1 << 24)


def _spool_row(data: bytes) -> list[PackedFrame]:
    spool = _spool()
    spool._append([(len(data), data)])
    taken = spool.take(4)
    spool.done(len(taken))
    return taken


def _spool_file(data: bytes) -> None:
    folder = temporary_folder() / "spools"
    folder.mkdir(exist_ok=True)
    for path in folder.iterdir():
        path.unlink()
    (folder / "spool.db").write_bytes(data)
    spool = DiskSpool(folder, 1 << 20)
    try:
        spool.take(10)
        spool.put([_FRAME])
        spool.done(3)
    finally:
        spool.close()


@cache
def _spool_bytes() -> bytes:
    folder = temporary_folder() / "genuine"
    spool = DiskSpool(folder, 1 << 20)
    spool.put([_FRAME] * 5)
    spool.close()
    return (folder / "spool.db").read_bytes()


def _reserve_file(path: Path) -> None:
    reserve = SpoolReserve(path, 1 << 12)
    try:
        reserve.take(10)
        reserve.put([_FRAME])
        reserve.done(len(reserve.take(10)))
    finally:
        reserve.close()


@cache
def _reserve_bytes() -> bytes:
    reserve = SpoolReserve(temporary_folder() / "reserve", 1 << 12)
    reserve.put([_FRAME] * 3)
    reserve.close()
    return (temporary_folder() / "reserve").read_bytes()[:1000]


_ITEMS = [Item("a.b.app", {"n": n}, _NOW + n, _NOW + n, "app", "i", n) for n in range(1, 4)]


@cache
def _archive() -> tuple[SqliteArchive, sqlite3.Connection]:
    path = temporary_folder() / "rows.db"
    archive = SqliteArchive(f"sqlite://{path}")
    archive.insert(_ITEMS)
    return archive, sqlite3.connect(path, isolation_level=None)


def _archive_row(data: bytes) -> list[Item]:
    """The first byte says whether the row calls itself a frame."""
    archive, connection = _archive()
    connection.execute("UPDATE frames SET format = ?, payload = ?", (data[0] & 1 if data else 0, data[1:]))
    return archive.find({"dataKey": "a.b.*", "value.n": {"$gte": 0}})


def _archive_file(data: bytes) -> None:
    path = temporary_folder() / "archive.db"
    for each in temporary_folder().glob("archive.db*"):
        each.unlink()
    path.write_bytes(data)
    archive = SqliteArchive(f"sqlite://{path}")
    try:
        archive.find({"dataKey": "a.b.*"}, limit=5)
        archive.insert(_ITEMS)
        archive.prune(before=_NOW + 2)
    finally:
        archive.close()


@cache
def _archive_bytes() -> bytes:
    path = temporary_folder() / "genuine.db"
    archive = SqliteArchive(f"sqlite://{path}")
    archive.insert(_ITEMS)
    archive.close()
    return path.read_bytes()


_TSV = f"{TSHARK_HEADER}\n{TSHARK_UDP}\n{TSHARK_UDP}\n".encode()
_FLOWS = tuple(text.encode("latin-1") for text in (ZEEK, BINETFLOW, CICFLOWMETER))
_TRUSTED = f"# mine\n{'ab' * 32} a program\n{'cd' * 32}\n".encode()

TARGETS = (
    DecoderTarget("capture", in_file("c", _capture), (CaptureError,), _both(tuple(CAPTURES.values()))),
    DecoderTarget("tshark table", in_file("t", _table), (TsvError,), _both((_TSV,)), mutate_text),
    DecoderTarget(
        "labels",
        in_file("l", read_labels),
        (LabelsError,),
        _both(tuple(text.encode() for text in LABELS.values())),
        mutate_text,
    ),
    DecoderTarget("flow table", in_file("f", _flows), (FlowTableError,), _both(_FLOWS), mutate_text),
    DecoderTarget("settings file", in_file("s", _settings), (InvalidOption,), _SETTINGS, mutate_json),
    DecoderTarget("sdnator.toml", in_file("sdnator.toml", _toml), (WrongConfiguration,), _TOML, mutate_text),
    DecoderTarget("trusted programs", in_file("p", read_trusted), (TrustError,), (_TRUSTED,), mutate_text),
    DecoderTarget("kitsune model", in_file("m", load_model), (ModelFileError,), (_model_bytes(),)),
    DecoderTarget("run file", _run_file, (BadInput,), (_run_bytes(),), mutate_json),
    DecoderTarget("spool row", _spool_row, (BackendError,), (_SPOOLED,)),
    DecoderTarget("spool reserve", in_file("reserve-in", _reserve_file), (), (_reserve_bytes(),)),
    DecoderTarget("spool file", _spool_file, (BackendError,), (_spool_bytes(),)),
    DecoderTarget(
        "archive row",
        _archive_row,
        (BackendError,),
        (b"\0" + encode_value({"n": 1}), *(b"\1" + frame for frame in FRAMES)),
    ),
    DecoderTarget("archive file", _archive_file, (BackendError,), (_archive_bytes(),)),
)
