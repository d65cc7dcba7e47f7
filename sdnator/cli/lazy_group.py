"""Commands whose modules are imported when they are called: `sdnator --help` needs none of them."""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from typing import Any, ClassVar

import typer
from typer.core import TyperGroup
from typer.main import get_command, get_group

_INSIDE_A_PARAGRAPH = re.compile(r"(?<!\n)\n(?!\n|Exit codes: )")
EXIT_CODES = "Exit codes: 0 done, 1 failure, 2 bad input or misuse, 130 interrupted."


class LazyGroup(TyperGroup):
    """A group of which only names and first lines of help are known until a command is called.

    `PLACES` of a subclass: name to MODULE:NAME of a function, or of a `typer.Typer` of several commands.
    """

    PLACES: ClassVar[Mapping[str, str]] = {}
    _listing = False

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command itself; for a list of commands a stand-in with its help only."""
        if not self._listing and (place := self.PLACES.get(cmd_name)):
            return _loaded(cmd_name, place)
        command = super().get_command(ctx, cmd_name)
        if command is not None and not self._listing:
            _prepare(command)
        return command

    def get_params(self, ctx: Any) -> Any:
        """Show flags without a value type."""
        return _without_types(super().get_params(ctx))

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Without importing anything."""
        with self._lists():
            super().format_help(ctx, formatter)

    def shell_complete(self, ctx: Any, incomplete: str) -> Any:
        """Names of commands, without importing anything."""
        with self._lists():
            return super().shell_complete(ctx, incomplete)

    @contextmanager
    def _lists(self) -> Iterator[None]:
        self._listing = True
        try:
            yield
        finally:
            self._listing = False


def register(app: typer.Typer, name: str, text: str, group: str) -> None:
    """Make a command known; `text` is the first line of its help (a test compares them), `group` its place there."""

    def stands_in() -> None:
        """Never called: `LazyGroup.get_command` returns the real one."""

    app.command(name, help=text, rich_help_panel=group)(stands_in)


def _loaded(name: str, place: str) -> Any:
    module, _, attribute = place.partition(":")
    found = getattr(import_module(module), attribute)
    if isinstance(found, typer.Typer):
        command: Any = get_group(found)
    else:
        alone = typer.Typer(add_completion=False, context_settings={"help_option_names": ["-h", "--help"]})
        alone.command(name)(found)
        command = get_command(alone)
    command.name = name
    _tell_exit_codes(command)
    _prepare(command)
    return command


def _prepare(command: Any) -> None:
    _show_no_type_of_flags(command)
    _let_text_flow(command)


def _let_text_flow(command: Any) -> None:
    """Typer breaks lines of help where the docstring does, whatever the terminal's width."""
    command.help = _INSIDE_A_PARAGRAPH.sub(" ", command.help or "") or None
    for inner in getattr(command, "commands", {}).values():
        _let_text_flow(inner)


def _tell_exit_codes(command: Any) -> None:
    """Exit codes for commands that do not state their own."""
    if "Exit codes" not in (command.help or ""):
        command.epilog = EXIT_CODES
    for inner in getattr(command, "commands", {}).values():
        _tell_exit_codes(inner)


def _show_no_type_of_flags(command: Any) -> None:
    """Typer's help shows each flag as <bool>, as if it took a value; Typer makes `--help` anew each time."""
    if "get_params" not in vars(command):
        given = command.get_params
        command.get_params = lambda ctx: _without_types(given(ctx))
    for inner in getattr(command, "commands", {}).values():
        _show_no_type_of_flags(inner)


def _without_types(params: Any) -> Any:
    for param in params:
        if getattr(param, "is_flag", False) and param.metavar is None:
            param.metavar = ""
    return params
