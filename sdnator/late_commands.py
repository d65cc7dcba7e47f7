"""Commands whose modules are imported when they are called: `sdnator --help` needs none of them."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from typing import Any, ClassVar

import typer
from typer.core import TyperGroup
from typer.main import get_command, get_group

EXIT_CODES = "Exit codes: 0 done, 1 something did not work, 2 bad input or misuse, 130 interrupted."


class LateGroup(TyperGroup):
    """A group whose commands are known by name and first line of help until somebody asks for one.

    `PLACES` of a subclass: name to MODULE:NAME of a function, or of a `typer.Typer` of several commands.
    """

    PLACES: ClassVar[Mapping[str, str]] = {}
    _listing = False

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command itself; in a list of commands the one that knows only its help."""
        if not self._listing and (place := self.PLACES.get(cmd_name)):
            return _loaded(cmd_name, place)
        return super().get_command(ctx, cmd_name)

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


def register(app: typer.Typer, name: str, text: str) -> None:
    """Make a command known; `text` is the first line of its help (a test compares them)."""

    def stands_in() -> None:
        """Never called: `LateGroup.get_command` gives the real one."""

    app.command(name, help=text)(stands_in)


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
    return command


def _tell_exit_codes(command: Any) -> None:
    """What holds for all, where a command says nothing of its own."""
    if "Exit codes" not in (command.help or ""):
        command.epilog = EXIT_CODES
    for inner in getattr(command, "commands", {}).values():
        _tell_exit_codes(inner)
