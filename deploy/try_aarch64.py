"""Tries the wheel for aarch64 on this machine, under qemu: it finds in a capture what the wheel of this machine finds.

    Debian's packages for arm64, unpacked ─┐
                                           ├─► qemu-aarch64-static python3 ─► features, alerts ─┐
    wheel for aarch64 and what it needs ───┘                                  scores            ├─ the same
    wheel of this machine ──────────────────────────────────────────► features, alerts, scores ─┘

Nothing is installed on the machine, and no foreign program is run but by qemu's name.
"""

import csv
import os
import platform
import shutil
import subprocess
import sys
from functools import partial
from math import isclose
from pathlib import Path
from typing import Final

NEEDED: Final = ("qemu-aarch64-static", "mmdebstrap")
"""Programs of Debian's packages qemu-user-static and mmdebstrap."""
LIBRARIES: Final = ("python3", "libstdc++6", "zlib1g")
"""What the interpreter and the wheels' libraries come from."""
PLATFORM: Final = "aarch64-manylinux_2_36"
"""What uv calls Debian 12."""
WHERE: Final = "import platform; print(platform.machine(), platform.python_version())"
CAPTURE: Final = """
import sys
from sdnator.datasets.mirai_like import MiraiLikeOptions, make
make(MiraiLikeOptions(seed=2, benign_seconds=60, attack_seconds=20), sys.argv[1])
"""
SCORES: Final = """
import sys
from apps.kitsune.kernel import load_kernel
from apps.p4runtime_ctrl.southbound.digest_rows import load_digest_rows
from sdnator.cli.main import main
load_kernel()
assert load_digest_rows() is not None
capture, out = sys.argv[1:]
sys.argv[1:] = ["detect", capture, "--out", out, "--fm-grace", "200", "--ad-grace", "900"]
sys.argv += ["--features", f"{out}/features.npy"]
main()
"""
EQUAL: Final = ("features.npy", "alerts.csv")
"""Files of which every byte is the same."""
SCORES_FILE: Final = "scores.csv"
CLOSE: Final = 1e-12
"""Scores agree so far, relatively: in training the C library's `exp` is used, whose last bit depends on the processor."""


class TrialFailed(Exception):
    """The wheel does not do on aarch64 what it does here; the text says what."""


def missing() -> list[str]:
    """Programs without which nothing can be tried."""
    return [name for name in NEEDED if shutil.which(name) is None]


def _run(folder: Path, *command: str | Path, **environment: str) -> str:
    """What a command prints; `folder` must hold no package of ours, as Python looks there first."""
    words = [str(word) for word in command]
    done = subprocess.run(
        words, cwd=folder, env=os.environ | environment, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise TrialFailed(f"failed: {' '.join(words)}\n{done.stderr[-3000:]}")
    return done.stdout


def _release() -> str:
    """The name of this machine's Debian release."""
    return platform.freedesktop_os_release()["VERSION_CODENAME"]


def _foreign_root(folder: Path) -> Path:
    """Debian's Python for arm64, unpacked and not set up.  Returns its interpreter."""
    packages = ",".join(LIBRARIES)
    _run(
        folder.parent, "mmdebstrap", "--quiet", "--architectures=arm64", "--variant=extract", f"--include={packages}",
        _release(), folder,
    )  # fmt: skip
    (found,) = folder.glob("usr/bin/python3.[0-9]*[0-9]")
    return found


def _install(wheel: Path, version: str, folder: Path) -> None:
    """The wheel and all that this version of Python needs for it on such a machine, which pip would not ask for."""
    _run(
        folder.parent, sys.executable, "-m", "uv", "pip", "install", "--quiet", "--only-binary=:all:",
        f"--python={sys.executable}", f"--python-platform={PLATFORM}", f"--python-version={version}",
        f"--target={folder}", wheel,
    )  # fmt: skip


def try_aarch64(wheel: Path, here: Path, folder: Path) -> None:
    """Score one capture with both wheels.

    Args:
        wheel: for aarch64.
        here: the interpreter of an environment that holds the wheel of this machine.
        folder: for what is unpacked; must exist.

    Raises:
        TrialFailed: something does not run, or the scores differ.
    """
    root, site = folder / "root", folder / "site"
    foreign = ("qemu-aarch64-static", "-L", root, _foreign_root(root))
    machine, version = _run(folder, *foreign, "-c", WHERE).split()
    if machine != "aarch64":
        raise TrialFailed(f"{foreign[-1]} says that it runs on {machine}")
    _install(wheel, version, site)
    capture = folder / "house.pcap"
    _run(folder, here, "-c", CAPTURE, capture)
    _run(folder, here, "-c", SCORES, capture, folder / "here")
    _run(folder, *foreign, "-c", SCORES, capture, folder / "there", PYTHONPATH=str(site))
    _compare(folder / "here", folder / "there")


def _compare(here: Path, there: Path) -> None:
    for name in EQUAL:
        if (here / name).read_bytes() != (there / name).read_bytes():
            raise TrialFailed(f"{name} of aarch64 differs from that of this machine")
    ours, theirs = (_scores(place / SCORES_FILE) for place in (here, there))
    if len(ours) != len(theirs) or not all(map(partial(isclose, rel_tol=CLOSE), ours, theirs)):
        raise TrialFailed(f"{SCORES_FILE} of aarch64 differs from that of this machine by more than {CLOSE}")


def _scores(file: Path) -> list[float]:
    with file.open(newline="", encoding="utf-8") as opened:
        return [float(row["score"]) for row in csv.DictReader(opened)]
