"""Free runs: a plant left to itself from many moments of a record, and the fit that makes them
best.

A model for prediction is judged by how far it goes astray within a horizon from the present: from
each start on it knows the measured inputs, but of the measured motion only the past. ``fit_plant``
asks another question (one motion through the whole record, its start unknown): where friction or an
unstable plant make a long motion forget its start, many short runs are what can be fitted.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...core.errors import FitError, InputError, require_count, require_names
from ...core.quantities import outside
from ...core.stop import TimeIsUp, spared, verb
from ...core.trajectory import Trajectory
from ...plants.plant import Plant
from ..statistics import Array
from .experiment import decided, groups, measured_names, recorded
from .free_run_result import FreeRunFit, fine_runs, fineness, spread_of, told
from .gauss_newton import GRACE, Descent, Progress, descend, from_fewer, reporter
from .rig import (
    Delay,
    Rig,
    RunUnknowns,
    disturbed,
    given_starts,
    known_rig,
    unknowns_of,
)
from .rollout import Rollout, followed, require_followed
from .runs import LEAST_STEPS, MOST_STEPS, FreeRun, hidden_states, runs_of, settled_starts

ASTRAY_COST = 1.0
"""Mean squared error, in parts of the measured variance, from which runs count as astray."""
POOR = 1e-3
"""The same, from which fits with one unknown less are tried as starts."""
FIRST = 4
"""A search over many runs begins with horizons of so many samples, which grow this many times."""


@verb
def free_run(
    plant: Plant,
    records: Trajectory | Sequence[Trajectory],
    *,
    horizon: float | Sequence[float] | None,
    every: float | None = None,
    outputs: Sequence[str] | None = None,
    history: int = 3,
    steps: int | None = None,
    warm_up: float = 0.0,
    delay: float | Mapping[str, float] = 0.0,
    gains: Mapping[str, float] | None = None,
    offsets: Mapping[str, float] | None = None,
    starts: Mapping[str, float] | None = None,
    corrections: Mapping[tuple[str, str], float] | None = None,
) -> FreeRun:
    """Run a plant from many moments of records, with the measured inputs.

    A run starts every ``every`` seconds of each record, where ``history`` samples of the past and
    the horizon are in it. Measured states start as measured, velocities (of measured positions)
    with the slope of the straight line through the last ``history`` samples, all other states at
    the plant's start values. Nothing measured after the start is used but the inputs.

    Parameters
    ----------
    records : equally sampled Trajectories, all at the same rate, with all inputs of the plant.
    horizon, every : length of a run, and from start to start [s]; multiples of the sampling time.
        Of several horizons, runs are as long as the longest that the record allows; None runs each
        record as a whole, from its first samples on.
    outputs : states and outputs to compare; by default all that the records hold.
    history : samples for the initial velocity, at least 2.
    steps : of the integration in each sampling interval: the Rosenbrock method ROS2 (J. G. Verwer
        et al., SIAM J. Sci. Comput. 20 (1999) 1456-1480), of second order and L-stable. Where an
        input that is held jumps between samples, late by a dead time, a step begins. By default so
        many that twice as many change runs by less than a thousandth of their reach, at most 64.
    warm_up : [s] before each start that the plant runs along the past, so that states which are not
        measured (pressures, creep, slip) come to where they belong; at its samples ``corrections``
        pull it to what was measured (an observer; D. Luenberger, IEEE Trans. AC 16 (1971) 596).
    delay : dead time of all inputs [s], or by input. gains, offsets : of sensors.
    starts : {state that is not measured: where runs begin}. corrections : {(state, measured
        variable): gain}.

    Raises InputError, UnknownNameError (records without an input, of unequal rates, too short).

    Examples
    --------
    >>> run = pam.fitting.free_run(plant, record, horizon=0.3, every=0.2, outputs=["x"])
    >>> run.names, run.rmse["x"] < 1e-3
    (('x',), True)
    """
    first = LEAST_STEPS if steps is None else steps
    runs = runs_of(plant, records, horizon, every, outputs, history, first, warm_up)
    rig = known_rig(plant, runs.names, delay, gains, offsets, starts, corrections)
    nothing = np.empty(0)
    rollout = Rollout(plant, runs, None, rig)
    predicted = rollout.predicted(nothing)
    while steps is None and 2 * rollout.runs.steps <= MOST_STEPS:
        finer = rollout.finer()
        better = finer.predicted(nothing)
        if fine_runs(predicted, better):
            break
        rollout, predicted = finer, better
    return told(runs.result(predicted))


@verb
def fit_free_run(
    plant: Plant,
    records: Trajectory | Sequence[Trajectory],
    free: Sequence[str | Sequence[str]],
    *,
    horizon: float | Sequence[float] | None,
    every: float | None = None,
    outputs: Sequence[str] | None = None,
    history: int = 3,
    steps: int | None = None,
    warm_up: float = 0.0,
    delay: Delay = 0.0,
    gains: Sequence[str] = (),
    offsets: Sequence[str] = (),
    starts: Mapping[str, str] | Sequence[str] = (),
    correct: Mapping[str, Sequence[str]] | bool = False,
    disturbance: Sequence[str] = (),
    bounds: Mapping[str, tuple[float, float]] | None = None,
    begin_short: bool | None = None,
    evaluations: int = 60,
    progress: Progress = False,
    time_limit: float | None = None,
    judge: bool = True,
) -> FreeRunFit:
    """Fit parameters so that free runs (see :func:`free_run`) stay near what was measured.

    Least squares over all samples of all runs, each variable in units of its spread, several
    horizons with equal weight, by damped Gauss-Newton steps with exact derivatives. Where runs go
    astray at the plant's values, horizons grow from a few samples to the whole. It finds the
    minimum nearest to the plant's values: friction makes several, so start from more than one.

    free : names, tuples or patterns of parameters, as for :func:`fit_plant`.
    delay : dead time of the inputs [s], for all or ``{input or pattern: ...}``; (low, high) is
        estimated. Below zero where a record shows an input later than it acted.
    gains, offsets : measured variables whose sensor has an unknown gain, or offset.
    starts : where states that are not measured begin. By default each record has a start of its
        own for them, which is estimated, and runs from later moments begin where the plant has
        come by then along the inputs; of whole records the measured states and velocities have
        one, too. Names or patterns here have one start for all runs, or {name: "all", "record"
        (one for all runs of a record), or "plant" (the plant's start value)}.
    correct : True to estimate how much of its error a run takes up at each sample of ``warm_up``
        (measured states and their velocities), and {other state: [measured variables]} for those.
    steps : see :func:`free_run`; by default so many that twice as many would move no value by more
        than 0.2 of its standard errors, and no run by more than 5 % of its error.
    disturbance : states whose rate is pushed by what is not modelled (a velocity by a force).
        Each gets a state that the observer finds along ``warm_up`` and that is forgotten with a
        fitted rate; ``fit.plant`` has it.
    bounds : {free parameter: (low, high)}, within those of its variable.
    begin_short : whether horizons grow; by default where runs of more than 16 samples go astray at
        the plant's values.
    evaluations : of all runs with their derivatives, at most; those of shorter horizons count by
        their samples. Other arguments as for :func:`free_run`. Where a record does not say how its
        inputs ran between samples, both ways are fitted and the likelier counts.
    progress : True prints each step; a function is called as progress(stage, evaluations, cost).
    time_limit : [s]; the best until then is kept, and the fit says so. OutOfTime where there is
        none.
    judge : whether the residuals are tested at once and a warning says so where the model is
        inadequate; ``fit.adequacy`` does it when it is asked for.

    Raises InputError, UnknownNameError (arguments that cannot be), FitError (the runs diverge at
    the start, or a parameter has no influence on them).

    Examples
    --------
    >>> found = pam.fit_free_run(plant, record, ["mass"], horizon=0.3, every=0.2, outputs=["x"])
    >>> abs(found.values["mass"] - 10.0) < 0.1
    True
    """
    began = time.perf_counter()
    chosen = recorded(records)
    pushed: dict[str, tuple[str, int]] = {}
    if disturbance:
        groups(plant, free, bounds)  # refused in terms of the plant that was given
        names = require_names("disturbance", disturbance)
        plant, rates, pushed = disturbed(plant, names, measured_names(plant, chosen, outputs))
        free, correct = [*free, *rates], correct or True
    wanted = groups(plant, free, bounds)
    options: dict[str, Any] = {
        "horizon": horizon,
        "every": every,
        "outputs": outputs,
        "history": history,
        "steps": steps,
        "warm_up": warm_up,
    }
    first = LEAST_STEPS if steps is None else steps
    runs = runs_of(plant, records, **{**options, "steps": first})  # refuses wrong arguments at once
    if correct and not runs.warm:
        argument = "disturbance" if disturbance else "correct"
        raise InputError(f"{argument} needs warm_up=...: seconds before each start to correct in")
    given = {n for _, _, names in given_starts(plant, starts) for n in names}
    hidden = hidden_states(plant, runs.names, {*given, *pushed}, horizon is None)
    guesses = settled_starts(plant, runs, len(chosen), hidden).T
    unknowns, rig = unknowns_of(
        plant,
        wanted,
        runs.names,
        len(chosen),
        float(runs.t[0]),
        delay=delay,
        gains=gains,
        offsets=offsets,
        starts=starts,
        correct=correct,
        pushed=pushed,
        hidden=dict(zip(hidden, guesses, strict=True)),
    )
    if not unknowns.shared:
        raise InputError("free is empty: name at least one parameter of the plant")
    most = require_count("evaluations", evaluations)
    search = _Search(plant, unknowns, rig, options, most, begin_short, reporter(progress))

    def fitted(ran: Sequence[Trajectory]) -> tuple[FreeRunFit, float]:
        fit = search(ran)
        count = int(np.sum(~np.isnan(fit.training.measured)))
        return fit, count * float(np.log(max(fit.cost[1], 1e-300)))

    fit, between, why = decided(plant, chosen, fitted)
    fit = replace(fit, interpolation=between, inputs_ran=why)
    words = fit.training.warnings + fit.coarse
    if judge and fit.converged:
        words += (fit.adequacy.sentence,)
    for text in filter(None, words):
        warnings.warn(text, RuntimeWarning, stacklevel=outside())
    object.__setattr__(fit, "seconds", time.perf_counter() - began)
    return fit


@dataclass(frozen=True, eq=False)
class _Search:
    """The fit to records whose inputs are known between samples."""

    plant: Plant
    unknowns: RunUnknowns
    rig: Rig
    options: Mapping[str, Any]
    evaluations: int
    begin_short: bool | None
    report: Any

    def __call__(self, records: Sequence[Trajectory]) -> FreeRunFit:
        """With steps so short that shorter ones say the same, where none were given."""
        given = self.options["steps"]
        guess = self.unknowns.guess
        steps = LEAST_STEPS if given is None else given
        while given is None and steps < MOST_STEPS:
            if followed(self._rollout(records, steps=steps), guess):
                break
            steps *= 2
        fit, found = self._fitted(records, steps, guess)
        while given is None and not fit.fine and 2 * steps <= MOST_STEPS and not found.timed:
            steps *= 2
            search, z = replace(self, begin_short=False), found.z
            if not followed(self._rollout(records, steps=steps), z):
                search, z = self, guess  # an optimum that only long steps have
            try:
                finer, found = search._fitted(records, steps, z, found.evaluations)
            except TimeIsUp:
                break  # the fit says that its steps are long
            fit = replace(finer, cost=(fit.cost[0], finer.cost[1]))
        return fit

    def _rollout(self, records: Sequence[Trajectory], **options: Any) -> Rollout:
        """``options`` of the runs that differ."""
        runs = runs_of(self.plant, records, **{**self.options, **options})
        return Rollout(self.plant, runs, self.unknowns, self.rig)

    def _fitted(
        self, records: Sequence[Trajectory], steps: int, z: Array, spent: int = 0
    ) -> tuple[FreeRunFit, Descent]:
        search = replace(self, options={**self.options, "steps": steps})
        rollout = search._rollout(records)
        before, found = search._descended(records, rollout, z)
        if spent == 0 and found.cost > POOR and not found.timed:
            found = search._not_worse(records, rollout, found, z)
        found = replace(found, evaluations=spent + found.evaluations)
        with spared(GRACE):
            return search._result(records, rollout, before, found), found

    def _descended(
        self, records: Sequence[Trajectory], rollout: Rollout, z: Array
    ) -> tuple[float, Descent]:
        """Horizon by horizon; the search over the full ones has what evaluations are left."""
        u, spent, guess, before = self.unknowns, 0, z, rollout.cost(z)
        cost = 0.0  # of the evaluations, in those of the full horizon
        for h in self._stages(rollout, z, before):
            part = self._shorter(records, h)
            if spent == 0:
                _require_sense(part, z, u)
            found = self._search(part, z, f"{h:g} s", spent, max(self.evaluations // 6, 2))
            share = part.runs.length.sum() / rollout.runs.length.sum()
            cost += share * (found.evaluations - spent)
            spent, z = found.evaluations, found.z
            if found.timed:
                return before, found
        if spent == 0:
            _require_sense(rollout, z, u)
        elif not rollout.cost(z) < before:
            z = guess  # short runs say little of what takes long
        budget = max(self.evaluations - int(np.ceil(cost)), 1)
        return before, self._search(rollout, z, "full horizon", spent, budget)

    def _not_worse(
        self, records: Sequence[Trajectory], rollout: Rollout, found: Descent, z: Array
    ) -> Descent:
        """The same, or what is found from where fits with one unknown less lead."""
        u = self.unknowns
        spare = [j for j in range(u.shared) if u.rows[j].kind != "corrections"]
        budget = max(self.evaluations - found.evaluations, 4)

        def without(j: int) -> Descent:
            low, high = u.low.copy(), u.high.copy()
            low[j] = high[j] = z[j]
            fixed = replace(self, unknowns=u.changed(low=low, high=high))
            return fixed._descended(records, rollout, z)[1]

        def again(poorer: Descent) -> Descent:
            return self._search(rollout, poorer.z, "from fewer unknowns", 0, budget)

        places = spare if len(spare) > 1 else ()
        best = from_fewer(found, lambda f: f.cost, places, without, again)
        return replace(best, evaluations=max(best.evaluations, found.evaluations))

    def _search(self, rollout: Rollout, z: Array, stage: str, spent: int, budget: int) -> Descent:
        u = self.unknowns
        found = descend(
            rollout,
            z,
            u.low,
            u.high,
            budget,
            progress=lambda count, cost, _: self.report(stage, spent + count, cost),
        )
        return replace(found, evaluations=spent + found.evaluations)

    def _stages(self, rollout: Rollout, z: Array, cost: float) -> list[float]:
        """Horizons [s] before the full one, from short to long, where runs go astray at once."""
        runs = rollout.runs
        longest = int(runs.length.max())
        if self.begin_short is None:
            wanted = longest > FIRST**2 and (cost > ASTRAY_COST or rollout.normal(z)[3] > 0)
        else:
            wanted = self.begin_short
        found, h = [], longest
        while wanted and h > FIRST**2:
            h = max(h // FIRST, FIRST)
            found.append(h)
        return [float(runs.t[h - 1]) for h in reversed(found)]

    def _shorter(self, records: Sequence[Trajectory], horizon: float) -> Rollout:
        """Runs of this length: as many as cover the records once, or the same cut short where
        states have starts of their own.
        """
        u, every = self.unknowns, self.options["every"]
        if every is None:
            return self._rollout([r.at(r.t[: self._samples(r, horizon)]) for r in records])
        same = bool(u.of("starts") or u.own_starts)
        every = every if same else max(every, horizon)
        return self._rollout(records, horizon=horizon, every=every)

    def _samples(self, record: Trajectory, horizon: float) -> int:
        """Of the past and a horizon, at the begin of a record."""
        sampling = record.duration / (len(record) - 1)
        before = self.options["history"] - 1 + round(self.options["warm_up"] / sampling)
        return int(min(len(record), before + round(horizon / sampling) + 1))

    def _result(
        self,
        records: Sequence[Trajectory],
        rollout: Rollout,
        before: float,
        found: Descent,
    ) -> FreeRunFit:
        u, runs = self.unknowns, rollout.runs
        values = u.parameters(self.plant, found.z)
        fitted = self.plant.with_values(values)
        rig = u.rig(self.plant, runs.names, self.rig, found.z)
        predicted = rollout.predicted(found.z)
        training = runs.result(predicted)
        own = found.z[u.shared :] * u.scale[u.shared :]
        spread = spread_of(rollout, found.z)
        # hidden starts that are found by default are nobody's question
        named = u.shared if u.along else len(u.names)
        steps = fineness(rollout, found.z, spread)
        return FreeRunFit(
            fitted,
            training,
            values,
            tuple(n for n, at in zip(u.names[:named], spread.edge, strict=False) if at),
            dict(zip(runs.names, steps.gap.tolist(), strict=True)),
            (before, found.cost),
            found.status,
            found.evaluations,
            0.0,
            options=self.options,
            rig=rig,
            own_starts={
                self.plant.states[s].name: own[k :: len(u.own_starts)]
                for k, s in enumerate(u.own_starts)
            },
            spread=spread,
            moved=dict(zip(spread.coefficients, steps.moved.tolist(), strict=True)),
            fine=steps.fine,
            converged=found.converged,
            records=tuple(records),
            unknowns=u,
            z=found.z,
        )


def _require_sense(rollout: Rollout, z: Array, unknowns: RunUnknowns) -> None:
    require_followed(rollout, z)
    _, _, square, damped = rollout.normal(z)
    # a correction may begin where the runs need none, and a hidden start may be forgotten at once
    fixed = ("corrections", "own_starts") if unknowns.along else ("corrections",)
    dead = [
        r.name
        for j, r in enumerate(unknowns.rows)
        if not square[j, j] > 0 and r.kind not in fixed and r.low < r.high
    ]
    if not dead:
        return
    if not damped:
        raise FitError(f"{', '.join(dead)} has no influence on the free runs; leave it out of free")
    raise FitError(
        f"what {', '.join(dead)} does to the free runs cannot be told: {damped} of them part ways "
        "or diverge so soon that their sensitivities mean nothing, and the others do not depend on "
        "it; take a shorter horizon or more steps, or start elsewhere with plant.with_values(...)"
    )
