"""The compiled switch program: its location, and whether it matches its source.

`python -m sdnator.p4_program compile` runs p4c (where it is installed) and writes the record that
`check` compares: the hashes of all sources and artefacts and the compiler's version.  Other programs
than the product's are named with their folder: `compile tests/dataplane/programs features`.

    P4ProgramError (RuntimeError)   artefacts missing, or not compiled from the present source
"""

import hashlib
import json
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

PROGRAM = "sdnator"


class P4ProgramError(RuntimeError):
    """The compiled program is missing or out of date; the text says what to do."""


@dataclass(frozen=True)
class P4Program:
    """Paths of the artefacts that p4c made."""

    bmv2_json: Path
    p4info: Path


def folder() -> Path:
    """The folder of the artefacts: inside the installed package, or `p4/` of the checkout."""
    here = Path(__file__).resolve().parent
    installed = here / "program"
    return installed if installed.is_dir() else here.parent / "p4"


def find() -> P4Program:
    """The compiled program; raises P4ProgramError if it is missing."""
    base = folder()
    program = P4Program(base / f"{PROGRAM}.json", base / f"{PROGRAM}.p4info.txtpb")
    for path in (program.bmv2_json, program.p4info):
        if not path.is_file():
            raise P4ProgramError(f"{path} is missing: reinstall, or run `make p4` in a checkout with p4c")
    return program


def _hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def hashes(base: Path, name: str = PROGRAM) -> dict[str, dict[str, str]]:
    """SHA-256 of every source and artefact in a program folder."""
    sources = sorted(base.rglob("*.p4"))
    artefacts = (base / f"{name}.json", base / f"{name}.p4info.txtpb")
    return {
        "sources": {str(path.relative_to(base)): _hash(path) for path in sources},
        "artefacts": {path.name: _hash(path) for path in artefacts},
    }


def _record(base: Path, name: str) -> Path:
    return base / f"{name}.build.json"


def check(base: Path, name: str = PROGRAM) -> None:
    """Raise P4ProgramError if the artefacts do not match the source."""
    record: dict[str, Any] = json.loads(_record(base, name).read_text(encoding="utf-8"))
    now = hashes(base, name)
    for part in ("sources", "artefacts"):
        changed = sorted(name for name, _ in set(record[part].items()) ^ set(now[part].items()))
        if changed:
            raise P4ProgramError(
                f"{', '.join(changed)} changed since p4c ran: run `{_again(base, name)}` and commit all of {base}"
            )


def _again(base: Path, name: str) -> str:
    return "make p4" if name == PROGRAM else f"python -m sdnator.p4_program compile {base} {name}"


def compile_program(base: Path, name: str = PROGRAM) -> None:
    """Run p4c on the source and write the artefacts and their record."""
    p4c = shutil.which("p4c-bm2-ss")
    if p4c is None:
        raise P4ProgramError(
            "p4c-bm2-ss is not installed: build p4c (github: p4lang/p4c) with its BMv2 back end"
        )
    command = [
        p4c, "--arch", "v1model", "--Werror",
        "--p4runtime-files", f"{name}.p4info.txtpb", "-o", f"{name}.json", f"{name}.p4",
    ]  # fmt: skip
    subprocess.run(command, cwd=base, check=True)
    _pack(base / f"{name}.json")
    answer = subprocess.run([p4c, "--version"], capture_output=True, text=True, check=True)
    words = (answer.stdout + answer.stderr).split()
    number = next(word for word in words if word[0].isdigit())
    record = {"p4c": number, "options": command[1:4], **hashes(base, name)}
    _record(base, name).write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


def _pack(path: Path) -> None:
    """Without p4c's indentation: gRPC servers take messages of 4 MB, simple_switch_grpc no others."""
    program = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps(program, separators=(",", ":")) + "\n", encoding="utf-8")


def main() -> int:
    """`compile` or `check` the program of this checkout, or another one."""
    what, *where = sys.argv[1:] or ("",)
    if what not in ("compile", "check") or len(where) not in (0, 2):
        print("usage: python -m sdnator.p4_program compile|check [FOLDER PROGRAM]", file=sys.stderr)
        return 2
    base, name = (Path(where[0]), where[1]) if where else (folder(), PROGRAM)
    try:
        (compile_program if what == "compile" else check)(base, name)
    except (P4ProgramError, OSError, subprocess.CalledProcessError) as error:
        print(f"sdnator: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
