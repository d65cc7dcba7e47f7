"""Which programs this switch compiles: the product's own, and those that its operator has named.

    SetForwardingPipelineConfig ──► TrustedPrograms.check ──► program.py, compilers
                                       │ sha256 of BMv2 JSON and p4info
                                       └ the product's own, --trust, or a line of the operator's file

A compiled program runs with the switch's rights, so a client that merely reaches the P4Runtime port must not choose it.

DataplaneError
└── TrustError      the operator's file cannot be used
"""

import hashlib
import os
import stat
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from google.protobuf import text_format

from dataplane.errors import DataplaneError
from dataplane.p4runtime.status import Denied
from p4rt import p4runtime

_DIGITS = 64
_MAX_FILE = 1 << 20
_MAX_PART = 64 << 20
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


class TrustError(DataplaneError):
    """The list of trusted programs cannot be read, or others than its owner could have written it."""


def program_hash(config: Any) -> str:
    """SHA-256 of a ForwardingPipelineConfig's program: of the BMv2 JSON's bytes and the p4info's fields."""
    parts = (config.p4_device_config, config.p4info.SerializeToString(deterministic=True))
    return hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in parts)).hexdigest()


def read_program(bmv2_json: Path, p4info: Path | None = None) -> Any:
    """A ForwardingPipelineConfig from the files that p4c wrote.

    p4info: in protobuf text format; default: NAME.p4info.txtpb beside NAME.json

    Raises TrustError.
    """
    config = p4runtime.ForwardingPipelineConfig()
    described = p4info or bmv2_json.with_suffix(".p4info.txtpb")
    try:
        for path in (bmv2_json, described):
            if path.stat().st_size > _MAX_PART:
                raise TrustError(f"{path} is too large for a program")
        config.p4_device_config = bmv2_json.read_bytes()
        text_format.Parse(described.read_text(encoding="utf-8"), config.p4info)
    except (OSError, ValueError, text_format.ParseError) as error:
        # ValueError: it is not UTF-8, or a number is one that its field cannot hold
        if isinstance(error, FileNotFoundError):
            raise TrustError(
                f"{error.filename}: no such file; p4c writes a BMv2 JSON and its p4info"
            ) from None
        cause = error.strerror if isinstance(error, OSError) else error
        raise TrustError(
            f"{bmv2_json} with {described}: {cause}; give the BMv2 JSON that p4c wrote, its p4info beside it"
        ) from error
    return config


def own_program() -> Path:
    """The product's BMv2 JSON: in a wheel data of the package `sdnator`, in a checkout in `p4/`."""
    root = Path(__file__).resolve().parents[2]
    installed = root / "sdnator" / "program"
    return (installed if installed.is_dir() else root / "p4") / "sdnator.json"


def default_file() -> Path | None:
    """$XDG_CONFIG_HOME/sdnator/trusted-programs, or under ~/.config; None without a home."""
    base = os.environ.get("XDG_CONFIG_HOME")
    try:
        return Path(base or Path.home() / ".config") / "sdnator" / "trusted-programs"
    except RuntimeError:
        return None


def read_trusted(file: Path) -> Mapping[str, str]:
    """Hash to comment of every line; empty where there is no such file.

    Raises TrustError where it is no such list, or others than its owner (we, or root) could have written it.
    """
    try:
        _check_owner(file.parent, file.parent.stat())
        with file.open("rb") as opened:
            _check_owner(file, os.fstat(opened.fileno()))
            text = opened.read(_MAX_FILE + 1)
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise TrustError(f"{file}: cannot be read: {error.strerror}") from error
    if len(text) > _MAX_FILE:
        raise TrustError(f"{file} is longer than {_MAX_FILE} bytes")
    found = {}
    for number, line in enumerate(text.decode("utf-8", "replace").splitlines(), 1):
        words = line.split(maxsplit=1)
        if words and not words[0].startswith("#"):
            found[checked_hash(words[0], f"{file}:{number}")] = words[1] if len(words) > 1 else ""
    return found


def checked_hash(text: str, where: str) -> str:
    """A SHA-256 in hexadecimal digits.  Raises TrustError."""
    if len(text) != _DIGITS or not all(digit in "0123456789abcdef" for digit in text):
        raise TrustError(f"{where}: {text[:80]!r} is not a SHA-256 of {_DIGITS} hexadecimal digits")
    return text


def _check_owner(path: Path, status: os.stat_result) -> None:
    if status.st_uid not in (0, os.geteuid()) or status.st_mode & _OTHERS_WRITE:
        raise TrustError(
            f"{path} could be written by others: make it yours and run `chmod go-w {path}`, or remove it"
        )


class TrustedPrograms:
    """The programs that may be compiled and loaded.

    hashes: beside the product's own
    file: the operator's list, read for every program, so that it holds at once; None = no such list
    """

    def __init__(self, hashes: Iterable[str] = (), file: Path | None = None) -> None:
        self._hashes = {checked_hash(each, "--trust") for each in hashes}
        self._file = file
        self._own: str | None = None

    def check(self, config: Any) -> None:
        """Raises Denied, whose text has the hash and what to do."""
        found = program_hash(config)
        if found in self._hashes or found == self._own_hash():
            return
        try:
            if self._file is not None and found in read_trusted(self._file):
                return
        except TrustError as error:
            raise Denied(f"the program with SHA-256 {found} is not trusted here: {error}") from error
        raise Denied(
            f"the program with SHA-256 {found} is not trusted here, so it is not compiled: run "
            "`sdnator program trust PROGRAM.json` as the user of the switch, or start the switch with "
            f"--trust {found}"
        )

    def _own_hash(self) -> str:
        if self._own is None:
            self._own = program_hash(read_program(own_program())) if own_program().is_file() else ""
        return self._own


class AnyProgram(TrustedPrograms):
    """For tests, and switches within a process that makes the programs itself."""

    def check(self, config: Any) -> None:
        """Every program may be loaded."""
