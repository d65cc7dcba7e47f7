"""The page of the paper's benchmark: the paper's figures beside ours, one row a finding."""

import html
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_STYLE = """
body { font-family: system-ui, sans-serif; margin: 2rem auto; max-width: 70rem; color: #1d2733; }
table { border-collapse: collapse; width: 100%; } td, th { border-bottom: 1px solid #dfe5ec; padding: .4rem .6rem;
text-align: left; vertical-align: top; } .yes { color: #1f7a4a; } .no { color: #b00020; } img { max-width: 48%; }
"""


def write(results: Mapping[str, Any], folder: Path) -> Path:
    """Write `index.html`; the pictures of the production findings lie beside it, where they were measured."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = "".join(_row(one) for one in results["findings"])
    pictures = "".join(
        f'<img src="production/{path.name}" alt="{html.escape(path.stem)}">'
        for path in sorted((folder / "production").glob("*.png"))
    )
    machine = ", ".join(f"{name} {value}" for name, value in results["machine"].items())
    versions = ", ".join(f"{name} {value}" for name, value in results["versions"].items())
    path = folder / "index.html"
    path.write_text(
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>The paper\'s findings</title>'
        f"<style>{_STYLE}</style><h1>The paper's findings, measured here</h1>"
        f"<p>{results['findings_reported']} of 12 measured, {results['findings_reproduced']} reproduced. "
        f"{html.escape(machine)}. {html.escape(versions)}.</p>"
        "<table><tr><th>#<th>Claim<th>Paper<th>Here: median (least to most)<th>Reproduced<th>Why</tr>"
        f"{rows}</table>{pictures}\n",
        encoding="utf-8",
    )
    return path


def _row(finding: Mapping[str, Any]) -> str:
    figures = "<br>".join(
        f"{html.escape(name)} {one['median']:.3g} ({one['least']:.3g} to {one['most']:.3g})"
        for name, one in finding["figures"].items()
    )
    verdict = finding["reproduced"]
    return (
        f"<tr><td>{finding['number']}<td>{html.escape(finding['says'])}<td>{html.escape(finding['paper'])}"
        f'<td>{figures}<td class="{"yes" if verdict == "yes" else "no"}">{verdict}'
        f"<td>{html.escape(finding['sentence'])}</tr>"
    )
