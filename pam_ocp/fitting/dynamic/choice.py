"""What is chosen, and what a choice by nested cross-validation tells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.trajectory import Trajectory
from ..statistics import Array
from .cross_validation import mean_loss

__all__ = ["Choice", "Rule", "Structure", "Tried"]

Rule: TypeAlias = Literal["simplest", "best"]


@runtime_checkable
class Structure(Protocol):
    """What can be chosen: a model's form, with the way in which its parameters are found.

    With a process pool it travels by pickle: a dataclass of a module, no lambda.

    Examples
    --------
    >>> names = ["x"], ["muscle.command"]
    >>> yardstick = pam.fitting.ArxStructure(*names, order=2, horizon=[0.1], every=0.2)
    >>> isinstance(yardstick, pam.fitting.Structure)
    True
    """

    @property
    def complexity(self) -> float:
        """What a user pays for it: by habit the number of free parameters."""
        ...

    def fit(self, records: Sequence[Trajectory], /) -> Any:
        """The fitted model; PamError where these records allow none."""
        ...

    def losses(self, model: Any, records: Sequence[Trajectory], /) -> ArrayLike:
        """Mean squared error of each record (n,), or of each by several criteria, such as horizons
        or outputs (n, m); NaN where a record is too short to be judged.
        """
        ...


@dataclass(frozen=True, eq=False)
class Tried:
    """What came of one structure in the (outer) cross-validation over all records.

    loss : mean over the records, by criterion (m,). score : mean of the criteria, each in parts of
    the best structure's. behind : mean lead of the best, in its score, and ``error``, its standard
    error, from differences record by record. chosen : in how many inner loops it was taken.

    Examples
    --------
    >>> runs = [pam.simulate(plant, {"muscle.command": u}, duration=1.0) for u in (2e5, 3e5, 4e5)]
    >>> ways = {"horizon": [0.1], "every": 0.1}
    >>> orders = {
    ...     f"order {n}": pam.fitting.ArxStructure(["x"], ["muscle.command"], n, **ways)
    ...     for n in (1, 2)
    ... }
    >>> choice = pam.fitting.choose(orders, runs, folds=3, seed=1)
    >>> [tried.name for tried in choice.tried]  # the simplest first
    ['order 1', 'order 2']
    """

    name: str
    complexity: float
    loss: Array
    score: float
    behind: float
    error: float
    chosen: int
    seconds: float
    """Processor time of its fit to one training set, on average."""
    failures: tuple[str, ...] = ()
    losses: Array = field(default_factory=lambda: np.empty((0, 0)), repr=False)
    """Of every record, by a fit without its fold (n, m)."""


@dataclass(frozen=True, eq=False)
class Choice:
    """The chosen structure, and what its choice is worth.

    name, model : chosen by cross-validation over all records, and fitted to all of them (None with
    ``refit=False``). tried : every structure, the simplest first. nested : loss of *choosing* (n,
    m): each record is judged by what was chosen and fitted without its fold; its mean is the honest
    figure, ``tried[...].loss`` of the winner is too good. chosen : the name in each fold. folds :
    the fold of each record. seed : that made them.

    Examples
    --------
    >>> runs = [pam.simulate(plant, {"muscle.command": u}, duration=1.0) for u in (2e5, 3e5, 4e5)]
    >>> ways = {"horizon": [0.1], "every": 0.1}
    >>> orders = {
    ...     f"order {n}": pam.fitting.ArxStructure(["x"], ["muscle.command"], n, **ways)
    ...     for n in (1, 2)
    ... }
    >>> choice = pam.fitting.choose(orders, runs, folds=3, seed=1)
    >>> choice.name in orders, choice.nested.shape
    (True, (3, 1))
    """

    name: str
    model: Any = field(repr=False)
    tried: tuple[Tried, ...] = field(repr=False)
    nested: Array = field(repr=False)
    chosen: tuple[str, ...]
    folds: NDArray[np.intp] = field(repr=False)
    seed: int
    criteria: tuple[str, ...]
    rule: Rule
    seconds: float

    def __getitem__(self, name: str) -> Tried:
        return next(t for t in self.tried if t.name == name)

    @property
    def rmse(self) -> dict[str, float]:
        """Root of the nested loss by criterion: what to expect of the choice on new records."""
        return dict(zip(self.criteria, np.sqrt(mean_loss(self.nested)).tolist(), strict=True))

    def table(self) -> str:
        """What was tried, as text: the RMSE of each structure by criterion, its price, its fate."""
        width = max(12, *(len(t.name) + 2 for t in self.tried))
        wide = max(11, *(len(c) + 2 for c in self.criteria))
        head = "".join(f"{c:>{wide}}" for c in self.criteria)
        lines = [
            f"{len(self.folds)} records in {int(self.folds.max()) + 1} folds (seed {self.seed}), "
            f"nested cross-validation, {self.seconds:.1f} s",
            f"  {'structure':<{width}}{'size':>6}{head}{'behind the best':>22}{'chosen':>8}"
            f"{'fit [s]':>9}",
        ]
        for t in self.tried:
            row = "".join(f"{x:>{wide}.4g}" for x in np.sqrt(t.loss))
            behind = "failed" if not np.isfinite(t.score) else f"{t.behind:.3f} ± {t.error:.3f}"
            lines.append(
                f"{'>' if t.name == self.name else ' '} {t.name:<{width}}{t.complexity:>6g}{row}"
                f"{behind:>22}{t.chosen:>8}{t.seconds:>9.2f}"
            )
            lines += [f"      failed: {text}" for text in sorted(set(t.failures))]
        row = "".join(f"{x:>{wide}.4g}" for x in self.rmse.values())
        lines.append(
            f"  {'the choice':<{width}}{'':>6}{row}   (nested: what new records will show)"
        )
        lines += [f"  warning: {text}" for text in getattr(self.model, "warnings", ())]
        return "\n".join(lines)

    __str__ = table
