"""A sweep: a step again and again with other values, and what becomes of its numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ...core.errors import InputError, UnknownNameError
from ...core.units import display_unit, significant, unit
from .step import STEPS, Job, Made, Step

MOST_CASES = 10_000
MOST_PANELS = 6


def cases_of(where: str, vary: Any) -> list[dict[str, Any]]:
    """{"STEP.key": value} of each combination of ``vary``. Raises InputError."""
    import itertools

    if not isinstance(vary, Mapping) or not vary:
        raise InputError(f"{where}.vary = {vary!r}: give a table, as {{ 'slide.mass' = [1, 2] }}")
    for name, listed in vary.items():
        if not isinstance(listed, list) or not listed:
            raise InputError(f"{where}.vary.{name} = {listed!r}: give a list of values")
    cases = [dict(zip(vary, chosen, strict=True)) for chosen in itertools.product(*vary.values())]
    if len(cases) > MOST_CASES:
        raise InputError(f"{where}.vary has {len(cases)} combinations; {MOST_CASES} at most")
    return cases


@STEPS.register("sweep")
class SweepStep(Step):
    """A step repeated with other values in it or in the steps that it uses."""

    needs = ("of", "vary")
    keys = ("numbers",)

    @classmethod
    def check(cls, job: Job) -> dict[str, Any]:
        job.listed("numbers")
        return {}

    @classmethod
    def work(cls, job: Job) -> Made:
        cases: list[dict[str, Any]] = cases_of(job.name, job.said["vary"])
        told: Sequence[Mapping[str, tuple[float, str]] | None] = job.parts["cases"]
        found = [numbers or {} for numbers in told]
        known = list(dict.fromkeys(n for numbers in found for n in numbers))
        for name in job.listed("numbers"):
            if known and name not in known:  # where all cases failed there are none
                raise UnknownNameError(f"number of {job.said['of']}", name, known)
        chosen = (job.listed("numbers") or known) if known else []
        units = {n: next(f[n][1] for f in found if n in f) for n in chosen}
        nan = float("nan"), ""
        rows = [
            (*map(str, case.values()), *(numbers.get(n, nan)[0] for n in chosen))
            for case, numbers in zip(cases, found, strict=True)
        ]
        head = [*cases[0], *(f"{n} [{units[n]}]" for n in chosen)]
        job.table("sweep.csv", head, rows)
        if len(cases[0]) <= 2 and chosen:
            _plot(job, cases, found, chosen[:MOST_PANELS], units)
        failed = sum(numbers is None for numbers in told)
        said = f"{len(cases) - failed} of {len(cases)} cases done"
        return Made(None, said, not failed, {}, (), _text(head, rows))


def _text(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    cells = [[significant(c) if isinstance(c, float) else c for c in row] for row in rows]
    widths = [max(len(r[i]) for r in [head, *cells]) + 2 for i in range(len(head))]
    return "\n".join(
        "".join(c.rjust(w) for c, w in zip(row, widths, strict=True)) for row in [head, *cells]
    )


def _plot(
    job: Job,
    cases: Sequence[Mapping[str, Any]],
    found: Sequence[Mapping[str, tuple[float, str]]],
    chosen: Sequence[str],
    units: Mapping[str, str],
) -> None:
    """The numbers over the first that is varied, a line for each value of the second."""
    from ...figures.canvas import COLOURS, MARKS, STROKES, caption, panels

    figure, axes = panels(len(chosen), size=(8, 1.0 + 2.2 * len(chosen)))
    first, *others = cases[0]
    ticks = list(dict.fromkeys(str(c[first]) for c in cases))
    lines = list(dict.fromkeys(str(c[o]) for c in cases for o in others)) or [""]
    for ax, name in zip(axes, chosen, strict=True):
        shown = display_unit(units[name])
        factor = unit(shown).factor
        for i, line in enumerate(lines):
            at = [
                (ticks.index(str(c[first])), f[name][0] / factor)
                for c, f in zip(cases, found, strict=True)
                if name in f and all(str(c[o]) == line for o in others)
            ]
            style: dict[str, Any] = {
                "marker": MARKS[i % len(MARKS)],
                "color": COLOURS[i % len(COLOURS)],
            }
            if at:
                ax.plot(*zip(*at, strict=True), STROKES[i % len(STROKES)], label=line, **style)
        caption(ax, y=name + ("" if shown == "1" else f"\n[{shown}]"))
    if others:
        axes[0].legend(title=others[0], frameon=False, fontsize="small")
    axes[-1].set_xticks(range(len(ticks)), ticks)
    caption(axes[-1], first)
    job.save(figure)
