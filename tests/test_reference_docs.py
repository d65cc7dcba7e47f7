"""The generated pages are those that the code makes now, and the documentation builds without a warning."""

import importlib.util
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Annotated
from xml.etree import ElementTree as ET

import pytest
import typer
from typer.testing import CliRunner

from sdnator import reference
from sdnator.cli.main import app
from sdnator.report.flow_picture import Row, rows, svg

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
MAKE = "run `python -m sdnator.reference docs` and commit what it writes"
LOADED_BY_A_PAGE = re.compile(r"""<(?:script|img|link|iframe|source)\b[^>]*?(?:src|href)=["']?([^"' >]+)""")


@pytest.fixture(scope="module")
def made():
    """All generated files, as the code makes them now."""
    return reference.pages()


@pytest.mark.parametrize(
    "name",
    [
        "reference/cli.md",
        "reference/sdnator.1",
        "reference/configuration.md",
        "reference/keys.md",
        "reference/http-api.md",
        "images/flow.svg",
    ],
)
def test_generated_pages_are_current(made, name):
    """What stands in docs/ is what the generator makes."""
    assert (DOCS / name).read_text(encoding="utf-8") == made[name], f"docs/{name} is old: {MAKE}"


def test_every_generated_page_is_compared(made):
    """The list above is whole, and the command writes exactly these files."""
    marks = test_generated_pages_are_current.pytestmark[0].args[1]
    assert set(marks) == set(made)


def test_command_writes_below_the_folder(made, tmp_path):
    """`python -m sdnator.reference FOLDER` writes all pages; anything else is misuse."""
    assert reference.main([str(tmp_path)]) == 0
    written = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert written == set(made)
    assert reference.main([]) == 2


def test_commands_are_read_as_people_type_them():
    """Arguments, flags, repeated options and groups come out under their names on the command line."""
    app, inner = typer.Typer(), typer.Typer(help="Things.")
    app.add_typer(inner, name="thing")

    @inner.command("make-one")
    def make_one(
        name: Annotated[str, typer.Argument(help="Its name.")],
        *,
        also: Annotated[list[str] | None, typer.Option(help="Others.")] = None,
        as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
        size: Annotated[int, typer.Option(metavar="N", help="a|b", envvar="SIZE")] = 3,
    ) -> None:
        """Make one.

        Example: thing make-one x
        """

    text = "\n".join(reference._commands(app, ("tool",)))
    assert "### tool thing make-one" in text
    assert "```text\nthing make-one x\n```" in text
    assert "| `NAME` |  | required | Its name. |" in text
    assert "| `--also` | `STR` |  | Others. May be repeated. |" in text
    assert "| `--json` |  |  | For programs. |" in text
    assert "| `--size` | `N` | `3` | a\\|b Environment: `SIZE`. |" in text


def every_command():
    """Words of each command that does something, groups walked through."""
    headings = re.findall(r"^#{2,4} sdnator (.+)$", reference.cli(), re.MULTILINE)
    return [one.split() for one in headings if not any(other.startswith(f"{one} ") for other in headings)]


@pytest.mark.parametrize("words", [*every_command(), ["demo"]], ids=" ".join)
def test_help_of_every_command_has_an_example(words):
    """As people type it."""
    done = CliRunner().invoke(app, [*words, "--help"], env={"COLUMNS": "200"})
    assert done.exit_code == 0
    assert f"Example: sdnator {' '.join(words)}" in done.stdout


def test_flow_picture_draws_who_writes_and_who_receives():
    """A row has one writer, an arrow for each reader, and a thick line where it is reliable."""
    row = Row("a.b:window=*", "kitsune", ("firewall", "p4runtime_ctrl"), reliable=True)
    picture = svg([row])
    tree = ET.fromstring(picture)  # noqa: S314 - made two lines above
    texts = [node.text for node in tree.iter("{http://www.w3.org/2000/svg}text")]
    assert "a.b:…" in texts
    arrows = len(list(tree.iter("{http://www.w3.org/2000/svg}path")))
    assert arrows == 2 + 1  # and one of the legend
    assert 'stroke-width="3"' in picture


def test_flow_picture_knows_the_loop():
    """The way from packets to blocks is in the picture."""
    found = {(row.producer, row.key): row.consumers for row in rows()}
    assert "kitsune" in found["p4runtime_ctrl", "network.packets.p4runtime_ctrl.*.*"]
    assert "firewall" in found["kitsune", "network.anomaly.kitsune.alert"]
    assert "p4runtime_ctrl" in found["firewall", "network.block.firewall.mac"]


def commands_in_examples():
    """(document, command) for every `sdnator` line of a `console` block and every example of a help text."""
    for path in sorted(DOCS.rglob("*.md")):
        for kind, block in re.findall(
            r"```(console|text)\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL
        ):
            start = r"[$#] (?:sudo )?(?:\.venv/bin/)?" if kind == "console" else ""
            for words in re.findall(rf"^{start}sdnator ([a-z].*)$", block, re.MULTILINE):
                yield str(path.relative_to(DOCS)), words.split("#")[0].strip()


@pytest.mark.parametrize(("document", "command"), sorted(set(commands_in_examples())))
def test_commands_that_no_test_runs_exist_at_least(made, document, command):
    """Shown commands that need a running pipeline or root: the command and each of its options are known."""
    options: dict[str, set[str]] = {}
    name = ""
    for line in made["reference/cli.md"].splitlines():
        if line.startswith("#"):
            name = line.lstrip("# ")
            options[name] = set()
        elif line.startswith("| `-"):
            options[name] |= set(re.findall(r"`(-[-a-z0-9]+)`", line.split("|")[1]))
    words = shlex.split(command)
    ends = [end for end in range(len(words), 0, -1) if f"sdnator {' '.join(words[:end])}" in options]
    assert ends, f"{document}: there is no such command"
    known = options[f"sdnator {' '.join(words[: ends[0]])}"]
    assert {word.split("=")[0] for word in words[ends[0] :] if word.startswith("-")} <= known


@pytest.mark.parametrize(
    ("example", "mark"),
    [
        ("foreign_detector.py", "wrapper"),
        ("river_evidence.py", "wrapper"),
        ("analyser.py", "analyser"),
    ],
)
def test_onboarding_shows_the_examples(example, mark):
    """The code on the page is that of the example, which is run by other tests, and is ten lines at most."""
    source = (ROOT / "examples" / example).read_text(encoding="utf-8")
    code = source.split(f"# [{mark}]\n")[1].split(f"# [/{mark}]")[0].strip()
    page = (DOCS / "onboarding.md").read_text(encoding="utf-8")
    assert code in page
    lines = [line for line in code.splitlines() if line and not line.startswith(("from", "import"))]
    assert len(lines) <= 10


def test_onboarding_shows_the_example_with_state():
    source = (ROOT / "examples" / "sharded_totals.py").read_text(encoding="utf-8")
    code = source.split("# [totals]\n")[1].split("# [/totals]")[0].strip()
    assert code in (DOCS / "onboarding.md").read_text(encoding="utf-8")


def test_documentation_builds_without_a_warning_and_works_offline(tmp_path):
    """`mkdocs build --strict` is content, and no page loads anything from elsewhere."""
    if importlib.util.find_spec("mkdocs") is None or importlib.util.find_spec("material") is None:
        pytest.skip("mkdocs-material is not installed")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", tmp_path],
        capture_output=True, text=True, cwd=ROOT, timeout=170, check=False,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    pages = list(tmp_path.rglob("*.html"))
    assert len(pages) >= len(list(DOCS.rglob("*.md")))
    for page in pages:
        for target in LOADED_BY_A_PAGE.findall(page.read_text(encoding="utf-8")):
            assert not target.startswith(("http:", "https:", "//")), f"{page.name} loads {target}"
