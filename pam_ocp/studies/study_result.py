"""What became of a study: its steps, its folder, and its report, one HTML page for whoever has to
trust it (jinja2); and results of steps that are kept, by the digest of all that went into them.
"""

from __future__ import annotations

import base64
import hashlib
import json
import logging
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.atomic import make_folder
from ..core.digest import built_with
from ..core.errors import UnknownNameError
from ..core.shown import shown
from ..core.units import display_unit, significant, unit
from ..export.cache import usable_folder
from .steps.step import STAGES, STEPS, csv_text
from .study_file import Entry, Study

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class StudyStep:
    """What became of a step.

    Examples
    --------
    >>> from pathlib import Path
    >>> said = "steps.mine = { kind = 'muscle', name = 'DMSP-20-300' }"
    >>> _ = Path("step.toml").write_text(said)
    >>> step = pam.studies.run_study("step.toml", cache="kept")["mine"]
    >>> step.kind, step.good, step.folder.name
    ('muscle', True, 'mine')
    """

    name: str
    kind: str
    state: str
    """"done" (now), "kept" (from an earlier run), "failed", or "left out" (stands on one that
    failed).
    """
    verdict: str = ""
    good: bool = True
    numbers: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    """{name: (value in SI, unit)}"""
    seconds: float = 0.0
    """That it took when it was done."""
    folder: Path = Path()
    made: Mapping[str, Any] = field(default_factory=dict, repr=False)


@shown
@dataclass(frozen=True)
class StudyResult:
    """A study that was run: its steps by name, its folder, its report.

    Examples
    --------
    >>> from pathlib import Path
    >>> said = "steps.mine = { kind = 'muscle', name = 'DMSP-20-300' }"
    >>> _ = Path("result.toml").write_text(said)
    >>> result = pam.studies.run_study("result.toml", cache="kept")
    >>> list(result.steps), list(result.to_pandas().columns)[:2]
    (['mine'], ['kind', 'state'])
    """

    title: str
    folder: Path
    steps: Mapping[str, StudyStep]
    report: Path

    @property
    def ok(self) -> bool:
        """Whether every step was done, and every verdict is good."""
        return all(s.good for s in self.steps.values())

    def __getitem__(self, name: str) -> StudyStep:
        if name not in self.steps:
            raise UnknownNameError("step of the study", name, self.steps)
        return self.steps[name]

    def to_pandas(self) -> pd.DataFrame:
        """A row for each step: kind, state, verdict, good, seconds."""
        import pandas as pd

        names = ("kind", "state", "verdict", "good", "seconds")
        rows = [[getattr(s, n) for n in names] for s in self.steps.values()]
        return pd.DataFrame(rows, index=list(self.steps), columns=list(names))

    def __str__(self) -> str:
        own = _told(self.steps) or dict(self.steps)
        width = max((len(n) for n in own), default=0) + 2
        lines = [f"{self.title}: {'all well' if self.ok else 'NOT all well'}"]
        lines += [
            f"{'✓' if s.good else '✗'} {n:<{width}}{s.kind:<11}{s.state:<9} {s.verdict}"
            for n, s in own.items()
        ]
        return "\n".join(lines)


MOST_CASES = 12
"""Of sweeps that failed, in text and report; the table of a sweep counts all."""


def _told(steps: Mapping[str, StudyStep]) -> dict[str, StudyStep]:
    """The steps of the file, and the first cases of sweeps that are not good, which say why."""
    cases = [n for n, s in steps.items() if "[" in n and not s.good][:MOST_CASES]
    return {n: s for n, s in steps.items() if "[" not in n or n in cases}


# ---- the report ----------------------------------------------------------------------------------
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
    shown = [_shown(study.entries[n], s) for n, s in _told(steps).items()]
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


# ---- kept results --------------------------------------------------------------------------------
# joblib's Memory keeps them, in the user's own folder (whoever could write there could have his
# code run: results are pickled). An entry is written beside its place and renamed, so that a
# process that is killed leaves all of it or nothing.
PACKAGES = ("casadi", "numpy", "scipy", "control", "fmpy", "matplotlib")
"""Whose versions go into every digest, and stand in the report."""
MOST_KEPT = 2 * 2**30
"""Bytes; what was not used for longest goes first."""


class Kept:
    """Where results are kept. folder : None for the user's cache."""

    def __init__(self, folder: str | os.PathLike[str] | None = None) -> None:
        from joblib import Memory

        place = make_folder(folder) if folder is not None else usable_folder("studies")
        self.folder = str(Path(place).absolute())
        self._memory = Memory(place, verbose=0)
        self._results = self._memory.cache(_result, ignore=["made"])

    def __contains__(self, key: str) -> bool:
        return bool(self._results.check_call_in_cache(key, None))

    def get(self, key: str) -> dict[str, Any] | None:
        """What was kept; None where there is nothing, or nothing that can be read."""
        if key not in self:
            return None
        log = logging.getLogger("joblib")
        before = log.level
        log.setLevel(logging.CRITICAL)  # what is damaged is made anew, without a word
        try:
            found: dict[str, Any] = self._results(key, _nothing)
        except _NothingKept:
            return None
        finally:
            log.setLevel(before)
        return found

    def put(self, key: str, result: dict[str, Any]) -> None:
        """Keep a result."""
        self._results(key, lambda: result)

    def trim(self) -> None:
        """Let go of what exceeds ``MOST_KEPT``."""
        self._memory.reduce_size(bytes_limit=MOST_KEPT)


class _NothingKept(Exception):
    pass


def _nothing() -> dict[str, Any]:
    raise _NothingKept


def _result(key: str, made: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What joblib keeps by its key alone."""
    return made()


def key_of(content: Any) -> str:
    """Of plain data, whatever the order of its keys."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()


def versions() -> Mapping[str, str]:
    """Of Python, pam_ocp, and the packages that its results come from."""
    return built_with(*PACKAGES)
