"""`sdnator.toml` and the SDNATOR_… variables: found, read, checked; each fault with its line and a remedy."""

import difflib
import json
import os
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_origin, get_type_hints

import msgspec

from sdnator.config import config_lines
from sdnator.config.config_lines import lines_of
from sdnator.errors import BadInput
from sdnator.user_folders import user_folder

NAME = "sdnator.toml"
PREFIX = "SDNATOR_"
MAX_BYTES = 1 << 18
"""The largest file that is read."""
_SHOWN = 80
"""Characters of a wrong value that are shown."""
_WANTED = {
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "bool_type": "true or false",
    "string_type": "a text in quotes",
    "tuple_type": "a list in [ ]",
    "list_type": "tables, each under its own [[…]]",
    "dict_type": "a table",
    "model_type": "a table",
    "model_attributes_type": "a table",
}


@dataclass(frozen=True)
class Fault:
    """One error: place, cause and remedy."""

    place: str
    """FILE:LINE, or the environment variable."""
    option: str
    text: str

    def __str__(self) -> str:
        return f"{self.place}: {self.option}: {self.text}" if self.option else f"{self.place}: {self.text}"


class WrongConfiguration(BadInput):
    """A configuration that cannot be used; `faults` has all errors."""

    def __init__(self, faults: Iterable[Fault]) -> None:
        self.faults = tuple(faults)
        super().__init__("\n".join(map(str, self.faults)))


@dataclass(frozen=True)
class Config:
    """Options from file and environment; the others have their defaults."""

    file: Path | None = None
    given: Mapping[str, Any] = field(default_factory=dict)
    """Section to options, as plain values; of switches and grants a list."""
    sources: Mapping[tuple[str | int, ...], str] = field(default_factory=dict)
    """Path of a given option to where it was given."""

    def section(self, name: str) -> dict[str, Any]:
        """The options of a part that differ from its own defaults, for its settings file."""
        from sdnator.config.config_model import sections

        return {**(sections()[name].defaults or {}), **self.given.get(name, {})}

    def struct(self, name: str, values: Mapping[str, Any] | None = None) -> Any:
        """The Settings of a part, with what the pipeline sets itself left at a stand-in."""
        from sdnator.config.config_model import sections

        section = sections()[name]
        chosen = self.section(name) if values is None else values
        return msgspec.convert({**(section.hidden or {}), **chosen}, section.kind())

    def grants(self) -> list[Any]:
        """Rights of apps, as far as the file names them."""
        return [self.struct("grants", each) for each in self.given.get("grants") or []]

    def switches(self) -> list[Any]:
        """The switches; one embedded one if none is given."""
        return [self.struct("switches", each) for each in self.given.get("switches") or [{}]]


def find() -> Path | None:
    """The default file: ./sdnator.toml, else the one in the user's configuration folder."""
    for path in (Path(NAME), configuration_folder() / NAME):
        if path.is_file():
            return path.absolute()
    return None


def configuration_folder() -> Path:
    """The folder of the user's configuration."""
    return user_folder("XDG_CONFIG_HOME", ".config")


def load(path: Path | None, environment: Mapping[str, str] | None = None) -> Config:
    """Read and check; `path` None: environment only.  Raises WrongConfiguration naming every fault."""
    variables = os.environ if environment is None else environment
    text = _read(path) if path is not None else ""
    if not text.strip() and not any(name.startswith(PREFIX) for name in variables):
        return Config(path)  # building the model takes half a second
    given, lines = _parsed(text, path)
    sources: dict[tuple[str | int, ...], str] = {key: f"{path}:{line}" for key, line in lines.items()}
    faults = list(_overridden(given, variables, sources))

    def place(at: config_lines.Path) -> str:
        return next((sources[at[:end]] for end in range(len(at), 0, -1) if at[:end] in sources), f"{path}:1")

    faults += _faults(given, place)
    if faults:
        raise WrongConfiguration(sorted(faults, key=_order))
    return Config(path, given, sources)


def _order(fault: Fault) -> tuple[str, int]:
    place, _, line = fault.place.rpartition(":")
    return (place, int(line)) if line.isdigit() else (fault.place, 0)


def _read(path: Path) -> str:
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
        text = content.decode("utf-8")
    except OSError as error:
        said = f"{error.strerror}; `sdnator config example` prints a file to begin with"
        raise WrongConfiguration([Fault(str(path), "", said)]) from None
    except UnicodeDecodeError:
        raise WrongConfiguration([Fault(str(path), "", "this is not UTF-8 text")]) from None
    if len(content) > MAX_BYTES:
        said = f"larger than {MAX_BYTES:,} bytes; this is not a configuration of sdnator"
        raise WrongConfiguration([Fault(str(path), "", said)])
    return text.replace("\r\n", "\n")


def _parsed(text: str, path: Path | None) -> tuple[dict[str, Any], dict[config_lines.Path, int]]:
    try:
        given = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        what, _, where = str(error).partition(" (at line ")
        line = where.partition(",")[0]
        raise WrongConfiguration(
            [Fault(f"{path}:{line if line.isdigit() else 1}", "", f"this is not TOML: {what}")]
        ) from None
    except (RecursionError, ValueError) as error:
        what = (
            "it is nested too deeply" if isinstance(error, RecursionError) else "a number has too many digits"
        )
        raise WrongConfiguration([Fault(f"{path}:1", "", f"this is not TOML: {what}")]) from None
    return given, lines_of(text)


def _faults(given: Mapping[str, Any], place: Callable[[config_lines.Path], str]) -> Iterator[Fault]:
    from pydantic import ValidationError

    from sdnator.config.config_model import SCHEMA, model

    version = given.get("schema", SCHEMA)
    if version != SCHEMA:
        text = f"{version!r} is not supported; this version reads {SCHEMA}: see CHANGELOG for what changed"
        yield Fault(place(("schema",)), "schema", text)
        return
    document = {name: value for name, value in given.items() if name != "schema"}
    try:
        # in JSON a list may be a tuple, and still a text is no number
        model().model_validate_json(json.dumps(document, default=str))
    except ValidationError as error:
        found = error.errors(include_url=False)
        yield from (_fault(one, place) for one in found)
        wrong = {one["loc"][0] for one in found}
        document = {name: value for name, value in document.items() if name not in wrong}
        if "p4runtime_ctrl" in wrong:  # how a switch may be reached depends on it
            document.pop("switches", None)
    yield from _own_faults(document, place)


def _fault(error: Any, place: Callable[[config_lines.Path], str]) -> Fault:
    at: config_lines.Path = tuple(error["loc"])
    option = _dotted(at)
    if error["type"] == "extra_forbidden":
        kind = "section" if len(at) == 1 else "option"
        return Fault(place(at), option, f"there is no such {kind}{_meant(at)}")
    got = json.dumps(error["input"], default=str)
    if len(got) > _SHOWN:
        got = f"{got[:_SHOWN]}…"
    if error["type"] == "literal_error":
        return Fault(place(at), option, f"{got} is none of {error['ctx']['expected']}")
    wanted = _WANTED.get(error["type"])
    return Fault(place(at), option, f"{got}: give {wanted}" if wanted else f"{got}: {error['msg']}")


def _dotted(at: config_lines.Path) -> str:
    return "".join(f"[{one}]" if isinstance(one, int) else f".{one}" for one in at).lstrip(".")


def _meant(at: config_lines.Path) -> str:
    """The most similar name, and other sections that have the name."""
    names = list(_names_at(at[:-1]))
    near = difflib.get_close_matches(str(at[-1]), names, n=1)
    if near:
        return f"; did you mean {near[0]}?"
    elsewhere = [_dotted(path) for path, _ in option_paths() if path[-1] == at[-1]]
    if elsewhere:
        return f"; it belongs to {', '.join(elsewhere)}"
    return f"; there are {', '.join(names)}" if len(names) <= 12 else "; see `sdnator config example`"


def _names_at(at: config_lines.Path) -> Iterator[str]:
    from sdnator.config.config_model import fields, sections

    steps = [one for one in at if isinstance(one, str)]
    if not steps:
        yield from sections()
        return
    known = fields(steps[0])
    for step in steps[1:]:
        kind = known[step].type if step in known else None
        if not (isinstance(kind, type) and issubclass(kind, msgspec.Struct)):
            return
        known = {one.name: one for one in msgspec.structs.fields(kind)}
    yield from known


def option_paths() -> Iterator[tuple[tuple[str, ...], Any]]:
    """Path and type of every option of the file, those of nested tables one by one."""
    from sdnator.config.config_model import fields, sections

    for section, declared in sections().items():
        kinds = get_type_hints(declared.kind())
        for option in fields(section):
            yield from _paths((section, option), kinds[option])


def _paths(path: tuple[str, ...], kind: Any) -> Iterator[tuple[tuple[str, ...], Any]]:
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        for name, inner in get_type_hints(kind).items():
            yield from _paths((*path, name), inner)
    else:
        yield path, kind


def variable(path: tuple[str, ...]) -> str:
    """The environment variable that overrides an option."""
    return PREFIX + "_".join(path).upper()


def _overridden(
    given: dict[str, Any], environment: Mapping[str, str], sources: dict[tuple[str | int, ...], str]
) -> Iterator[Fault]:
    """Override the file's values by the variables; yields variables that name no option."""
    from sdnator.config.config_model import LISTS, sections

    known = {variable(path): (path, kind) for path, kind in option_paths() if path[0] not in LISTS}
    own = {f"{PREFIX}{section.upper()}_" for section in sections() if section not in LISTS}
    for name in sorted(environment):
        if name in known:
            path, kind = known[name]
            _put(given, path, _typed(environment[name], kind))
            sources[path] = f"${name}"
        elif any(name.startswith(prefix) for prefix in own) and name not in OTHER_VARIABLES:
            near = difflib.get_close_matches(name, known, n=1)
            yield Fault(
                f"${name}", "", "there is no such option" + (f"; did you mean {near[0]}?" if near else "")
            )


OTHER_VARIABLES = {"SDNATOR_DASHBOARD_TOKEN"}
"""Variables that look like options but are not: secrets belong in no file."""


def _put(given: dict[str, Any], path: tuple[str, ...], value: Any) -> None:
    table: Any = given
    for step in path[:-1]:
        table = table.setdefault(step, {})
        if not isinstance(table, dict):
            return  # the file is wrong there, which is reported
    table[path[-1]] = value


def _typed(text: str, kind: Any) -> Any:
    """A variable's text as TOML would have it; bare texts need no quotes, lists no brackets."""
    if kind is str:
        return text
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        if get_origin(kind) is tuple:
            return [one.strip() for one in text.split(",") if one.strip()]
        return text


def _own_faults(given: Mapping[str, Any], place: Callable[[config_lines.Path], str]) -> Iterator[Fault]:
    """Errors that the parts find in values of the right type."""
    from sdnator.config.config_model import LISTS

    config = Config(None, given)
    for name in given:
        parts = enumerate(given[name]) if name in LISTS else [(None, None)]
        for number, values in parts:
            at: config_lines.Path = (name,) if number is None else (name, number)
            try:
                made = config.struct(name, values)
            except msgspec.ValidationError as error:
                yield _struct_fault(at, str(error), place)
                continue
            for option, text in _meaning_faults(name, made):
                yield Fault(place((*at, *option)), _dotted((*at, *option)), text)
    yield from _switch_faults(config, place)


def _struct_fault(at: config_lines.Path, text: str, place: Callable[[config_lines.Path], str]) -> Fault:
    words, _, inside = text.partition(" - at `$")
    inner = tuple(one for one in inside.rstrip("`").split(".") if one)
    option = words.partition("=")[0].partition(" ")[0]
    path = (*at, *inner, option) if option in _names_at((*at, *inner)) else (*at, *inner)
    return Fault(place(path), _dotted(path), words)


def _meaning_faults(name: str, made: Any) -> Iterator[tuple[tuple[str, ...], str]]:
    """Errors that a part would only find when it starts."""
    if name != "firewall":
        return
    from apps.firewall.policy.rules import AllowList
    from apps.firewall.syn.services import TcpService

    checks: tuple[tuple[tuple[str, ...], Callable[[], object]], ...] = (
        (("rules", "allow"), lambda: AllowList.parse(made.rules.allow)),
        (("guard",), lambda: [TcpService.parse(text) for text in made.guard]),
    )
    for option, check in checks:
        try:
            check()
        except ValueError as error:
            yield option, str(error)


def _switch_faults(config: Config, place: Callable[[config_lines.Path], str]) -> Iterator[Fault]:
    from sdnator.config.planned_switches import planned
    from sdnator.config.switch_security import check_security

    names: set[str] = set()
    for number, each in enumerate(config.given.get("switches") or ()):
        at = ("switches", number)
        try:
            made = config.struct("switches", each)
            check_security(planned(made, look=False), config.section("p4runtime_ctrl"))
        except msgspec.ValidationError:
            continue  # reported already
        except BadInput as error:
            yield Fault(place(at), _dotted(at), str(error))
            continue
        if made.name in names:
            yield Fault(
                place((*at, "name")), _dotted((*at, "name")), f"there are two switches named {made.name}"
            )
        names.add(made.name)
