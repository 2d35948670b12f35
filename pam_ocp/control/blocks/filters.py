"""Kalman filters as blocks: about a stop (stationary), and of the nonlinear plant (extended)."""

from __future__ import annotations

from collections.abc import Iterable

import casadi as ca
import numpy as np

from ...core.block import Block
from ...core.variables import Variable
from ..estimators.extended_kalman import Estimator, KalmanFilter
from ..estimators.smoother import noise_of_step
from ..estimators.stationary import StationaryFilter, WithEstimate
from .chain import chain
from .draft import Draft, Symbol, opened_by
from .kinds import BLOCKS, LARGEST, law_of

__all__ = [
    "extended_filter",
    "kept_variables",
    "stationary_filter",
    "with_estimate",
]


def _acting(draft: Draft, given: dict[str, Symbol], inputs: Iterable[Variable]) -> list[Symbol]:
    """Inputs of a plant that acted since the last step, within their range."""
    found = []
    for v in inputs:
        value = given.get(v.name, draft.kind(v.start or 0.0))
        value = ca.fmax(value, v.min) if np.isfinite(v.min) else value
        found.append(ca.fmin(value, v.max) if np.isfinite(v.max) else value)
    return found


@BLOCKS.register("StationaryFilter")
def stationary_filter(filter: StationaryFilter, name: str = "filter") -> Block:
    """The estimate of states and disturbances, as :class:`StationaryFilter`.

    Inputs are what is measured (NaN where a value is missing: the others correct alone) and the
    commands sent since the last step; outputs ``estimate.NAME``.
    """
    point, draft = filter.point, Draft(name, filter.sample_time, "stationary Kalman filter")
    plant = point.plant
    whole = filter.inversion.plant if filter.inversion else plant
    measured = [plant.variable(n) for n in filter.measured]
    names = [v.name for v in plant.states]
    kept = [plant.variable(n) for n in (*names, *filter.disturbances)]
    deviation = ca.vertcat(
        *(
            draft.memory(
                f"deviation.{v.name}", unit=v.unit, nominal=v.nominal, description="x - x0"
            )
            for v in kept
        )
    )
    started = draft.memory("started", description="1 after the first step")
    given = opened_by(filter.inversion, whole, draft)
    acted = _acting(draft, given, plant.inputs)
    moves = [
        0.0 if v.name in filter.disturbances else ca.if_else(started, u - float(u0), 0)
        for v, u, u0 in zip(plant.inputs, acted, point.u, strict=True)
    ]
    u = ca.vertcat(*moves)
    a, b, c, d = (ca.DM(np.asarray(getattr(filter.system, n))) for n in "ABCD")
    moved = ca.mtimes(a, deviation) + ca.mtimes(b, u)
    before = ca.vertcat(*(ca.if_else(started, moved[i], deviation[i]) for i in range(len(kept))))
    expected = ca.mtimes(c, before) + ca.mtimes(d, u)
    errors = []
    for i, v in enumerate(measured):
        y = draft.like(v, missing=True)
        good = ca.fabs(y) <= LARGEST
        seen = ca.if_else(good, y, 0)
        errors.append(ca.if_else(good, seen - float(filter._y0[i]) - expected[i], 0))
    after = before + ca.mtimes(ca.DM(filter.gain), ca.vertcat(*errors))
    estimate = ca.DM([point[v.name] for v in kept]) + after
    if filter.inversion and not filter.inversion.exact:
        x = estimate[: len(names)]
        back = filter.inversion.entering(False)(x, whole.vector("parameter"))
        estimate = ca.vertcat(back, estimate[len(names) :])
    for i, v in enumerate(kept):
        draft.next(f"deviation.{v.name}", after[i])
        draft.estimate(v, estimate[i])
    draft.next("started", draft.kind(1))
    return draft.block()


@BLOCKS.register("KalmanFilter")
def extended_filter(filter: KalmanFilter, name: str = "filter") -> Block:
    """The estimate of states and unknowns, as :class:`KalmanFilter`, begun anew.

    Inputs are what is measured (NaN where a value is missing) and the commands sent since the last
    step; outputs ``estimate.NAME`` and ``deviation.NAME``.
    """
    draft = Draft(name, filter.sample_time, "extended Kalman filter")
    kept, n = kept_variables(filter), len(filter.names)
    start_z, start_p = filter._first
    begin = zip(kept, start_z, strict=True)
    z = ca.vertcat(*(draft.memory(f"scaled.{v.name}", float(s)) for v, s in begin))
    rows = [
        [draft.memory(f"covariance.c{i}_{j}", float(start_p[i, j])) for j in range(n)]
        for i in range(n)
    ]
    p = ca.vertcat(*(ca.horzcat(*row) for row in rows))
    started = draft.memory("started", description="1 after the first step")
    sent = draft.sent(filter.given.controls)
    q = ca.DM(filter.given.vector())
    moved, a, half = filter._predict(z, sent, q)
    noise = noise_of_step(filter, a, half)
    p_moved = ca.mtimes(ca.mtimes(a, p), a.T) + noise
    z = _chosen(started, moved, z)
    p = _chosen(started, p_moved, p)
    value, jacobian = filter._measure(z, sent, q)
    z, p = _corrected(draft, filter, z, p, value, jacobian)
    for i, v in enumerate(kept):
        draft.next(f"scaled.{v.name}", z[i])
        draft.estimate(v, z[i] * float(filter._scale[i]))
        for j in range(n):
            draft.next(f"covariance.c{i}_{j}", p[i, j])
    for i, v in enumerate(kept):
        about = Variable(
            f"deviation.{v.name}", "output", unit=v.unit, nominal=v.nominal, min=0.0, start=0.0
        )
        draft.output(about, ca.sqrt(ca.fmax(p[i, i], 0)) * float(filter._scale[i]))
    draft.next("started", draft.kind(1))
    return draft.block()


def kept_variables(filter: Estimator) -> list[Variable]:
    """Variables of states and unknowns; that of an offset der(STATE) is offset.STATE."""
    found = []
    for name, scale in zip(filter.names, filter._scale, strict=True):
        if name.startswith("der("):
            found.append(Variable(f"offset.{name[4:-1]}", "output", nominal=float(scale)))
        else:
            found.append(filter.plant.variable(name))
    return found


def _corrected(
    draft: Draft, filter: Estimator, z: Symbol, p: Symbol, value: Symbol, jacobian: Symbol
) -> tuple[Symbol, Symbol]:
    """State and covariance after the measurement; one that is missing has no row."""
    errors, lines = [], []
    for i, v in enumerate(filter.measured):
        y = draft.like(v, missing=True)
        good = ca.fabs(y) <= LARGEST
        errors.append(ca.if_else(good, ca.if_else(good, y, 0) / v.nominal - value[i], 0))
        lines.append(ca.horzcat(*(ca.if_else(good, jacobian[i, j], 0) for j in range(z.numel()))))
    c, r = ca.vertcat(*lines), ca.diag(ca.DM(filter._noise**2))
    gain = ca.solve(ca.mtimes([c, p, c.T]) + r, ca.mtimes(c, p)).T
    keep = type(z).eye(z.numel()) - ca.mtimes(gain, c)
    p = ca.mtimes([keep, p, keep.T]) + ca.mtimes([gain, r, gain.T])
    z = z + ca.mtimes(gain, ca.vertcat(*errors))
    found = []
    for i, (low, high) in enumerate(zip(filter._low, filter._high, strict=True)):
        entry = ca.fmax(z[i], float(low)) if np.isfinite(low) else z[i]
        found.append(ca.fmin(entry, float(high)) if np.isfinite(high) else entry)
    return ca.vertcat(*found), p


def _chosen(condition: Symbol, yes: Symbol, no: Symbol) -> Symbol:
    """Entry by entry: yes where the condition holds."""
    flat = [
        ca.if_else(condition, a, b)
        for a, b in zip(ca.vertsplit(ca.vec(yes)), ca.vertsplit(ca.vec(no)), strict=True)
    ]
    return ca.reshape(ca.vertcat(*flat), *yes.shape)


@BLOCKS.register("WithEstimate")
def with_estimate(controller: WithEstimate, name: str = "with_estimate") -> Block:
    """A controller that sees the filter's estimate, as :class:`WithEstimate`."""
    parts = [stationary_filter(controller.filter), law_of(controller.controller)]
    return chain(parts, name=name)
