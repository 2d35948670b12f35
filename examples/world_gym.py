"""A plant as a Gymnasium environment: how near does a simple policy come to the optimum?

A linear policy is searched for by random draws, a hundred episodes side by side, and its time is
compared with that of the verified quickest motion.
"""

import importlib.util

import numpy as np

import pam_ocp as pam

# %%
# A load is to be lifted by 10 mm, from rest to rest. The optimum is planned and verified.

feed = pam.feeds.Regulator(0.05, max_pressure=6e5)
plant = pam.HangingLoad(pam.muscle("DMSP-20-300"), 5.0, feed=feed)
optimum = pam.plan(plant, [{"x": 0.02}, {"x": 0.03}])
print(optimum.verdict)
figure, ((axes,),) = pam.figures.new_figure(1, size=(7.0, 4.0))
best = optimum.trajectory
axes.plot(best.t, 1e3 * best["x"], label=f"optimum, {optimum.duration:.3f} s")

# %%
# Policies u = bias + gains * observation, each in an environment of its own.

if importlib.util.find_spec("gymnasium") and importlib.util.find_spec("jax"):
    many, rng = 128, np.random.default_rng(0)
    task = ("reach", {"x": 0.03})
    common = {"start": {"x": 0.02}, "tolerance": 0.05, "duration": 1.0}
    world = pam.env(plant, *task, num_envs=many, **common)
    middle, spread = np.zeros(5), np.ones(5)
    for _ in range(8):  # cross-entropy method
        draws = middle + spread * rng.standard_normal((many, 5))
        seen, _ = world.reset(seed=0)
        total, alive = np.zeros(many), np.ones(many, bool)
        while alive.any():
            action = np.tanh(np.sum(draws[:, :4] * seen, axis=1) + draws[:, 4])
            seen, reward, ended, late, _ = world.step(action[:, None])
            total += reward * alive
            alive &= ~(ended | late)
        order = np.argsort(total)[-16:]
        middle, spread = draws[order].mean(axis=0), draws[order].std(axis=0) + 0.02
    one = pam.env(plant, *task, **common)
    seen, told = one.reset(seed=0)
    path, over = [0.02], False
    while not over:
        seen, _, ended, late, told = one.step(
            [np.tanh(draws[order[-1], :4] @ seen + draws[order[-1], 4])]
        )
        path.append(0.03 - seen[-1] * plant.variable("x").nominal)
        over = ended or late
    axes.plot(0.01 * np.arange(len(path)), 1e3 * np.array(path), ".-", label="policy")
    print(f"reached: {told['success']}, {told['time']:.2f} s; score {one.score(told['time']):.2f}")
else:
    print("this example needs Gymnasium and JAX: pip install 'pam_ocp[gym]'")
axes.set(xlabel="time [s]", ylabel="position [mm]")
axes.legend()
figure.savefig("world_gym.png", dpi=120)
