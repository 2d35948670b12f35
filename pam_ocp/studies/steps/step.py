"""What a step of a study is: the keys it takes, the nouns it stands on, what it makes of them.

Nothing heavy is loaded here: a study whose results are all kept must be told in a moment.
"""

from __future__ import annotations

import csv
import io
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeAlias

from ...core.exceptions import InputError
from ...core.files import read_toml
from ...core.quantities import is_quantity, outside, quantity
from ...core.registry import Registry
from ..problem import listed, values

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ...core.trajectory import Trajectory
    from ...muscles.pneumatic_muscle import Muscle
    from ...plants.plant import Plant

__all__ = [
    "STAGES",
    "STEPS",
    "Job",
    "Made",
    "Step",
    "csv_text",
    "doubts",
    "ends",
    "in_si",
    "intervals_said",
    "plant_in",
    "seconds",
    "text_of",
    "values",
    "write_intervals",
]

Stage: TypeAlias = Literal["measured", "assumed", "fitted", "computed", "verified"]
STAGES: dict[Stage, str] = {
    "measured": "What was measured",
    "assumed": "What was assumed",
    "fitted": "What was fitted",
    "computed": "What was computed",
    "verified": "What was verified",
}
"""The parts of a report, in its order."""


@dataclass(frozen=True)
class Job:
    """A step at work: what the file says, and the nouns that other steps made for it."""

    name: str
    said: Mapping[str, Any]
    """The keys of the step, as they stand in the file."""
    parts: Mapping[str, Any]
    """{key: noun}; None where it is not made yet (in ``check``)."""
    folder: Path
    """Of the study file; other files are looked for there."""
    out: Path = Path()
    """Where this step's files are put."""
    allow_code: bool = False
    sources: Mapping[str, Path] = field(default_factory=dict)
    """{key: the folder with the files of the step that it names}."""

    def get(self, key: str, default: Any = None) -> Any:
        """What the file says of this key."""
        return self.said.get(key, default)

    def si(self, key: str, unit: str, default: float | None = None) -> float | None:
        """A quantity in SI."""
        value = self.said.get(key)
        return default if value is None else quantity(key, value, unit)

    def listed(self, key: str) -> list[Any]:
        """A list; empty where nothing is said."""
        return listed(key, self.said.get(key, []))

    def save(self, figure: Figure, name: str = "plot.png") -> Path:
        """Write a figure of this step."""
        from ...figures.canvas import save_figure

        return save_figure(figure, self.out / name)

    def table(self, name: str, head: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
        """Write a table of this step (CSV)."""
        (self.out / name).write_text(csv_text(head, rows), "utf-8")

    def workbook(self, thing: Any, name: str) -> None:
        """Write a result as a workbook; a warning says where the extra [excel] is missing."""
        from ...figures.workbook import require_writer

        try:
            require_writer()
        except InputError as error:
            warnings.warn(f"{self.name}/{name} is left out: {error}", stacklevel=outside())
        else:
            thing.to_excel(self.out / name)


@dataclass(frozen=True)
class Made:
    """What a step made, besides its files."""

    thing: Any = None
    """Shown in the report as in a notebook."""
    verdict: str = ""
    good: bool = True
    numbers: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    """{name: (value in SI, unit)}: what sweeps tabulate."""
    sure: Sequence[str] = ()
    """How sure that is, a sentence each."""
    text: str = ""


class Step:
    """Base of all kinds of steps; its docstring's first sentence is what tables say of it.

    stage : the part of the report. parts : {key: the noun that it takes}: the value of such a key
    is the name of a step that offers the noun. needs : keys that must be given.
    keys : all others. offers : {noun: the file that it is read from}.
    """

    stage: ClassVar[Stage] = "computed"
    parts: ClassVar[Mapping[str, str]] = {}
    needs: ClassVar[tuple[str, ...]] = ()
    keys: ClassVar[tuple[str, ...]] = ()
    offers: ClassVar[Mapping[str, str]] = {}
    loose: ClassVar[tuple[str, ...]] = ()
    """Parts that may also be something else than a step, as a muscle of the catalogue."""
    whole: ClassVar[bool] = False
    """Whether what stands on this step asks for all that it was made from, not for its files."""

    @classmethod
    def check(cls, job: Job) -> dict[str, Any]:
        """Look at all that the file says, before anything runs: {noun: a stand-in for it}.

        Raises InputError for invalid input.
        """
        return {}

    @classmethod
    def work(cls, job: Job) -> Made:
        """Do it, and write files into ``job.out``. Raises a PamError where it cannot be done."""
        raise NotImplementedError

    @classmethod
    def read(cls, noun: str, job: Job) -> Any:
        """The noun from the files in ``job.out``, for another step."""
        file, read = job.out / cls.offers[noun], READERS.get(noun)
        return file if read is None else read(file, job.allow_code)


STEPS: Registry[type[Step]] = Registry("study step", __package__)


# ---- nouns in files of steps ---------------------------------------------------------------------
def _motion(file: Path, allow_code: bool) -> Trajectory:
    from ...core.trajectory import Trajectory

    return Trajectory.load(file)


def _muscle(file: Path, allow_code: bool) -> Muscle:
    from ...muscles.muscle_file import load_muscle

    return load_muscle(file)


def plant_in(file: Path, allow_code: bool) -> Plant:
    """The plant of a step's own file."""
    from ...plants.plant_file import plant_of

    return plant_of(read_toml(file)["plant"], "plant", file.parent, allow_code=allow_code)


READERS: dict[str, Callable[[Path, bool], Any]] = {
    "motion": _motion,
    "muscle": _muscle,
    "plant": plant_in,
}
"""{noun: what reads it of a file}; others are files themselves, as an FMU."""


# ---- what several kinds need ---------------------------------------------------------------------
def csv_text(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A table as text: numbers with all their digits."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    writer.writerows([[repr(float(c)) if _number(c) else c for c in row] for row in rows])
    return text.getvalue()


def _number(cell: Any) -> bool:
    return hasattr(cell, "__float__") and not isinstance(cell, str | bool | int)


def doubts(warnings: Sequence[str]) -> str:
    """Behind a verdict: how many doubts stand under "how sure"."""
    count = len(warnings)
    return f"; {count} doubt{'s' if count > 1 else ''}, see how sure" if count else ""


def seconds(job: Job, key: str) -> float:
    """A span of time > 0 [s]."""
    from ...core.errors import require_positive

    return require_positive(key, quantity(key, job.said[key], "s"), "s")


def text_of(job: Job, key: str, default: str | None = None) -> str:
    """A text. Raises InputError for anything else."""
    value = job.said.get(key, default)
    if not isinstance(value, str):
        raise InputError(f"{key} = {value!r}: give a text in quotes")
    return value


def ends(motion: Trajectory) -> dict[str, tuple[float, str]]:
    """Of each column its last, least and largest value."""
    found: dict[str, tuple[float, str]] = {}
    kinds: dict[str, Callable[[Any], Any]] = {"last": lambda c: c[-1], "min": min, "max": max}
    for variable in motion.variables:
        for kind, of in kinds.items():
            found[f"{variable.name}.{kind}"] = float(of(motion[variable.name])), variable.unit
    return found


def write_intervals(fit: Any, job: Job, name: str, first: str = "name") -> None:
    """The fitted values of a fit with their intervals as a table; first : heading of the names."""
    intervals = fit.intervals()
    rows = [
        (c.name, c.value, c.stderr, *intervals.get(c.name, (c.value, c.value)), c.unit)
        for c in fit.coefficients.values()
    ]
    job.table(name, (first, "value", "stderr", "low", "high", "unit"), rows)


def intervals_said(fit: Any) -> list[str]:
    """The intervals of any fit, a sentence each."""
    units = {n: fit.coefficients[n].unit for n in fit.intervals()}
    return [
        f"{n} lies in {low:.5g} .. {high:.5g}{'' if units[n] == '1' else f' {units[n]}'} (95 %)"
        for n, (low, high) in fit.intervals().items()
    ]


def in_si(where: str, said: Any, unit: str) -> list[float]:
    """A list of quantities; numbers without a unit are SI."""
    if is_quantity(said) or isinstance(said, int | float):
        said = [said]
    if not isinstance(said, list) or not said:
        raise InputError(f"{where} = {said!r}: give a list of values, as ['5 kg', '10 kg']")
    return [quantity(f"{where}[{i}]", v, unit) for i, v in enumerate(said, start=1)]
