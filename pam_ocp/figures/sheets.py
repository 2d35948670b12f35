"""The sheets of nouns and results: what of them a notebook shows."""

from __future__ import annotations

import base64
import inspect
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.interrupts import interruptible
from ..core.shown import shown
from ..core.units import significant
from ..operating.operating_point import pole_texts
from .canvas import drawn

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..core.trajectory import Trajectory
    from ..core.variables import Variable
    from ..fitting.dynamic.plant_fit import PlantFit
    from ..fitting.static.force_fit import ForceFit
    from ..fitting.tables.force_table import ForceTable
    from ..muscles.pneumatic_muscle import Muscle
    from ..operating.operating_point import OperatingPoint
    from ..operating.several import Equilibria
    from ..planning.result import Plan
    from ..plants.plant import Plant

DPI = 60
"""Of pictures, which are there for a glance: ``.plot()`` gives the whole one."""
MOST_ROWS, SHORT = 60, 10


def cell_text(cell: str | float) -> str:
    """A text as it is, a number as people read it."""
    return cell if isinstance(cell, str) else significant(cell).replace("inf", "∞")


def number_in(cell: str | float) -> str | float:
    """The number of a cell, or its text."""
    try:
        return float(cell)
    except ValueError:
        return cell


def _cell(text: str) -> str:
    """Short ones are not broken where the page is narrow."""
    kind = ' class="short"' if len(text) <= SHORT else ""
    return f"<td{kind}>{escape(text)}</td>"


@dataclass(frozen=True)
class Grid:
    """A table: heads, and rows of texts and of numbers, which are rounded where they are shown. The
    first column is the row's name.
    """

    head: tuple[str, ...]
    rows: Sequence[Sequence[str | float]]
    title: str = ""

    def html(self, most: int = MOST_ROWS) -> str:
        """As an HTML table without empty columns, cut after so many rows."""
        told = [j for j in range(len(self.head)) if any(row[j] != "" for row in self.rows)]
        head = "".join(f"<th>{escape(self.head[j])}</th>" for j in told)
        rows = [
            "<tr>" + "".join(_cell(cell_text(row[j])) for j in told) + "</tr>"
            for row in self.rows[:most]
        ]
        if len(self.rows) > most:
            more = f"... {len(self.rows) - most} more rows"
            rows.append(f'<tr><td colspan="{len(told)}">{more}</td></tr>')
        caption = f"<caption>{escape(self.title)}</caption>" if self.title else ""
        body = f"<thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody>"
        return f"<table>{caption}{body}</table>"


@dataclass(frozen=True)
class Sheet:
    """What an object shows: heading, verdict (``good`` or not), tables, notes, text, picture."""

    heading: str
    verdict: str = ""
    good: bool = True
    grids: tuple[Grid, ...] = ()
    notes: tuple[str, ...] = ()
    text: str = ""
    picture: Callable[[], Figure] | None = None

    def html(self, dpi: int = DPI) -> str:
        """As a block of HTML without scripts; readable in light and dark."""
        parts = [f"<b>{escape(self.heading)}</b>"]
        if self.verdict:
            colour, mark = ("#009e73", "✓") if self.good else ("#d55e00", "✗")
            style = f"border-left:4px solid {colour};padding-left:8px;margin:6px 0"
            parts.append(f'<div style="{style}">{mark} {escape(self.verdict)}</div>')
        parts += [grid.html() for grid in self.grids if grid.rows]
        parts += [f"<div>⚠ {escape(note)}</div>" for note in self.notes]
        if self.text:
            parts.append(f'<pre style="line-height:1.25">{escape(self.text)}</pre>')
        if self.picture is not None and dpi:
            data = base64.b64encode(drawn(self.picture(), "png", dpi)).decode("ascii")
            source = f"data:image/png;base64,{data}"
            parts.append(f'<img alt="plot" style="max-width:100%" src="{source}"/>')
        return f'<div class="pam_ocp">{"".join(parts)}</div>'


# ---- of each class ------------------------------------------------------------------------------
KINDS = ("state", "input", "output", "parameter", "constraint")


def _number(value: float | None, variable: Variable) -> str | float:
    """In the display unit, without the unit itself."""
    return "" if value is None else variable.displayed(value)


def _unit(variable: Variable) -> str:
    return "" if variable.display_unit == "1" else variable.display_unit


def _range(variable: Variable) -> str:
    if math.isinf(variable.min) and math.isinf(variable.max):
        return ""
    low, high = (cell_text(variable.displayed(end)) for end in (variable.min, variable.max))
    return f"{low} .. {high}"


def _variables(variables: Iterable[Variable], title: str) -> Grid:
    rows = [(v.name, _number(v.start, v), _range(v), _unit(v), v.description) for v in variables]
    return Grid(("name", "start", "range", "unit", "description"), rows, title)


def _muscle(muscle: Muscle) -> Sheet:
    from .trajectory import plot_muscle

    low, high = (1e-5 * p for p in muscle.pressure_range)
    least, most = (100 * k for k in muscle.contraction_range)
    said = {
        "law": f"{muscle.law.title}: {muscle.law.reference}",
        "rest length": f"{1e3 * float(muscle.rest_length):.6g} mm",
        "diameter": "" if muscle.diameter is None else f"{1e3 * muscle.diameter:.6g} mm",
        "mass": "" if muscle.mass is None else f"{muscle.mass:.6g} kg",
        "measured": f"{low:.4g} .. {high:.4g} bar gauge, {least:.4g} .. {most:.4g} % contraction",
        "numbers": muscle.source
        if muscle.source.startswith(muscle.obtained)
        else f"{muscle.obtained}: {muscle.source}",
    }
    coefficients = [(n, f"{v:.8g}") for n, v in muscle.law.values.items()]
    return Sheet(
        f"Muscle {muscle.name}",
        grids=(
            Grid(("", ""), [row for row in said.items() if row[1]]),
            Grid(("coefficient", "value (SI)"), coefficients),
        ),
        notes=(muscle.note,) if muscle.note else (),
        picture=lambda: plot_muscle(muscle),
    )


def _plant(plant: Plant) -> Sheet:
    kinds = {kind: [v for v in plant.variables if v.causality == kind] for kind in KINDS}
    return Sheet(
        f"{type(plant).__name__} {plant.name}: {plant.description}".rstrip(": "),
        grids=tuple(_variables(vs, f"{kind}s") for kind, vs in kinds.items()),
    )


def _variable(variable: Variable) -> Sheet:
    return Sheet(variable.name, grids=(_variables([variable], variable.causality),))


def _trajectory(motion: Trajectory) -> Sheet:
    rows = [
        (
            v.name,
            *(_number(float(x), v) for x in (c[0], c[-1], np.min(c), np.max(c))),
            _unit(v),
            v.description,
        )
        for v in motion.variables
        for c in [motion[v.name]]
    ]
    head = ("name", "first", "last", "least", "most", "unit", "description")
    span = f"{motion.t[0]:g} .. {motion.t[-1]:g} s, {len(motion.t)} samples"
    return Sheet(f"Trajectory, {span}", grids=(Grid(head, rows),), picture=motion.plot)


def _point(point: OperatingPoint) -> Sheet:
    values = [
        (v.name, _number(point.values[v.name], v), _unit(v), v.description)
        for v in map(point.plant.variable, point.values)
    ]
    upper = [p for p in point.poles if p.imag >= 0]
    poles = list(zip(pole_texts(upper), map(_vibration, upper), strict=True))
    return Sheet(
        f"Operating point of {point.plant.name}",
        f"{point.stability}; residual {point.residual:.1e} (scaled by nominal values) per second",
        point.stability != "unstable",
        (
            Grid(("name", "value", "unit", "description"), values),
            Grid(("pole [1/s]", ""), poles),
        ),
    )


def _vibration(pole: complex) -> str:
    size = abs(pole)
    if not pole.imag or not size:
        return ""
    return f"{size / (2 * math.pi):.4g} Hz, damping ratio {-pole.real / size:.3g}"


def _equilibria(points: Equilibria) -> Sheet:
    if not points:
        return Sheet("Equilibria: none")
    plant = points[0].plant
    variables = [*plant.states, *plant.inputs]
    rows = [
        (str(i), *(_number(p[v.name], v) for v in variables), p.stability)
        for i, p in enumerate(points)
    ]
    head = ("", *(v.label for v in variables), "stability")
    return Sheet(f"Equilibria of {plant.name}", grids=(Grid(head, rows),))


def _plan(plan: Plan) -> Sheet:
    s = plan.statistics
    counted = plan._problem.objective.words if plan._problem else ""
    rows = [
        ("duration", f"{significant(plan.duration)} s"),
        ("objective", significant(plan.objective) + (f" = {counted}" if counted else "")),
        ("solver", f"{s.get('solver', 'IPOPT')}: {plan.status}"),
        ("iterations", str(s.get("iterations", "?"))),
        ("mesh", f"{s.get('intervals', '?')} intervals, refined {len(plan.meshes) - 1} times"),
    ]
    rows += [(f"design {n}", plan.plant.variable(n).shown(v)) for n, v in plan.design.items()]
    if plan.replay:
        worst = plan.replay.constraint
        rows += [
            (
                "replay",
                f"deviates by {plan.replay.error:.2e} (scaled by nominals) in {plan.replay.state}",
            ),
            (
                "limits",
                f"exceeded by {plan.replay.violation:.2e} (scaled by nominals) {worst}".rstrip(),
            ),
        ]
    return Sheet(
        f"Plan of {plan.plant.name}",
        str(plan.verdict),
        plan.verified,
        (Grid(("", ""), rows),),
        tuple(filter(None, [s.get("warning", ""), *map(str, plan.conflicts)])),
        picture=plan.plot if plan.solved else None,
    )


def _table(table: ForceTable) -> Sheet:
    rows = [
        (name, f"{values.min() / size:.4g}", f"{values.max() / size:.4g}", unit)
        for name, values, size, unit in (
            ("pressure", table.pressure, 1e5, "bar"),
            ("contraction", table.contraction, 1e-2, "%"),
            ("force", table.force, 1.0, "N"),
        )
    ]
    levels, slack = table.levels().max() + 1, int(table.slack.sum())
    said = f"{len(table)} cells, {slack} of them slack, {levels} contraction levels"
    if table.rest_length is not None:
        said += f", rest length {1e3 * table.rest_length:g} mm"
    heading = f"Force table {table.source}".rstrip()
    return Sheet(heading, said, grids=(Grid(("", "least", "most", "unit"), rows),))


def _force_fit(fit: ForceFit) -> Sheet:
    from .trajectory import plot_fit

    return Sheet(
        f"{fit.law.title}, fitted to {fit.table.source or 'a table'}",
        f"RMSE {fit.rmse:.4g} N over {fit.n} taut cells, R² {fit.r2:.6f}",
        True,  # doubts stand below
        (_coefficients(fit),),
        fit.warnings,
        picture=lambda: plot_fit(fit),
    )


def _coefficients(fit: Any) -> Grid:
    intervals = fit.intervals()
    rows = []
    for c in fit.coefficients.values():
        low, high = intervals.get(c.name, (c.value, c.value))
        unit = "" if c.unit == "1" else c.unit
        error: tuple[float | str, str] = c.stderr, f"{cell_text(low)} .. {cell_text(high)}"
        rows.append((c.name, c.value, *(("held", "") if c.held else error), unit, c.description))
    head = ("name", "value", "standard error", "95 % interval", "unit", "description")
    return Grid(head, rows)


def _plant_fit(fit: PlantFit) -> Sheet:
    agreement = [
        (n, fit.plant.variable(n).shown(e), f"{fit.fit_percent[n]:.2f} %")
        for n, e in fit.rmse.items()
    ]
    return Sheet(
        f"{fit.plant.name}, fitted to {len(fit.records)} records",
        f"{fit.method}: {fit.status}, {fit.iterations} iterations",
        not fit.warnings,
        (Grid(("measured", "RMSE", "fit"), agreement), _coefficients(fit)),
        fit.warnings,
        picture=fit.plot,
    )


SHEETS: dict[str, Callable[[Any], Sheet]] = {
    "Equilibria": _equilibria,
    "ForceFit": _force_fit,
    "ForceTable": _table,
    "Muscle": _muscle,
    "OperatingPoint": _point,
    "Plan": _plan,
    "Plant": _plant,
    "PlantFit": _plant_fit,
    "Trajectory": _trajectory,
    "Variable": _variable,
}
"""By the name of the class; all others show their text and their picture."""


# ---- of any object ------------------------------------------------------------------------------
@interruptible()
def html_of(thing: Any, dpi: int = DPI) -> str:
    """The form in notebooks of any noun or result; see :mod:`pam_ocp.figures.sheets`.

    dpi : of its picture; 0 leaves it out.
    """
    return sheet_of(thing).html(dpi)


def sheet_of(thing: Any) -> Sheet:
    """What an object shows: by its class, or its text and its picture."""
    for cls in type(thing).__mro__:
        if cls.__name__ in SHEETS and cls.__module__.startswith(f"{__package__.split('.')[0]}."):
            return SHEETS[cls.__name__](thing)
    return _plain(thing)


def _plain(thing: Any) -> Sheet:
    """Of a result without a sheet of its own: its text and its picture."""
    plot = getattr(thing, "plot", None)
    own = getattr(type(thing).plot, "__module__", "") != shown.__module__ if plot else False
    drawable = (
        own
        and callable(plot)
        and all(
            p.default is not p.empty or p.kind in (p.VAR_KEYWORD, p.VAR_POSITIONAL)
            for p in inspect.signature(plot).parameters.values()
        )
    )
    return Sheet(type(thing).__name__, text=str(thing), picture=plot if drawable else None)
