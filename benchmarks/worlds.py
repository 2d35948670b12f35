"""A million plants in JAX, and a step of gradient descent over ten thousand of them.

    python benchmarks/worlds.py [--plants 1000000] [--gradients 10000] [--step 2e-3]

A slide between two muscles behind pressure regulators (4 states), each plant with a mass, loads and
commands of its own, runs 0.5 s by equal steps of rk4 in double precision. The error that is told is
that of Richardson (half the step), over some of the plants, in units of nominal.
"""

from __future__ import annotations

import argparse
import time

import jax
import numpy as np

import pam_ocp as pam

jax.config.update("jax_enable_x64", True)
from jax import numpy as jnp  # noqa: E402

DURATION = 0.5
CHUNK = 16384
"""Plants that are computed at once: their states stay in the cache."""
SHOWN = 256
"""Plants over which the error is told."""


def drawn(world, count, rng):
    """(states, commands, parameters by name) of so many plants."""
    x = jnp.tile(world.x0, (count, 1))
    u = jnp.asarray(rng.uniform(2e5, 4e5, (count, len(world.inputs))))
    p = {"mass": jnp.asarray(rng.uniform(1.0, 4.0, count))}
    return x, u, p


def in_chunks(stepper, steps, x, u, p):
    """States at the end, chunk after chunk."""

    def one(part):
        return stepper.run(*part, steps=steps)

    parts = jax.tree.map(lambda a: a.reshape(-1, min(CHUNK, len(x)), *a.shape[1:]), (x, u, p))
    return jax.lax.map(one, parts).reshape(x.shape)


def timed(function, *arguments, runs=1):
    """(seconds to compile, seconds of the quickest run, its processor seconds over all cores).

    The first run of a program also asks the system for its memory.
    """
    begin = time.perf_counter()
    compiled = jax.jit(function).lower(*arguments).compile()
    build, took = time.perf_counter() - begin, []
    for _ in range(runs):
        ready, busy = time.perf_counter(), time.process_time()
        jax.block_until_ready(compiled(*arguments))
        took.append((time.perf_counter() - ready, time.process_time() - busy))
    return build, *min(took)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--plants", type=int, default=1_000_000)
    parser.add_argument("--gradients", type=int, default=10_000)
    parser.add_argument("--step", type=float, default=2e-3)
    given = parser.parse_args()
    plant = pam.AntagonisticSlide(
        pam.muscle("DMSP-20-300"), mass=2.0, pre_contraction=0.1, feed=pam.feeds.Regulator(0.05)
    )
    plant = plant.with_values(plant.equilibrium({"x": 0.0, "muscle1.pressure": 3e5}))
    world = pam.export.to_jax(plant)
    stepper = world.stepper(given.step)
    steps, rng = round(DURATION / given.step), np.random.default_rng(0)
    count = -(-given.plants // CHUNK) * CHUNK if given.plants > CHUNK else given.plants

    x, u, p = drawn(world, count, rng)
    some = jax.tree.map(lambda a: a[:SHOWN], (x, u, p))
    error = float(jnp.max(stepper.error(*some, steps=steps)))
    build, run, busy = timed(lambda *a: in_chunks(stepper, steps, *a), x, u, p)
    print(f"{count} plants, {DURATION} s in {steps} steps of {stepper.method}: {run:.1f} s")
    print(f"  ({busy:.1f} s of processor; compiled in {build:.1f} s; error {error:.1e} of nominal)")

    x, u, p = drawn(world, given.gradients, rng)
    position = world.states.index("x")

    def far(u):
        return jnp.mean((stepper.run(x, u, p, steps=steps)[:, position] - 0.005) ** 2)

    build, run, busy = timed(lambda u: u - 1e13 * jax.grad(far)(u), u, runs=3)
    print(f"a step down the gradient over {given.gradients} plants: {run:.2f} s")
    print(f"  ({busy:.2f} s of processor; compiled in {build:.1f} s)")


if __name__ == "__main__":
    main()
