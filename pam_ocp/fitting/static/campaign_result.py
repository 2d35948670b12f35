"""What a campaign tells, as objects, a table, a text, data to plot, and a folder."""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ...core.atomic import atomic_path, make_folder
from ...core.errors import UnknownNameError
from ...muscles.law import ForceLaw
from ...muscles.muscle_file import save_muscle
from ..statistics import Array
from .force_fit import ForceFit
from .report import Hysteresis, LackOfFit
from .shared import JointForceFit
from .static import Candidate


@dataclass(frozen=True)
class RunStudy:
    """One repeat against the mean of all: cells, mean ± standard error, RMSE [N]."""

    name: str
    cells: int
    mean: float
    stderr: float
    rmse: float


@dataclass(frozen=True, eq=False)
class MuscleStudy:
    """One muscle. diameter : [m] or None. fit : over all branches and repeats. branches : a fit
    each. reasons : why there is no study of branches, hysteresis or lack of fit.
    """

    name: str
    diameter: float | None
    fit: ForceFit
    branches: Mapping[str, ForceFit]
    hysteresis: Hysteresis | None
    lack_of_fit: LackOfFit | None
    runs: tuple[RunStudy, ...]
    reasons: Mapping[str, str] = field(repr=False)

    @property
    def rest_length(self) -> float | None:
        """[m], or None."""
        return self.fit.table.rest_length


@dataclass(frozen=True, eq=False)
class LengthLaw(Candidate[JointForceFit]):
    """A law with one set of coefficients for all lengths. left_out : {muscle: RMSE [N] of the law
    fitted to the others}; problem : why there is no fit.
    """

    @property
    def left_out_rmse(self) -> float:
        """Root of the mean square over the lengths left out [N]."""
        values = np.array([*self.left_out.values()])
        return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


@dataclass(frozen=True, eq=False)
class LengthStudy:
    """Muscles of one diameter [m]. joint : the law with shared coefficients; probability : that
    sharing costs so much by noise alone. laws : one set for all lengths, the best left out first.
    """

    diameter: float
    muscles: tuple[str, ...]
    joint: JointForceFit | None
    probability: float
    problem: str
    laws: tuple[LengthLaw, ...]

    @property
    def ranked(self) -> list[LengthLaw]:
        """The laws, the one that predicts lengths left out best first."""
        return sorted(self.laws, key=lambda law: law.rank)


@dataclass(frozen=True, eq=False)
class Campaign:
    """Muscles by name, groups of one diameter, and what was not read or fitted, with reasons.

    Examples
    --------
    >>> list(campaign.muscles), round(campaign["M1"].fit.rmse, 1)
    (['M1'], 6.2)
    """

    law: type[ForceLaw]
    muscles: Mapping[str, MuscleStudy]
    lengths: tuple[LengthStudy, ...]
    failed: Mapping[str, str]

    def __getitem__(self, name: str) -> MuscleStudy:
        if name not in self.muscles:
            raise UnknownNameError("muscle of the campaign", name, self.muscles)
        return self.muscles[name]

    def table(self) -> list[dict[str, Any]]:
        """A row for each muscle and each of its branches: sizes, cells, RMSE [N], coefficients with
        standard errors and 95 % intervals [SI]. ``pandas.DataFrame(...)`` takes it.
        """
        return [
            {
                "muscle": study.name,
                "diameter_m": study.diameter,
                "rest_length_m": study.rest_length,
                "branch": branch,
                "cells": fit.n,
                "rmse_N": fit.rmse,
                **fit._row(),
            }
            for study in self.muscles.values()
            for branch, fit in (("all", study.fit), *study.branches.items())
        ]

    def plot_data(self) -> dict[str, dict[str, Array]]:
        """{muscle: {pressure, contraction, measured, fitted, residual, branch, run}} [SI] at the
        taut cells.
        """
        found = {}
        for name, study in self.muscles.items():
            cells, rest = study.fit.cells, study.fit.residuals
            none = np.full(len(cells), "")
            found[name] = {
                "pressure": cells.pressure,
                "contraction": cells.contraction,
                "measured": cells.force,
                "fitted": cells.force - rest,
                "residual": rest,
                "branch": np.array(cells.branch) if cells.branch else none,
                "run": np.array(cells.run) if cells.run else none,
            }
        return found

    def report(self) -> str:
        """The campaign as text: muscles, branches, repeats, lengths, what is missing and why."""
        lines = [f"[[Campaign]] {self.law.title}: {len(self.muscles)} muscles"]
        for study in self.muscles.values():
            lines += _muscle_lines(study)
        for group in self.lengths:
            lines += _length_lines(group)
        if self.failed:
            lines += ["[[Not used]]", *(f"    {n}: {why}" for n, why in self.failed.items())]
        return "\n".join(lines)

    def __str__(self) -> str:
        return self.report()

    def save(self, folder: str | os.PathLike[str]) -> Path:
        """Write report.txt, table.csv, and for each muscle NAME.json (the fit, read by
        :meth:`ForceFit.from_json`) and, where its length is known, NAME.toml (a muscle file).
        """
        target = make_folder(folder)
        _write(target / "report.txt", self.report() + "\n")
        rows = self.table()
        text = io.StringIO()
        writer = csv.DictWriter(text, list(dict.fromkeys(n for row in rows for n in row)))
        writer.writeheader()
        writer.writerows(rows)
        _write(target / "table.csv", text.getvalue())
        for name, study in self.muscles.items():
            plain = re.sub(r"[^\w.+-]+", "_", name)
            study.fit.to_json(target / f"{plain}.json")
            if study.rest_length is not None:
                muscle = study.fit.muscle(diameter=study.diameter, name=name)
                save_muscle(muscle, target / f"{plain}.toml")
        return target


def _write(target: Path, text: str) -> None:
    with atomic_path(target) as path:
        path.write_text(text, encoding="utf-8", newline="\n")


def _size(value: float | None) -> str:
    return "?" if value is None else f"{1e3 * value:g} mm"


def _muscle_lines(study: MuscleStudy) -> list[str]:
    fit = study.fit
    lines = [
        f"[[{study.name}]] diameter {_size(study.diameter)}, rest length "
        f"{_size(study.rest_length)}",
        f"    all: {fit.n} taut cells of {len(fit.table)}, RMSE {fit.rmse:.4g} N",
    ]
    lines += [f"  {line}" for line in fit._coefficient_lines("", 0.95)[1:]]
    lines += [
        f"    {branch}: {one.n} taut cells, RMSE {one.rmse:.4g} N"
        for branch, one in study.branches.items()
    ]
    if study.hysteresis is not None:
        lines.append(f"    {str(study.hysteresis).splitlines()[0]}")
    if study.lack_of_fit is not None:
        lines.append(f"    {study.lack_of_fit}")
    lines += [
        f"    repeat {r.name or '(no name)'}: {r.cells} cells, {r.mean:+.3g} ± {r.stderr:.2g} N, "
        f"RMSE {r.rmse:.3g} N"
        for r in study.runs
    ]
    lines += [f"    no {what}: {why}" for what, why in study.reasons.items()]
    return [*lines, *(f"    ! {text}" for text in fit.warnings)]


def _length_lines(group: LengthStudy) -> list[str]:
    lines = [f"[[Diameter {_size(group.diameter)}]] {', '.join(group.muscles)}"]
    if group.joint is None:
        lines.append(f"    no shared coefficients: {group.problem}")
    else:
        p = group.probability
        differ = "the muscles differ" if p < 0.05 else "no sign that they differ"
        judged = f"; probability {p:.2g} that sharing costs so much by noise alone, {differ}"
        lines.append(
            f"    shared {', '.join(group.joint.shared) or 'nothing'}: RMSE "
            f"{group.joint.rmse:.4g} N{'' if np.isnan(p) else judged}"
        )
    lines.append("    one set for all lengths: RMSE [N], and at lengths left out [N]")
    for law in group.ranked:
        left = ", ".join(f"{n} {v:.3g}" for n, v in law.left_out.items())
        found = f"{law.rmse:>8.2f}{law.left_out_rmse:>8.2f}  ({left})" if law.fit else law.problem
        lines.append(f"      {law.name:<22}{found}")
    return lines
