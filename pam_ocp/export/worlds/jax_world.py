"""A plant in JAX: pure functions for jit, vmap and grad, steps for batches, a term for diffrax."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from ...core.block import Block
from ...core.errors import InputError, require_count, require_positive
from ...core.lazy import library
from ...core.stop import verb
from ...numerics import rodas
from ...numerics.elementwise import array_table
from ...numerics.runge_kutta import rk4
from ...plants.plant import Plant, require_plant
from ..sampled import as_block
from .instructions import (
    REACH,
    Instructions,
    Signature,
    block_program,
    plant_programs,
    quickest,
    signature,
)
from .registry import WORLDS

Array: TypeAlias = Any
"""A jax.Array, or what becomes one."""
Parameters: TypeAlias = "Mapping[str, Any] | Any | None"
Method: TypeAlias = Literal["rk4", "rosenbrock"]

LAST = 1e-9
"""A part of a step, so little of which is left to an output time is made with it."""
ORDERS = {"rk4": 4, "rosenbrock": 5}


@verb
def to_jax(system: Plant | Block | Any) -> JaxPlant | JaxBlock:
    """A plant, or a block such as a controller, as pure functions of JAX.

    Written from CasADi's operations one by one, so values agree to rounding, and derivatives are
    those of the formulas. Numbers are single precision unless JAX is told otherwise, once, at the
    begin of a program: ``jax.config.update("jax_enable_x64", True)``.

    system : any Plant, a Block, or a controller, of which ``pam_ocp.control.block`` makes one.

    Raises InputError where JAX is missing, ExportError for what is no formula (docs/worlds.md).

    Examples
    --------
    >>> world = pam.export.to_jax(plant)  # doctest: +SKIP
    >>> world.states  # doctest: +SKIP
    ('x', 'v', 'muscle.pressure')
    >>> world.f(0.0, world.x0, world.u0, {"mass": 6.0}).shape  # doctest: +SKIP
    (3,)
    """
    library("jax", "jax", "to_jax")
    block = as_block(system)
    if block is not None:
        return JaxBlock(signature(block), block_program(block))
    return jax_plant(require_plant(system))


def jax_plant(plant: Plant) -> JaxPlant:
    """A plant's functions."""
    return JaxPlant(plant, signature(plant), *plant_programs(plant))


WORLDS.register("jax")(to_jax)


def _table(missing: bool) -> dict[str, Any]:
    from jax import numpy as jnp
    from jax.scipy import special

    more = {"pow": jnp.power, "constpow": jnp.power, "erf": special.erf, "erfinv": special.erfinv}
    return array_table(jnp, missing) | more


def _column(entries: list[Any], shape: tuple[int, ...]) -> Array:
    """Entries side by side along a new last axis, each of a shape."""
    from jax import numpy as jnp

    if not entries:
        return jnp.zeros((*shape, 0))
    return jnp.stack([jnp.broadcast_to(jnp.asarray(e, float), shape) for e in entries], axis=-1)


def _shape(*groups: list[Any]) -> tuple[int, ...]:
    return np.broadcast_shapes(*(np.shape(e) for group in groups for e in group))


@dataclass(frozen=True, eq=False)
class JaxBlock:
    """A sampled block: :meth:`step` is pure.

    Examples
    --------
    >>> world = pam.export.to_jax(law)  # doctest: +SKIP
    >>> memory, outputs = world.step(world.x0, inputs)  # doctest: +SKIP
    """

    signature: Signature
    _program: Instructions

    @property
    def x0(self) -> Array:
        """The memory at the start."""
        return _asarray(self.signature.x0)

    def step(self, memory: Array, inputs: Array, p: Parameters = None) -> tuple[Array, Array]:
        """(memory, outputs) behind one sample; arrays of (..., n), as the functions of plants."""
        groups = self.signature.groups(memory, inputs, p, ("memory", "inputs"))
        shape = _shape(*groups)
        results = self._program.run(_table(True), [g.__getitem__ for g in groups])
        return _column(results[0], shape), _column(results[1], shape)


def _asarray(values: Any) -> Array:
    from jax import numpy as jnp

    return jnp.asarray(values, float)


@dataclass(frozen=True, eq=False)
class JaxPlant:
    """A plant's functions; arrays have the states (inputs, outputs) along their last axis [SI].

    The axes before it are those of a batch, and broadcast. Parameters are a dictionary by name, of
    numbers or arrays of the batch's shape, those that are not named at the plant's values; or an
    array of all, in the order of ``parameters``. Functions are autonomous: t is there for solvers.

    Examples
    --------
    >>> world = pam.export.to_jax(plant)  # doctest: +SKIP
    >>> world.f(0.0, world.x0, world.u0, {"mass": 6.0})  # doctest: +SKIP
    """

    plant: Plant
    signature: Signature
    _xdot: Instructions
    _outputs: Instructions

    # ---- names and numbers --------------------------------------------------------------------
    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states, in order."""
        return self.signature.states

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs, in order."""
        return self.signature.inputs

    @property
    def output_names(self) -> tuple[str, ...]:
        """Names of the outputs, in order."""
        return self.signature.outputs

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters, in order."""
        return self.signature.parameters

    @property
    def x0(self) -> Array:
        """Start values of the states."""
        return _asarray(self.signature.x0)

    @property
    def u0(self) -> Array:
        """Start values of the inputs."""
        return _asarray(self.signature.u0)

    @property
    def p(self) -> dict[str, Array]:
        """The plant's parameters by name: a pytree, to be changed, batched and differentiated."""
        return {n: _asarray(v) for n, v in zip(self.parameters, self.signature.p0, strict=True)}

    # ---- functions ----------------------------------------------------------------------------
    def f(self, t: Any, x: Array, u: Array, p: Parameters = None) -> Array:
        """x' of shape (..., nx)."""
        return self._of(self._xdot, x, u, p)

    def outputs(self, t: Any, x: Array, u: Array, p: Parameters = None) -> Array:
        """y of shape (..., ny), in the order of ``output_names``."""
        return self._of(self._outputs, x, u, p)

    def _of(self, program: Instructions, x: Array, u: Array, p: Parameters) -> Array:
        groups = self.entries(x, u, p)
        results = program.run(_table(False), [g.__getitem__ for g in groups])
        return _column(results[0], _shape(*groups))

    def entries(self, x: Array, u: Array, p: Parameters) -> tuple[list[Any], list[Any], list[Any]]:
        """States, inputs and parameters, each as a list of arrays that broadcast."""
        return self.signature.groups(x, u, p)

    def slopes(self, x: list[Any], u: list[Any], p: list[Any]) -> list[Any]:
        """x' of entries, as entries."""
        return self._xdot.run(_table(False), [g.__getitem__ for g in (x, u, p)])[0]

    # ---- integration --------------------------------------------------------------------------
    def term(self, u: Callable[[Any], Array] | Array | None = None) -> Any:
        """A term for ``diffrax.diffeqsolve``; its ``args`` are the parameters.

        u : the inputs as a function of time, or held; None for their start values. With valves use
        an implicit solver (``diffrax.Kvaerno5``).

        Raises InputError where diffrax is missing.
        """
        diffrax = library("diffrax", "jax", "JaxPlant.term")
        held = self.u0 if u is None else u
        at = held if callable(held) else lambda t: held
        return diffrax.ODETerm(lambda t, x, args: self.f(t, x, at(t), args))

    def stepper(self, step: float, method: Method | None = None) -> JaxStepper:
        """Equal steps for batches.

        step : [s]. method : "rk4" (explicit, order 4), "rosenbrock" (Rodas5P: order 5, L-stable,
        for stiff plants), or None: rk4 where the step is short enough for it at the start values
        and at the ends of the inputs' ranges.

        Raises InputError for a step too long for rk4, which says how long it may be.
        """
        step = require_positive("step", step, "s")
        if method not in (None, *get_args(Method)):
            raise InputError(f"method = {method!r}: choose 'rk4', 'rosenbrock' or None")
        longest = self.longest
        if method is None:
            method = "rk4" if step <= longest else "rosenbrock"
        if method == "rk4" and step > longest:
            raise InputError(
                f"step = {step:g} s is too long for rk4, whose steps may be at most "
                f"{longest:.2g} s with this plant; give a shorter one, or method='rosenbrock'"
            )
        return JaxStepper(self, step, method)

    @cached_property
    def longest(self) -> float:
        """The longest step [s] that rk4 may take, by the quickest motion that decays at the start,
        at inputs over their ranges.
        """
        start = self.signature.u0
        low, high = (self.plant.vector("input", attribute=a) for a in ("min", "max"))
        ends = [np.where(np.isfinite(b), b, start) for b in (low, high)]
        largest = max(quickest(self.plant, u) for u in (start, *ends, (ends[0] + ends[1]) / 2))
        return REACH / largest if largest > 0 else float("inf")

    def simulate(
        self,
        t: Array,
        u: Array | None = None,
        x0: Array | None = None,
        p: Parameters = None,
        *,
        tolerance: float = 1e-10,
        max_steps: int = 100_000,
    ) -> Array:
        """States (n, nx) at the times t (n,), by steps of Rodas5P that follow the tolerance.

        u : inputs (nu,), or (n, nu), held from each time to the next; None for the start values.
        tolerance : of a step, scaled by nominals. max_steps : between two times; behind them, or
        where nothing leads on, states are NaN. One motion: batches by ``jax.vmap`` over x0, u and
        p. Slopes by forward mode (``jax.jvp``, ``jax.jacfwd``); for ``jax.grad`` use a stepper.

        Raises InputError for arrays of a wrong shape, and as :meth:`stepper`.
        """
        from jax import lax
        from jax import numpy as jnp

        t, nominal = _asarray(t), _asarray(self.signature.nominal)
        given = self.u0 if u is None else jnp.asarray(u, float)
        inputs = jnp.broadcast_to(given, (t.shape[0], len(self.inputs)))
        begin = self.x0 if x0 is None else jnp.asarray(x0, float)
        self.entries(begin, inputs[0], p)  # shapes

        def interval(carry: tuple[Array, Array], ends: Any) -> tuple[tuple[Array, Array], Array]:
            start, end, u = ends

            def attempt(now: tuple[Any, ...]) -> tuple[Any, ...]:
                at, z, suggested, count = now
                last = suggested >= (end - at) * (1 - LAST)
                h = jnp.where(last, end - at, suggested)
                new, wrong = self._rodas(z, u, p, h)
                error = jnp.where(jnp.isfinite(wrong), wrong / tolerance, jnp.inf)
                taken = error <= 1.0
                factor = rodas.SAFETY * jnp.maximum(error, rodas.LEAST_ERROR) ** -0.2
                after = h * jnp.clip(factor, rodas.SHRINK, rodas.GROW)
                kept = jnp.where(taken & last, jnp.maximum(suggested, after), after)
                arrived = jnp.where(last, end, at + h)
                return jnp.where(taken, arrived, at), jnp.where(taken, new, z), kept, count + 1

            def goes_on(now: tuple[Any, ...]) -> Any:
                at, _, h, count = now
                return (at < end) & (count < max_steps) & (h > rodas.SHORTEST * (end - start))

            first = (start, carry[0], jnp.minimum(carry[1], end - start), 0)
            at, z, h, _ = lax.while_loop(goes_on, attempt, first)
            z = jnp.where(at < end, jnp.nan, z)
            return (z, h), z

        start = (begin / nominal, _asarray(np.inf))
        _, rows = lax.scan(interval, start, (t[:-1], t[1:], inputs[:-1]))
        return jnp.concatenate([begin[None], rows * nominal])

    def _rodas(self, z: Array, u: Array, p: Parameters, h: Any) -> tuple[Array, Array]:
        """(z one step h of Rodas5P later, the largest estimated error (...,)), z = x/nominal."""
        import jax
        from jax import numpy as jnp

        nominal = _asarray(self.signature.nominal)

        def slope(z: Array) -> Array:
            return self.f(0.0, z * nominal, u, p) / nominal

        unit = jnp.eye(z.shape[-1], dtype=z.dtype)
        columns = jax.vmap(lambda d: jax.jvp(slope, (z,), (jnp.broadcast_to(d, z.shape),))[1])(unit)
        jacobian = jnp.moveaxis(columns, 0, -1)
        inverse = jnp.linalg.inv(unit / (h * rodas.GAMMA) - jacobian)
        a, c = (jnp.asarray(m, z.dtype) for m in _stages())

        def stage(i: Any, k: Array) -> Array:
            right = slope(z + jnp.tensordot(a[i], k, 1)) + jnp.tensordot(c[i], k, 1) / h
            return k.at[i].set(jnp.einsum("...ij,...j->...i", inverse, right))

        shape = jnp.broadcast_shapes(z.shape, jacobian.shape[:-1])
        k = jax.lax.fori_loop(0, len(a), stage, jnp.zeros((len(a), *shape), z.dtype))
        new = z + jnp.tensordot(a[-1], k, 1) + k[-1]
        wrong = jnp.max(jnp.abs(k[-1]), axis=-1)
        return new, jnp.where(jnp.all(jnp.isfinite(new), axis=-1), wrong, jnp.inf)


def _stages() -> tuple[Array, Array]:
    """The matrices of Rodas5P, a row for each stage: of the places, and of the stages before."""
    rows = [*rodas.A, (*rodas.A[-1], 1.0), (*rodas.A[-1], 1.0, 1.0)]
    return tuple(  # type: ignore[return-value]
        np.array([np.pad(r, (0, 8 - len(r))) for r in m]) for m in (rows, rodas.C)
    )


@dataclass(frozen=True)
class JaxStepper:
    """Equal steps: a call is one, ``run`` many of them in one ``lax.scan``. Pure functions.

    Examples
    --------
    >>> stepper = pam.export.to_jax(plant).stepper(1e-3)  # doctest: +SKIP
    >>> stepper.method, stepper.order  # doctest: +SKIP
    ('rk4', 4)
    """

    world: JaxPlant
    step: float
    method: Method

    @property
    def order(self) -> int:
        """Of the method: halving the step divides the error by 2^order."""
        return ORDERS[self.method]

    def __call__(self, t: Any, x: Array, u: Array, p: Parameters = None) -> Array:
        """x one step later, inputs held."""
        groups = self.world.entries(x, u, p)
        return _column(self._next(*groups), _shape(*groups))

    def _next(self, x: list[Any], u: list[Any], p: list[Any]) -> list[Any]:
        """One step of entries."""
        if self.method == "rosenbrock":
            shape = _shape(x, u, p)
            nominal = _asarray(self.world.signature.nominal)
            z, inputs = _column(x, shape) / nominal, _column(u, shape)
            values = dict(zip(self.world.parameters, p, strict=True))
            new = self.world._rodas(z, inputs, values, self.step)[0] * nominal
            return [new[..., i] for i in range(new.shape[-1])]
        made: _Entries = rk4(
            lambda z, _: _Entries(self.world.slopes(z.entries, u, p)), _Entries(x), self.step
        )
        return made.entries

    def run(
        self, x: Array, u: Array, p: Parameters = None, *, steps: int, keep: bool = False
    ) -> Array:
        """x after so many steps, or with ``keep`` all of them: (steps + 1, ..., nx).

        u : (..., nu), held; or (steps, ..., nu), one row for each step, where it has one axis more
        than x. Slopes backwards (``jax.grad``) keep the states and compute each step once more.
        """
        import jax
        from jax import lax
        from jax import numpy as jnp

        require_count("steps", steps)
        x, u = jnp.asarray(x, float), jnp.asarray(u, float)
        each = u.ndim > x.ndim
        if each and u.shape[0] != steps:
            raise InputError(f"u has {u.shape[0]} rows; one for each of the {steps} steps is asked")
        first, given, values = self.world.entries(x, u[0] if each else u, p)
        shape = _shape(first, given, values)
        begin = tuple(jnp.broadcast_to(e, shape) for e in first)

        def one(now: tuple[Array, ...], row: Any) -> tuple[Array, ...]:
            own = given if row is None else [row[..., i] for i in range(row.shape[-1])]
            made = self._next(list(now), own, values)
            return tuple(jnp.broadcast_to(jnp.asarray(e, float), shape) for e in made)

        again = jax.checkpoint(one)

        def over(now: tuple[Array, ...], row: Any) -> tuple[tuple[Array, ...], Any]:
            new = again(now, row)
            return new, new if keep else None

        end, rows = lax.scan(over, begin, u if each else None, length=steps)
        if not keep:
            return jnp.stack(end, axis=-1)
        way = jnp.stack(rows, axis=-1)
        return jnp.concatenate([jnp.stack(begin, axis=-1)[None], way])

    def error(self, x: Array, u: Array, p: Parameters = None, *, steps: int) -> Array:
        """The largest error over a run scaled by nominals, as half the step shows it: (...,).

        Richardson: the distance from a run with half the step, by 2^order/(2^order - 1).
        """
        from jax import numpy as jnp

        u = jnp.asarray(u, float)
        each = u.ndim > jnp.asarray(x).ndim
        half = JaxStepper(self.world, self.step / 2, self.method)
        fine = half.run(x, jnp.repeat(u, 2, axis=0) if each else u, p, steps=2 * steps, keep=True)
        wrong = jnp.abs(self.run(x, u, p, steps=steps, keep=True) - fine[::2])
        size = jnp.max(wrong / _asarray(self.world.signature.nominal), axis=(0, -1))
        return size / (1 - 2.0**-self.order)


class _Entries:
    """A column as a list of arrays of one batch, which adds up as rk4 asks for."""

    def __init__(self, entries: list[Any]) -> None:
        self.entries = entries

    def __add__(self, other: _Entries) -> _Entries:
        return _Entries([a + b for a, b in zip(self.entries, other.entries, strict=True)])

    def __rmul__(self, factor: float) -> _Entries:
        return _Entries([factor * a for a in self.entries])
