"""The page of the paper's benchmark: the paper's figures beside ours, one row a finding."""

import html
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks import paper_plots

_STYLE = """
body { font-family: system-ui, sans-serif; margin: 2rem auto; max-width: 70rem; color: #1d2733; }
table { border-collapse: collapse; width: 100%; } td, th { border-bottom: 1px solid #dfe5ec; padding: .4rem .6rem;
text-align: left; vertical-align: top; } .yes { color: #1f7a4a; } .no { color: #b00020; } img { max-width: 100%; margin: .5rem 0; } img[src^=production] { max-width: 49%; }
"""


def write(results: Mapping[str, Any], folder: Path) -> Path:
    """Write `index.html` and its pictures; those of the production findings lie in `production` already."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = "".join(_row(one) for one in results["findings"])
    drawn = paper_plots.draw(results["cells"], folder)
    if "production" in results["cells"]:
        drawn += sorted((folder / "production").glob("*.png"))
    pictures = "".join(
        f'<img src="{path.relative_to(folder)}" alt="{html.escape(path.stem)}">' for path in drawn
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
        f"{rows}</table>{_cases(results['cells'].get('cases', {}))}{pictures}\n",
        encoding="utf-8",
    )
    return path


def _cases(workflows: Mapping[str, Any]) -> str:
    """What each networking workflow reported as a number, or why it failed."""
    found = ""
    for name, reported in workflows.items():
        figures = {
            field: f"{value:.4g}" if isinstance(value, float) else str(value)
            for field, value in reported.items()
            if (isinstance(value, int | float) and value is not False) or field in ("failed", "void")
        }
        text = ", ".join(f"{field.replace('_', ' ')} {value}" for field, value in figures.items() if value)
        found += f"<p><strong>{html.escape(name.capitalize())}</strong>: {html.escape(text)}."
    return found


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
