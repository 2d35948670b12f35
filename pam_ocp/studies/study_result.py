"""What became of a study: its steps, its folder, its report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.errors import UnknownNameError
from ..core.shown import shown

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["StudyResult", "StudyStep"]


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
        own = {n: s for n, s in self.steps.items() if "[" not in n} or dict(self.steps)
        width = max((len(n) for n in own), default=0) + 2
        lines = [f"{self.title}: {'all well' if self.ok else 'NOT all well'}"]
        lines += [
            f"{'✓' if s.good else '✗'} {n:<{width}}{s.kind:<11}{s.state:<9} {s.verdict}"
            for n, s in own.items()
        ]
        return "\n".join(lines)
