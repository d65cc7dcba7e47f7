"""The man page of the command line, from its declarations: `sdnator.reference` writes it to docs/reference/sdnator.1."""

import re
from collections.abc import Iterator

_FILES = (
    ("sdnator.toml", "Configuration; `sdnator config example` prints every option with its default."),
    (
        "$XDG_STATE_HOME/sdnator",
        "Logs, state of the running pipeline, the token of the dashboard, the kept model.",
    ),
    ("$XDG_DATA_HOME/sdnator", "The embedded archive and fetched data sets."),
)


def man_page() -> str:
    """Section 1, in the macros of man(7)."""
    return "\n".join(_lines()) + "\n"


def _lines() -> Iterator[str]:
    from sdnator.cli.main import COMMANDS, GROUPS

    yield '.\\" made by `python -m sdnator.reference docs`: change the code, not this page'
    yield '.TH SDNATOR 1 "" "SDNator" "User commands"'
    yield from (
        ".SH NAME",
        "sdnator \\- a network security pipeline of P4 switches, Kitsune, Sonata queries and a firewall",
    )
    yield from (".SH SYNOPSIS", ".B sdnator", ".I COMMAND", "[ARGUMENTS] [OPTIONS]")
    yield ".SH DESCRIPTION"
    yield _text("Each command shows its arguments and options with `--help`.")
    texts = {name: text for name, (_, text) in COMMANDS.items()}
    texts["replay"] = "Replay a capture through switch, controller, Kitsune, Sonata adapter and firewall."
    shown = {name for names in GROUPS.values() for name in names}
    others = tuple(name for name in texts if name not in shown and name != "replay")
    for group, names in GROUPS.items():
        more = {"Run": ("replay",), "Maintain": others}.get(group, ())
        yield f'.SH "{group.upper()}"'
        for name in (*names, *more):
            yield from (".TP", f".B sdnator {name}", _text(texts[name]))
    yield ".SH FILES"
    for name, text in _FILES:
        yield from (".TP", f".I {name}", _text(text))
    yield ".SH EXIT STATUS"
    yield _text(
        "0: done. 1: a part of the pipeline failed or something is missing. 2: bad input or misuse. "
        "130: interrupted. 143: terminated."
    )


def _text(text: str) -> str:
    """Plain text for roff: no line begins with a control character, words in backquotes are bold."""
    escaped = text.replace("\\", "\\e").replace("-", "\\-")
    bold = re.sub(r"`([^`]*)`", r"\\fB\1\\fR", escaped)
    return f"\\&{bold}" if bold[:1] in (".", "'") else bold
