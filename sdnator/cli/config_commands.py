"""`sdnator config …`: check a configuration, show the effective one, print an example with every option."""

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from sdnator.config import config_file
from sdnator.errors import BadInput
from sdnator.redaction import redacted

config = typer.Typer(
    help="Configuration: check it, show effective values, print an example.", no_args_is_help=True
)
_WIDTH = 100

FileArgument = Annotated[
    Path | None,
    typer.Argument(
        metavar="FILE",
        help="Default: ./sdnator.toml, else that in $XDG_CONFIG_HOME/sdnator.",
        show_default=False,
    ),
]
Json = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]


@config.command("check")
def check(file: FileArgument = None, *, as_json: Json = False) -> None:
    """Check a configuration and the SDNATOR_… variables, and report every error.

    Exit codes: 0 no errors, 2 there are errors, or there is no such file.

    Example: sdnator config check sdnator.toml
    """
    path = file or config_file.find()
    faults: tuple[config_file.Fault, ...] = ()
    try:
        config_file.load(path)
    except config_file.WrongConfiguration as error:
        faults = error.faults
    if as_json:
        shown = [asdict(fault) for fault in faults]
        print(json.dumps({"well": not faults, "file": str(path) if path else None, "faults": shown}))
    else:
        for fault in faults:
            print(fault)
        if not faults:
            print(
                f"{path}: nothing is wrong" if path else "there is no file: all options have their defaults"
            )
    raise typer.Exit(BadInput.exit_code if faults else 0)


@config.command("show")
def show(file: FileArgument = None, *, as_json: Json = False) -> None:
    """Show every option with its effective value and its source.  Passwords in URLs are left out.

    Exit codes: 0 shown, 2 the configuration is wrong.

    Example: sdnator config show --json
    """
    found = config_file.load(file or config_file.find())
    rows = list(_holding(found))
    if as_json:
        print(json.dumps({path: {"value": value, "source": source} for path, value, source in rows}))
        return
    for path, value, source in rows:
        print(f"{path} = {toml(value)}" + (f"    # {source}" if source else ""))


def _holding(found: config_file.Config) -> Iterator[tuple[str, Any, str]]:
    from sdnator.config.config_model import LISTS, SWITCHES, fields, sections

    for section in sections():
        if section in LISTS:
            for number, each in enumerate(found.switches() if section == SWITCHES else found.grants()):
                for option in fields(section):
                    source = found.sources.get((section, number, option), "")
                    yield f"{section}[{number}].{option}", _plain(getattr(each, option)), source
            continue
        struct = found.struct(section)
        for path, _ in config_file.option_paths():
            if path[0] == section:
                value: Any = struct
                for step in path[1:]:
                    value = getattr(value, step)
                yield ".".join(path), _plain(value), found.sources.get(path, "")


def _plain(value: Any) -> Any:
    import msgspec

    plain = msgspec.to_builtins(value)
    return redacted(plain) if isinstance(plain, str) else plain


@config.command("example")
def example() -> None:
    """Print a configuration with every option, its description and its default, all commented out.

    Exit codes: 0 printed.

    Example: sdnator config example > sdnator.toml
    """
    print("\n".join(example_lines()))


def example_lines() -> Iterator[str]:
    """A file with all options at their defaults, commented out."""
    from sdnator.config.config_model import LISTS, SCHEMA, default, fields, sections
    from sdnator.config.config_texts import texts

    yield "# Configuration of sdnator.  Options that are commented out show their default."
    yield "# Each option can be overridden by an environment variable: SDNATOR_<SECTION>_<OPTION>."
    yield f"schema = {SCHEMA}"
    for section, declared in sections().items():
        struct = declared.kind()
        yield ""
        yield from wrapped(" ".join((struct.__doc__ or "").split()))
        yield f"# [[{section}]]" if section in LISTS else f"[{section}]"
        for name, field in fields(section).items():
            yield from _option_lines(name, field.type, default(section, name), texts(struct).get(name, ""))


def _option_lines(name: str, kind: Any, value: Any, text: str) -> Iterator[str]:
    import msgspec

    from sdnator.config.config_model import plain_default
    from sdnator.config.config_texts import texts

    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        inner = texts(kind)
        for field in msgspec.structs.fields(kind):
            given = value.get(field.name, plain_default(field)) if isinstance(value, dict) else None
            yield from _option_lines(f"{name}.{field.name}", field.type, given, inner.get(field.name, ""))
        return
    yield from wrapped(text)
    yield f"# {name} = {toml(value)}"


def wrapped(text: str) -> Iterator[str]:
    """A text as comment lines."""
    import textwrap

    for line in textwrap.wrap(text, _WIDTH):
        yield f"# {line}"


def toml(value: Any) -> str:
    """A plain value as TOML writes it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{json.dumps(str(name))} = {toml(each)}' for name, each in value.items())}}}"
    return json.dumps("" if value is None else str(value), ensure_ascii=False)
