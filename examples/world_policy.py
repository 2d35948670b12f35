"""A learned policy beside the optimum: a load is lifted by 40 mm as fast as can be.

An evolution strategy (CMA-ES, library cmaes) trains a small network on 256 plants side by side, in
less than a minute of one core. Its time is scored by that of the verified quickest motion.
"""

import importlib.util

import numpy as np

import pam_ocp as pam

# %%
# From rest to rest; the optimum is planned and verified.

feed = pam.feeds.Regulator(0.05, max_pressure=6e5)
plant = pam.HangingLoad(pam.muscle("DMSP-20-300"), 5.0, feed=feed)
stops = {"x": 0.01}, {"x": 0.05}
optimum = pam.plan(plant, stops)
print(optimum.verdict)
figure, ((axes,),) = pam.figures.new_figure(1, size=(7.0, 4.0))
best = optimum.trajectory
axes.plot(best.t, 1e3 * best["x"], label=f"optimum, {optimum.duration:.4f} s")

# %%
# The policy: six neurons on what is seen (position, speed, pressure, distance). A motion that does
# not come to rest at the target is the better, the nearer it came, in tolerances; others count by
# their time, and by how near they were a sample before.

MANY, SAMPLE, NEURONS = 256, 0.005, 6
SIZES = np.array([4.0, 10.0, 4.0, 4.0])  # of what is seen
ENTRIES = 6 * NEURONS + 1


def action(weights, seen):
    """(policies, 1) of weights (policies, ENTRIES) and (policies, 4)."""
    inner, others = np.split(weights, [4 * NEURONS], axis=1)
    bias, outer, last = np.split(others, [NEURONS, 2 * NEURONS], axis=1)
    layer = np.einsum("kij,kj->ki", inner.reshape(-1, NEURONS, 4), seen / SIZES)
    return np.tanh(np.sum(outer * np.tanh(layer + bias), axis=1, keepdims=True) + last)


def costs(world, weights):
    """(what is minimised, times [s]) of an episode by each policy."""
    seen, _ = world.reset(seed=0)
    alive, near, times = np.ones(MANY, bool), np.full(MANY, np.inf), np.full(MANY, np.inf)
    while alive.any():
        seen, _, ended, late, told = world.step(action(weights, seen))
        arrived = alive & told["success"]
        times[arrived] = told["time"][arrived]
        alive &= ~(ended | late)
        off = np.maximum(np.abs(seen[:, 3]) / 0.01, np.abs(seen[:, 1]) / 0.05)
        near = np.where(alive, np.minimum(near, off), near)
    far = np.log(np.maximum(near, 1.0))
    return np.where(np.isfinite(times), times + SAMPLE * far / (1 + far), 1 + far), times


def trained(world, seed, enough=0.92, starts=10, generations=100):
    """(weights of the quickest policy, its time [s]), begun anew until its score is enough."""
    from cmaes import CMA

    found, lowest, time = None, np.inf, np.inf
    for k in range(starts * generations):
        if k % generations == 0:
            own = seed + 1000 * (k // generations)
            search = CMA(mean=np.zeros(ENTRIES), sigma=1.0, population_size=MANY, seed=own)
        weights = np.array([search.ask() for _ in range(MANY)])
        cost, times = costs(world, weights)
        search.tell(list(zip(weights, cost, strict=True)))
        best = np.argmin(cost)
        if cost[best] < lowest:
            found, lowest, time = weights[best], cost[best], times[best]
        if time < np.inf and world.score(time) > enough:
            break
    return found, time


# %%
# Trained once, then let go on a plant of its own.

if all(map(importlib.util.find_spec, ("gymnasium", "jax", "cmaes"))):
    task = pam.control.Task("reach", stops[1], duration=0.2)
    world = pam.env(plant, task, start=stops[0], sample_time=SAMPLE, num_envs=MANY)
    weights, _ = trained(world, seed=2)
    one = pam.env(plant, task, start=stops[0], sample_time=SAMPLE)
    seen, told = one.reset(seed=0)
    path, over = [0.01], False
    while not over:
        seen, _, ended, late, told = one.step(action(weights[None], seen[None])[0])
        path.append(seen[0] * plant.variable("x").nominal)
        over = ended or late
    axes.plot(SAMPLE * np.arange(len(path)), 1e3 * np.array(path), ".-", label="policy")
    print(
        f"reached: {told['success']}, {told['time']:.3f} s; score {world.score(told['time']):.3f}"
    )
else:
    print("this example needs Gymnasium, JAX and cmaes: pip install 'pam_ocp[policy]'")
axes.set(xlabel="time [s]", ylabel="position [mm]")
axes.legend()
figure.savefig("world_policy.png", dpi=120)
