"""Many cases at once, and the numbers that are kept of them.

Cases that differ in numbers only (parameters, start values, constant inputs) go to the plant's
machine code as rows of one array; all others, and those that are out of range or that the solver
gives up, are simulated one by one, with the errors that belong to them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, kind_of, require_numbers
from ..core.signals import PiecewisePolynomial, signals
from ..core.trajectory import Trajectory
from ..plants.plant import Plant
from .integrate import COMPILED_PART, Integration, evaluated
from .reducers import GRAMMAR, Reduction, parsed
from .simulator import simulate, start_of, times_of

Array: TypeAlias = NDArray[np.float64]
Keep: TypeAlias = "Mapping[str, str | Callable[[Trajectory], float]]"
Case: TypeAlias = Mapping[str, Any]
Result: TypeAlias = "Trajectory | Exception"

BATCH = 250
"""Cases of a batch: some tenths of a second of work, and small beside what a worker is."""
CASE_KEYS = ("parameters", "start", "inputs")
CAUSALITY = {"parameters": "parameter", "start": "state", "inputs": "input"}
USUAL: Mapping[str, tuple[Any, ...]] = {
    "events": ((), [], ""),
    "method": ("rosenbrock",),
    "step": (None,),
    "dead_times": ("line",),
    "time_limit": (None,),
}
"""With other values of these arguments, cases are simulated one by one."""


@dataclass(frozen=True, eq=False)
class Simulation:
    """A plant and what is the same for all its cases; called with a case."""

    plant: Plant
    common: Mapping[str, Any]

    def __call__(self, case: Case) -> Trajectory:
        return simulate(self.plant, **self.arguments(case))

    def arguments(self, case: Case) -> dict[str, Any]:
        """Of simulate, for one case."""
        arguments = dict(self.common)
        for key in CASE_KEYS:
            if key in case:
                both = isinstance(case[key], Mapping) and isinstance(arguments.get(key), Mapping)
                arguments[key] = {**arguments[key], **case[key]} if both else case[key]
        return arguments


# ---- cases in rows -------------------------------------------------------------------------------
@dataclass(frozen=True)
class Batch:
    """Neighbouring cases, the first of them numbered ``first``.

    names : (key, name) of each column of ``values``, which holds a row for each case; where cases
        are other than that, ``cases`` holds them as they are.
    """

    first: int
    names: tuple[tuple[str, str], ...] = ()
    values: Array = field(default_factory=lambda: np.empty((0, 0)))
    cases: tuple[Case, ...] = ()

    def __len__(self) -> int:
        return len(self.cases) or len(self.values)

    def case(self, i: int) -> Case:
        """As simulate_many took it."""
        if self.cases:
            return self.cases[i]
        found: dict[str, dict[str, float]] = {}
        for (key, name), value in zip(self.names, self.values[i].tolist(), strict=True):
            found.setdefault(key, {})[name] = value
        return found

    def singles(self) -> Iterator[Batch]:
        """Each case alone."""
        for i in range(len(self)):
            yield Batch(self.first + i, cases=(self.case(i),))

    @property
    def parameters(self) -> dict[str, Array]:
        """{name: (cases,)} of what the cases name; NaN where one does not."""
        if not self.cases:
            own = enumerate(self.names)
            return {n: self.values[:, i] for i, (key, n) in own if key == "parameters"}
        found: dict[str, Array] = {}
        for i, case in enumerate(self.cases):
            given = case.get("parameters")
            for name, value in given.items() if isinstance(given, Mapping) else ():
                if plain(value):
                    found.setdefault(str(name), np.full(len(self), np.nan))[i] = float(value)
        return found

    def told(self) -> list[Any]:
        """For a digest."""
        return [self.first, self.names, self.values, self.cases]


def batches(cases: Iterable[Case], first: int = 0) -> Iterator[Batch]:
    """Of ``BATCH`` cases each; they end at multiples of it, wherever the first one is."""
    stream = iter(cases)
    while part := tuple(islice(stream, BATCH - first % BATCH)):
        yield _batch(first, part)
        first += len(part)


def _batch(first: int, cases: tuple[Case, ...]) -> Batch:
    names = _columns(cases[0])
    if names is None:
        return Batch(first, cases=cases)
    rows = [_row(case, names) for case in cases]
    if any(row is None for row in rows):
        return Batch(first, cases=cases)
    return Batch(first, names, np.array(rows, float).reshape(len(cases), len(names)))


def _columns(case: Case) -> tuple[tuple[str, str], ...] | None:
    """What a case names, where that is numbers alone."""
    if not all(isinstance(case.get(k, {}), Mapping) for k in CASE_KEYS):
        return None
    names = tuple((k, n) for k in CASE_KEYS for n in case.get(k, {}))
    return names if all(isinstance(n, str) for _, n in names) else None


def _row(case: Case, names: tuple[tuple[str, str], ...]) -> list[float] | None:
    """The numbers of a case in this order; None where it names others, or gives no numbers."""
    try:
        if sum(len(part) for part in case.values()) != len(names):
            return None
        row = [case[key][name] for key, name in names]
    except (KeyError, TypeError):
        return None
    return row if all(map(plain, row)) else None


def plain(value: Any) -> bool:
    """Whether a value is a number as it stands."""
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


# ---- what is kept --------------------------------------------------------------------------------
@dataclass(frozen=True)
class Rows:
    """What comes of a batch: a row for each case.

    numbers : {name: (cases,)}, NaN where there is none. errors : {place in the batch: error}.
    """

    batch: Batch
    numbers: Mapping[str, Array]
    errors: Mapping[int, Exception]


def keep_of(plant: Plant, keep: Keep) -> dict[str, Reduction | Callable[[Trajectory], float]]:
    """What is to be kept, parsed. Raises InputError, UnknownNameError."""
    if not isinstance(keep, Mapping) or not keep:
        raise InputError(f"keep = {keep!r}: give {{name: words or a function}}; {GRAMMAR}")
    kinds = ("state", "input", "output", "parameter")
    known = [v for kind in kinds for v in plant.variables if v.causality == kind]
    found: dict[str, Reduction | Callable[[Trajectory], float]] = {}
    for name, said in keep.items():
        if not isinstance(name, str) or not name or name in ("case", "error"):
            raise InputError(f"keep: {name!r} is no name for a column; 'case' and 'error' are ours")
        if isinstance(said, str):
            found[name] = parsed(f"keep[{name!r}]", said, known)
        elif callable(said):
            found[name] = said
        else:
            raise InputError(
                f"keep[{name!r}] is {kind_of(said)}: give words such as 'x.final', or a "
                "function of a Trajectory"
            )
    return found


@dataclass(frozen=True, eq=False)
class Numbers:
    """The numbers kept of a batch of cases; called with a Batch.

    together : cases that differ in numbers only are stepped side by side.
    """

    simulation: Simulation
    keep: Mapping[str, Reduction | Callable[[Trajectory], float]]
    together: bool = True

    def __call__(self, batch: Batch) -> Rows:
        numbers = {name: np.full(len(batch), np.nan) for name in self.keep}
        errors: dict[int, Exception] = {}
        left = np.arange(len(batch))
        found = self._at_once(batch) if self.together and not batch.cases else None
        if found is not None:
            motions, done = found
            self._keep(motions, np.flatnonzero(done), numbers, errors)
            left = np.flatnonzero(~done)
        for i in left.tolist():
            try:
                single = self._single(batch.case(i))
            except Exception as error:  # whatever a case brings with it
                errors[i] = error
            else:
                self._keep(single, np.array([i]), numbers, errors)
        for i in errors:
            for column in numbers.values():
                column[i] = np.nan
        return Rows(batch, numbers, errors)

    def _single(self, case: Case) -> _Single:
        arguments = self.simulation.arguments(case)
        motion = simulate(self.simulation.plant, **arguments)
        return _Single(motion, self.simulation.plant.with_values(arguments.get("parameters")))

    def _keep(
        self,
        motions: _Motions | _Single,
        places: NDArray[np.intp],
        numbers: Mapping[str, Array],
        errors: dict[int, Exception],
    ) -> None:
        """Put the numbers of some motions into their places."""
        if not len(places):
            return
        for name, kept in self.keep.items():
            if isinstance(kept, Reduction):
                numbers[name][places] = kept(motions.t, motions.signal, len(places))
                continue
            for k, i in enumerate(places.tolist()):
                try:
                    label = f"keep[{name!r}] of a motion"
                    numbers[name][i] = _number(label, kept(motions.trajectory(k)))
                except Exception as error:  # of a function of the user's
                    errors.setdefault(i, error)

    # ---- side by side ---------------------------------------------------------------------------
    def _at_once(self, batch: Batch) -> tuple[_Motions, NDArray[np.bool_]] | None:
        """The motions of those that came to their end, and which these are; None where these cases
        are not of that kind, or there is no machine code for them.
        """
        common = self.simulation.common
        if any(n in common and common[n] not in usual for n, usual in USUAL.items()):
            return None
        try:
            return self._stepped(batch)
        except InputError:  # to be told case by case
            return None

    def _stepped(self, batch: Batch) -> tuple[_Motions, NDArray[np.bool_]] | None:
        arguments = self.simulation.arguments(batch.case(0))
        if not isinstance(arguments.get("start") or {}, Mapping):
            return None
        plant = self.simulation.plant.with_values(arguments.get("parameters"))
        times = times_of(*(arguments.get(n) for n in ("inputs", "duration", "t")))
        inputs, rtol = arguments.get("inputs"), arguments.get("rtol", 1e-10)
        u = signals(plant, inputs, times, arguments.get("interpolation", "previous"))
        x0 = plant.vector("state", start_of(plant, inputs, arguments.get("start")))
        more = {n: arguments[n] for n in ("max_steps", "compiled") if n in arguments}
        run = Integration.over(plant, u, times, x0, rtol=rtol, **more)
        machine = run.machine
        if machine is None:
            return None
        blocks = {"parameters": _rows_of(plant.vector("parameter"), batch)}
        blocks |= {"start": _rows_of(x0, batch), "inputs": run.u.coefficients[None]}
        if any(key == "inputs" for key, _ in batch.names):
            blocks["inputs"] = _rows_of(run.u.coefficients, batch)
        good = _filled(plant, batch, blocks)
        if good is None:
            return None
        states, done = machine.motions(
            replace(run.u, coefficients=blocks["inputs"][0]),
            blocks["inputs"],
            run.grid,
            blocks["start"],
            blocks["parameters"],
            plant.vector("state", attribute="nominal"),
            COMPILED_PART * rtol,
            run.max_steps,
            good,
        )
        place, own = np.flatnonzero(done), blocks["inputs"]
        driven: Any = u
        if len(own) > 1 or len(batch) == 1:
            driven = [replace(run.u, coefficients=own[i]) for i in place]
        rows = np.searchsorted(run.grid, times - 1e-12 * (1 + np.abs(times)))
        moved = states[place][:, rows], blocks["parameters"][place]
        return _Motions(plant, times, *moved, driven, machine.outputs), done


def _rows_of(values: Array, batch: Batch) -> Array:
    return np.repeat(values[None], len(batch), axis=0)


def _filled(plant: Plant, batch: Batch, blocks: Mapping[str, Array]) -> NDArray[np.bool_] | None:
    """Put the numbers of the cases into their blocks: which cases are within all ranges; None where
    a name is none of its kind.
    """
    good = np.ones(len(batch), bool)
    for column, (key, name) in enumerate(batch.names):
        variable, values = plant.variable(name), batch.values[:, column]
        if variable.causality != CAUSALITY[key]:
            return None
        same = [v.name for v in plant.variables if v.causality == variable.causality]
        at, block = same.index(variable.name), blocks[key]
        good &= (values >= variable.min) & (values <= variable.max) & np.isfinite(values)
        variable.doubt(values[good])
        if key == "inputs":
            block[:, :, 1:, at] = 0.0
            block[:, :, 0, at] = values[:, None]
        else:
            block[:, at] = values
    return good


def _number(label: str, value: Any) -> float:
    found = np.atleast_1d(require_numbers(label, value, ""))
    if found.size != 1:
        raise InputError(f"{label} has {found.size} numbers; give one")
    return float(found.ravel()[0])


@dataclass(frozen=True, eq=False)
class _Motions:
    """Motions on common times, of those cases that came to their end.

    states : (motions, times, nx). parameters : (motions, np). inputs : of all, or of each.
    """

    plant: Plant
    t: Array
    states: Array
    parameters: Array
    inputs: PiecewisePolynomial | Sequence[PiecewisePolynomial]
    outputs: Callable[[Array, Array, Array], Array]
    """As :class:`pam_ocp.simulation.integrate.Computes` has it."""
    _columns: dict[str, Array] = field(default_factory=dict)

    def signal(self, name: str) -> Array:
        """(motions, times) samples of a signal, or (motions, 1) values of a parameter."""
        if name not in self._columns:
            kind = self.plant.variable(name).causality
            variables = [v.name for v in self.plant.variables if v.causality == kind]
            if kind == "parameter":
                return self.parameters[:, variables.index(name), None]
            block = self.states if kind == "state" else self._u if kind == "input" else self._y
            for i, own in enumerate(variables):
                self._columns[own] = np.ascontiguousarray(block[:, :, i])
        return self._columns[name]

    @property
    def _u(self) -> Array:
        if isinstance(self.inputs, PiecewisePolynomial):
            return np.repeat(self.inputs(self.t)[None], len(self.states), axis=0)
        return np.stack([u(self.t) for u in self.inputs])

    @property
    def _y(self) -> Array:
        rows = zip(self.states, self._u, self.parameters, strict=True)
        return np.stack([self.outputs(*row) for row in rows])

    def trajectory(self, k: int) -> Trajectory:
        """One of them."""
        own = {v.name: p for v, p in zip(self.plant.parameters, self.parameters[k], strict=True)}
        u = self.inputs if isinstance(self.inputs, PiecewisePolynomial) else self.inputs[k]
        return evaluated(self.plant.with_values(own), self.t, self.states[k], u, (), self)


@dataclass(frozen=True, eq=False)
class _Single:
    """A motion of its own, as simulate made it, and the plant that moved."""

    motion: Trajectory
    plant: Plant

    @property
    def t(self) -> Array:
        return self.motion.t

    def signal(self, name: str) -> Array:
        """As of :class:`_Motions`."""
        if name in self.motion:
            return self.motion[name][None]
        return np.array([[self.plant.variable(name).start]], float)

    def trajectory(self, k: int) -> Trajectory:
        """The one."""
        return self.motion
