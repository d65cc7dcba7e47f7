"""`sdnator program …`: programs that embedded switches of this user may compile and load."""

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from dataplane.p4runtime.trust import (
    TrustError,
    checked_hash,
    default_file,
    own_program,
    program_hash,
    read_program,
    read_trusted,
)
from sdnator.errors import BadInput

program = typer.Typer(help="Manage the programs that embedded switches may load.", no_args_is_help=True)

ListOption = Annotated[
    Path | None,
    typer.Option(
        "--list", help="List of trusted programs; default: $XDG_CONFIG_HOME/sdnator/trusted-programs."
    ),
]


@program.command("trust")
def trust(
    files: Annotated[
        list[Path], typer.Argument(help="p4c's BMv2 JSON, with NAME.p4info.txtpb beside it.", metavar="FILE…")
    ],
    *,
    place: ListOption = None,
) -> None:
    """Allow switches of this user to load programs; takes effect at once.

    Example: sdnator program trust build/router.json
    """
    file = _file(place)
    known = dict(_read(file))
    for each in files:
        known[_hash(each)] = str(each.resolve())
    _write(file, known)
    for each in files:
        typer.echo(f"{_hash(each)}  {each}")


@program.command("untrust")
def untrust(
    what: Annotated[list[str], typer.Argument(help="Hashes, or files as for `trust`.", metavar="WHAT…")],
    *,
    place: ListOption = None,
) -> None:
    """Remove programs from the list; a switch keeps a loaded one until it restarts.

    Example: sdnator program untrust build/router.json
    """
    file = _file(place)
    known = dict(_read(file))
    for each in what:
        found = _hash(Path(each)) if Path(each).is_file() else each
        if known.pop(found, None) is None:
            raise BadInput(f"{each} is not in {file}; `sdnator program list` shows what is")
    _write(file, known)


@program.command("list")
def list_programs(*, place: ListOption = None) -> None:
    """List the hashes of all programs that may be loaded, and their files.

    Example: sdnator program list
    """
    if own_program().is_file():
        typer.echo(f"{_hash(own_program())}  the product's own")
    for digest, comment in _read(_file(place)).items():
        typer.echo(f"{digest}  {comment}")


def _file(place: Path | None) -> Path:
    file = place or default_file()
    if file is None:
        raise BadInput("this user has no home folder: give the list of trusted programs with --list")
    return file


def _read(file: Path) -> Mapping[str, str]:
    try:
        return read_trusted(file)
    except TrustError as error:
        raise BadInput(str(error)) from None


def _hash(file: Path) -> str:
    try:
        return checked_hash(program_hash(read_program(file)), str(file))
    except TrustError as error:
        raise BadInput(str(error)) from None


def _write(file: Path, known: Mapping[str, str]) -> None:
    """Write atomically, readable by its owner only."""
    lines = [f"{digest}  {comment}\n" for digest, comment in known.items()]
    try:
        file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        with tempfile.NamedTemporaryFile("w", dir=file.parent, delete=False, encoding="utf-8") as made:
            made.writelines(lines)
        Path(made.name).replace(file)
    except OSError as error:
        raise BadInput(f"{file}: cannot be written ({error.strerror}); check its permissions") from None
