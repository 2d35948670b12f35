"""A report for a supervisor: what was measured, fitted, planned and verified, in one HTML file.

Self-contained (pictures inside, no scripts, nothing from elsewhere), readable in light and dark,
and it prints one object after the other.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from ..core.atomic import atomic_path
from ..core.digest import built_with, file_digest
from ..core.errors import InputError, kind_of, require_instance
from ..core.files import require_ending
from ..core.stop import verb
from .sheets import Grid, html_of

PACKAGES = ("casadi", "numpy", "scipy", "control", "fmpy", "matplotlib")

PRINTED = 110
"""Of pictures that are also printed [dots per inch]."""

STYLE = """
:root { color-scheme: light dark; }
body { font: 15px/1.45 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; }
body { padding: 0 1rem; }
table { border-collapse: collapse; margin: .6rem 0; font-size: 14px; }
caption { text-align: left; font-weight: 600; padding: .3rem 0; }
th, td { text-align: left; padding: .15rem .8rem .15rem 0; border-bottom: 1px solid #8884; }
td { font-variant-numeric: tabular-nums; vertical-align: top; }
section { margin: 2rem 0; }
img { background: white; max-width: 100%; }
pre { overflow-x: auto; font-size: 13px; }
nav li { margin: .2rem 0; }
@media (max-width: 40rem) {
  body { padding: 0 .5rem; font-size: 14px; } table { font-size: 12px; }
  th, td { padding-right: .3rem; } td { overflow-wrap: anywhere; } .short { white-space: nowrap; }
  td:first-child:not(.short) { min-width: 4.5rem; } div, pre { overflow-wrap: anywhere; }
  th { overflow-wrap: normal; }
}
@media print {
  @page { margin: 15mm; }
  body { max-width: none; margin: 0; padding: 0; font-size: 10pt; } nav { display: none; }
  section { margin: 1rem 0; } table { font-size: 9pt; }
  pre { font-size: 8pt; white-space: pre-wrap; }
  tr, img { break-inside: avoid; } img { max-height: 13cm; }
  h1, h2, b, caption, thead { break-after: avoid; }
}
"""


@verb
def write_report(
    path: str | os.PathLike[str],
    things: Mapping[str, Any],
    *,
    title: str = "Report",
    text: str = "",
    sources: Sequence[str | os.PathLike[str]] = (),
) -> Path:
    """Write nouns and results as one HTML file; returns its path.

    things : {heading: object}: muscles, tables, fits, plants, plans, trajectories, closed loops,
        whatever shows itself in a notebook. text : an introduction, paragraphs parted by empty
        lines. sources : files of which all of it was made: their digests are listed.

    Raises InputError for another ending than .html, and for what has no form to show.

    Examples
    --------
    >>> pam.figures.write_report("report.html", {"The muscle": muscle, "The fit": fit}).name
    'report.html'
    """
    require_ending(path, ".html", "a report")
    require_instance("things", things, Mapping, "give {heading: object}")
    if not things:
        raise InputError("things is empty: give {heading: object} to report on")
    parts = []
    for i, (heading, thing) in enumerate(things.items()):
        if not hasattr(thing, "_repr_html_"):
            raise InputError(
                f"things[{heading!r}] is {kind_of(thing)}, which shows nothing; give a "
                "muscle, table, fit, plant, plan, trajectory or the like"
            )
        parts.append(
            f'<section id="part{i}"><h2>{escape(heading)}</h2>{html_of(thing, PRINTED)}</section>'
        )
    links = "".join(
        f'<li><a href="#part{i}">{escape(heading)}</a></li>' for i, heading in enumerate(things)
    )
    said = "".join(f"<p>{escape(part.strip())}</p>" for part in text.split("\n\n") if part.strip())
    page = (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style></head><body>'
        f"<h1>{escape(title)}</h1>{said}<nav><ul>{links}</ul></nav>{''.join(parts)}"
        f"{_made_with(sources)}</body></html>\n"
    )
    with atomic_path(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return Path(path)


def _made_with(sources: Sequence[str | os.PathLike[str]]) -> str:
    """Versions, and digests of the sources."""
    files = [(Path(source).name, _digest(source)) for source in sources]
    tables = [Grid(("", ""), list(versions().items()), "Made with")]
    tables += [Grid(("", ""), files, "Made from (SHA-256)")] if files else []
    return f"<section>{''.join(t.html(len(t.rows)) for t in tables)}</section>"


def versions() -> dict[str, str]:
    """Of this package, first, of Python, and of what numbers come from."""
    found = built_with(*PACKAGES)
    return {"pam_ocp": found["pam_ocp"], **found}


def _digest(source: str | os.PathLike[str]) -> str:
    try:
        return file_digest(Path(source))
    except OSError as error:
        raise InputError(f"sources: {os.fspath(source)} cannot be read: {error.strerror}") from None
