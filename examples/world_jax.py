"""A plant in JAX: a thousand loads at once, and the command that brings them to a place.

The functions are pure: a batch is one array, and the slope of a motion by its command comes from
`jax.grad`. CasADi's integrators draw the line that JAX has to meet.
"""

import importlib.util

import numpy as np

import pam_ocp as pam

# %%
# A load that hangs at rest, and a higher pressure from there on.

plant = pam.HangingLoad(pam.muscle("DMSP-20-300"), 10.0)
plant = plant.with_values(plant.equilibrium({"x": 0.02}))
command = plant.vector("state")[2] + 3e4
truth = pam.simulate(plant, {"muscle.command": command}, t=np.linspace(0.0, 0.4, 201))
figure, ((axes,),) = pam.figures.new_figure(1, size=(7.0, 4.0))
axes.plot(truth.t, 1e3 * truth["x"], label="CasADi")

# %%
# The same in JAX, for masses of 8 to 12 kg; then the command that leads to 30 mm, by descent.

if importlib.util.find_spec("jax"):
    import jax
    from jax import numpy as jnp

    jax.config.update("jax_enable_x64", True)
    world = pam.export.to_jax(plant)
    stepper = world.stepper(2e-3)
    masses = jnp.linspace(8.0, 12.0, 1000)
    x = jnp.tile(world.x0, (1000, 1))
    path = stepper.run(x, jnp.array([command]), {"mass": masses}, steps=200, keep=True)
    for k in (0, 499, 999):
        axes.plot(truth.t, 1e3 * path[:, k, 0], "--", label=f"JAX, {masses[k]:.1f} kg")

    def missing(u):
        return stepper.run(world.x0, u, steps=200)[0] - 0.030

    u = jnp.array([command])
    for _ in range(5):  # Newton's method
        u = u - missing(u) / jax.grad(missing)(u)
    print(f"{u[0] / 1e5:.4f} bar leads to {1e3 * (missing(u) + 0.030):.4f} mm")
else:
    print("this example needs JAX: pip install 'pam_ocp[jax]'")
axes.set(xlabel="time [s]", ylabel="position [mm]")
axes.legend()
figure.savefig("world_jax.png", dpi=120)
