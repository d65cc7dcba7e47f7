"""The reference pages, made from the code: `python -m sdnator.reference docs` writes them.

    the Typer application             ─► reference/cli.md, reference/sdnator.1
    sdnator.config.config_model, its Structs ─► reference/configuration.md
    INTERESTS, CAPABILITIES, messages ─► reference/keys.md, images/flow.svg
    the Coordinator's OpenAPI         ─► reference/http-api.md

A test compares the pages in `docs/` with what this generates.
"""

import inspect
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import msgspec

NOTE = "<!-- made by `python -m sdnator.reference docs`: change the code, not this page -->"


def pages() -> dict[str, str]:
    """Path below `docs/` to text, for every generated file."""
    from sdnator.man_page import man_page
    from sdnator.report.flow_picture import rows, svg

    return {
        "reference/cli.md": cli(),
        "reference/sdnator.1": man_page(),
        "reference/configuration.md": configuration(),
        "reference/keys.md": keys(),
        "reference/http-api.md": http_api(),
        "images/flow.svg": svg(rows()),
    }


def main(argv: list[str]) -> int:
    """Write all pages below the folder that is named."""
    if len(argv) != 1 or not Path(argv[0]).is_dir():
        print("usage: python -m sdnator.reference DOCS_FOLDER", file=sys.stderr)
        return 2
    for name, text in pages().items():
        path = Path(argv[0]) / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return 0


def table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A Markdown table; what stands in a cell is escaped."""
    names = list(heads)
    lines = [names, ["---"] * len(names), *([_cell(text) for text in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def _page(title: str, intro: str, body: Iterable[str]) -> str:
    return "\n".join([f"# {title}", "", NOTE, "", intro, "", *body]).rstrip() + "\n"


def _code(text: str) -> str:
    return f"`{text}`" if text else ""


# -- command line ------------------------------------------------------------------------------


def cli() -> str:
    """Every command with its arguments, options, defaults and text."""
    from sdnator.cli.main import app

    intro = (
        "Exit codes: 0 done, 1 a part of the pipeline failed or something is missing, 2 bad input or misuse, "
        "130 interrupted, 143 terminated. Commands whose output a program may read have `--json`."
    )
    return _page("Commands", intro, _commands(app, ("sdnator",)))


def _commands(app: Any, words: tuple[str, ...]) -> Iterator[str]:
    """Read from the declarations, not from Typer's result, which differs between its versions."""
    import typer

    found: dict[str, Any] = {
        one.name or _dashed(one.callback.__name__): one.callback for one in app.registered_commands
    }
    found |= {one.name: one.typer_instance for one in app.registered_groups}
    # commands that are imported on call have stand-ins until then
    for name, place in getattr(app.info.cls, "PLACES", {}).items():
        module, _, attribute = place.partition(":")
        found[name] = getattr(import_module(module), attribute)
    for name in sorted(found):
        own, one = (*words, name), found[name]
        if isinstance(one, typer.Typer):
            callback = one.registered_callback
            text = one.info.help if isinstance(one.info.help, str) else ""
            yield from _command(callback.callback if callback else None, own, text)
            yield from _commands(one, own)
        else:
            yield from _command(one, own)


def _command(callback: Callable[..., Any] | None, words: tuple[str, ...], text: str = "") -> Iterator[str]:
    yield from (f"{'#' * min(len(words), 4)} {' '.join(words)}", "")
    plain = inspect.getdoc(callback) if callback is not None else None
    yield re.sub(r"(?m)\n*^Example: (.*)$", r"\n\n```text\n\1\n```", (plain or text).strip())
    yield ""
    rows = list(_parameters(callback)) if callback is not None else []
    if rows:
        yield table(("option", "value", "default", "what it is"), rows)
        yield ""


def _parameters(callback: Callable[..., Any]) -> Iterator[tuple[str, str, str, str]]:
    from typer.models import ArgumentInfo, ParameterInfo

    hints = get_type_hints(callback, include_extras=True)
    for name, parameter in inspect.signature(callback).parameters.items():
        kind, *more = get_args(hints[name]) if hasattr(hints[name], "__metadata__") else (hints[name],)
        info = next((one for one in more if isinstance(one, ParameterInfo)), None)
        if info is None:
            continue
        if isinstance(info, ArgumentInfo):
            names, value = [name.upper()], ""
        else:
            # inside Annotated the first name stands where a default would
            first = [info.default] if isinstance(info.default, str) else []
            names = [*first, *(info.param_decls or ())] or _names_of(name, kind)
            value = "" if kind is bool else info.metavar or _value_of(kind)
        yield ", ".join(map(_code, names)), _code(value), _default(parameter), _help(info, kind)


def _names_of(name: str, kind: Any) -> list[str]:
    return [f"--{_dashed(name)}", *([f"--no-{_dashed(name)}"] if kind is bool else [])]


def _value_of(kind: Any) -> str:
    inner = [one for one in get_args(kind) or (kind,) if one is not type(None)]
    if len(inner) == 1 and inner[0] is not kind:
        return _value_of(inner[0])
    return type_name(kind).upper()


def _default(parameter: inspect.Parameter) -> str:
    if parameter.default is inspect.Parameter.empty:
        return "required"
    if isinstance(parameter.default, bool):
        return "on" if parameter.default else ""
    return "" if parameter.default in (None, "", ()) else _code(str(parameter.default))


def _help(info: Any, kind: Any) -> str:
    text = info.help or ""
    if info.envvar:
        text += f" Environment: {_code(str(info.envvar))}."
    several = any(get_origin(one) in (list, tuple) for one in (kind, *get_args(kind)))
    if several and "repeated" not in text:
        text += " May be repeated."
    return text


def _dashed(name: str) -> str:
    return name.replace("_", "-")


# -- configuration -----------------------------------------------------------------------------


def configuration() -> str:
    """Every option of `sdnator.toml` with its type, default and text."""
    from sdnator.config.config_model import PRODUCT_SECTIONS, default, fields

    intro = (
        "`sdnator.toml` has one section for each part. Options that are left out have the default below; an option "
        "is overridden by the environment variable `SDNATOR_<SECTION>_<OPTION>`. `sdnator config check` names "
        "every wrong option with its line."
    )
    lines: list[str] = []
    for section, declared in PRODUCT_SECTIONS.items():
        kind = declared.kind()
        lines += [f"## {section}", "", _first_line(kind), ""]
        rows = [
            row
            for name in fields(section)
            for row in _options(name, get_type_hints(kind)[name], kind, name, default(section, name))
        ]
        lines += [table(("option", "type", "default", "what it is"), rows), ""]
    return _page("Configuration", intro, lines)


def _options(
    shown: str, kind: Any, struct: Any, name: str, default: Any
) -> Iterator[tuple[str, str, str, str]]:
    from sdnator.config.config_texts import texts

    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        inner = get_type_hints(kind)
        for one in msgspec.structs.fields(kind):
            value = default.get(one.name) if isinstance(default, Mapping) else None
            yield from _options(f"{shown}.{one.name}", inner[one.name], kind, one.name, value)
        return
    value = "" if default is None else _toml(default)
    yield _code(shown), _code(type_name(kind)), _code(value), texts(struct).get(name, "")


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{name} = {_toml(one)}' for name, one in value.items())}}}"
    return str(value)


def type_name(kind: Any) -> str:
    """A type as text, without modules."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Literal:
        return " or ".join(f'"{one}"' if isinstance(one, str) else str(one) for one in inner)
    if origin in (Union, UnionType):
        return " or ".join(map(type_name, inner))
    if origin is not None:
        parts = ", ".join("…" if one is ... else type_name(one) for one in inner)
        return f"{origin.__name__}[{parts}]"
    return "nothing" if kind is type(None) else getattr(kind, "__name__", str(kind))


# -- keys and messages -------------------------------------------------------------------------


def keys() -> str:
    """Who writes and wants which key, and what the values hold."""
    from sdnator.report.flow_picture import ENFORCER_SERVICES, SERVICES

    lines: list[str] = []
    for name, module in {"coordinator": "coordinator.service", **SERVICES, **ENFORCER_SERVICES}.items():
        service = import_module(module)
        lines += [f"## {name}", "", "Can produce:", ""]
        made = ((_code(one.key), one.delivery, one.archive) for one in service.CAPABILITIES)
        lines += [table(("key", "delivery", "archived"), made), "", "Wants:", ""]
        lines += [f"- {_code(one.key)}{when}" for one, when in _interests(service)]
        lines.append("")
    times = (
        "Values of alerts, evidence, decisions, incidents, confirmations and commands are maps with these fields. Times are "
        "capture time, integer nanoseconds since the epoch (UTC)."
    )
    lines += ["## Packets", "", *_packets(), "## Messages", "", times, ""]
    base = import_module("apps.messages").Message
    for module in (
        "apps.messages",
        "apps.evidence",
        "apps.incidents",
        "apps.enforcement",
        "sdnator.rights.audited_deed",
    ):
        for kind in vars(import_module(module)).values():
            own = inspect.isclass(kind) and kind.__module__ == module
            if own and issubclass(kind, base) and kind is not base:
                lines += [f"### {kind.__name__}", "", _first_line(kind), "", _fields(kind), ""]
    return _page("Keys and messages", "![Data flow between the apps](../images/flow.svg)", lines)


def _interests(service: Any) -> Iterator[tuple[Any, str]]:
    for name, value in vars(service).items():
        if name == "INTERESTS" or name.endswith("_INTERESTS"):
            for one in value:
                yield one, "" if name == "INTERESTS" else " (where its settings ask for it)"


def _packets() -> Iterator[str]:
    packets = import_module("apps.packets")
    texts = dict(re.findall(r'^    "(\w+)": "\w+",(?:  # (.*))?$', inspect.getsource(packets), re.MULTILINE))
    yield "A record batch: one numpy array per column, all of the same length. -1 means absent, unless stated otherwise."
    yield ""
    rows = (
        (_code(name), _code(dtype), texts.get(name, "")) for name, dtype in packets.PACKET_COLUMNS.items()
    )
    yield table(("column", "dtype", "what it is"), rows)
    yield ""


def _fields(kind: Any) -> str:
    from sdnator.config.config_texts import texts

    own, hints = texts(kind), get_type_hints(kind)
    rows = (
        (
            _code(one.name),
            _code(type_name(hints[one.name])),
            "" if one.required else "optional",
            own.get(one.name, ""),
        )
        for one in msgspec.structs.fields(kind)
    )
    return table(("field", "type", "", "what it is"), rows)


def _first_line(kind: type[Any]) -> str:
    return (inspect.getdoc(kind) or "").split("\n\n")[0]


# -- HTTP --------------------------------------------------------------------------------------


def http_api() -> str:
    """The Coordinator's API: paths, parameters, answers."""
    from coordinator.openapi import document

    found = document()
    intro = (
        "Read-only, JSON, on loopback, with the token of `coordinator.token` in the state folder as "
        "`Authorization: Bearer …` (metrics need none, or the one in `metrics.token_file`); `sdnator status` names the "
        "address, `/openapi.json` is this page for programs. Requests under another host's name are refused."
    )
    lines = [found["info"]["description"], ""]
    for path, operations in found["paths"].items():
        operation = operations["get"]
        lines += [f"## GET {path}", "", f"{operation['summary']}.", ""]
        if operation["parameters"]:
            rows = (
                (_code(one["name"]), one["schema"]["type"], one["in"], one.get("description", ""))
                for one in operation["parameters"]
            )
            lines += [table(("parameter", "type", "in", "what it is"), rows), ""]
    lines += ["## Schemas", "", *_schemas(found["components"]["schemas"])]
    return _page("HTTP API of the Coordinator", intro, lines)


def _schemas(schemas: Mapping[str, Any]) -> Iterator[str]:
    for name, schema in schemas.items():
        if "properties" not in schema:
            continue
        rows = (
            (_code(part), _kind_of(one), one.get("description", ""))
            for part, one in schema["properties"].items()
        )
        yield from (f"### {name}", "", table(("field", "type", "what it is"), rows), "")


def _kind_of(schema: Mapping[str, Any]) -> str:
    found = str(schema.get("type") or schema.get("$ref") or "any").rpartition("/")[2]
    return f"{found} of {_kind_of(schema['items'])}" if "items" in schema else found


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
