"""The report of a study: one HTML page for whoever has to trust it, made by jinja2."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.units import display_unit, significant, unit
from .kept_results import versions
from .steps.step import STAGES, STEPS, csv_text
from .study_file import Entry, Study

if TYPE_CHECKING:
    from .study_result import StudyStep

__all__ = ["study_report", "summary"]

TEMPLATE = Path(__file__).with_name("study_report.html")
MOST_NUMBERS = 12
"""Of a step, in the report; all stand in the summary."""


def summary(steps: Mapping[str, StudyStep]) -> str:
    """All numbers of all steps as a table (CSV, SI)."""
    rows = [
        (name, step.kind, number, value, unit)
        for name, step in steps.items()
        for number, (value, unit) in step.numbers.items()
    ]
    return csv_text(("step", "kind", "number", "value", "unit"), rows)


def study_report(study: Study, steps: Mapping[str, StudyStep], digests: Mapping[str, str]) -> str:
    """The page: in short; measured, assumed, fitted, computed, verified; how sure; made with."""
    import jinja2

    page = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    ).from_string(TEMPLATE.read_text("utf-8"))
    shown = [_shown(study.entries[n], s) for n, s in steps.items() if "[" not in n]
    stages = [(title, [s for s in shown if s["stage"] == stage]) for stage, title in STAGES.items()]
    made = [s.made["when"] for s in steps.values() if s.made]
    return page.render(
        study=study,
        paragraphs=[p.strip() for p in study.text.split("\n\n") if p.strip()],
        steps=shown,
        stages=[s for s in stages if s[1]],
        repeated=sum("[" in n for n in steps),
        well=all(s.good for s in steps.values()),
        dates=sorted({datetime.fromisoformat(w).date().isoformat() for w in made}),
        versions=versions(),
        digests=digests,
    )


def _shown(entry: Entry, step: StudyStep) -> dict[str, Any]:
    """A step as the page wants it."""
    made = step.made
    pictures = {n: c for n, c in made.get("files", {}).items() if n.endswith(".png")}
    return {
        "name": entry.name,
        "kind": entry.kind,
        "stage": entry.step.stage,
        "words": STEPS.words(entry.kind),
        "said": [(n, _plain(v)) for n, v in entry.said.items()],
        "above": entry.parts.values(),
        "state": step.state,
        "verdict": step.verdict,
        "good": step.good,
        "html": made.get("html", ""),
        "text": "" if made.get("html") and entry.kind != "fit-plant" else made.get("text", ""),
        "sure": made.get("sure", []),
        "numbers": [_number(n, *v) for n, v in list(step.numbers.items())[:MOST_NUMBERS]],
        "pictures": {n: base64.b64encode(c).decode() for n, c in pictures.items()},
        "files": [(n, f"{entry.place}/{n}") for n in made.get("files", {})],
        "seconds": step.seconds,
    }


def _number(name: str, value: float, measured: str) -> tuple[str, str]:
    shown = display_unit(measured)
    said = "" if shown == "1" else f" {shown}"
    return name, f"{significant(value / unit(shown).factor)}{said}"


def _plain(value: Any) -> str:
    """What stands in the file, without quotes and brackets where it is a list or a table."""
    if isinstance(value, Mapping):
        return ", ".join(f"{n} = {_plain(v)}" for n, v in value.items())
    if isinstance(value, list):
        return "; ".join(map(_plain, value))
    if isinstance(value, bool):
        return "yes" if value else "no"
    return str(value)
