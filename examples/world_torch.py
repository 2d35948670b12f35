"""A plant in PyTorch: a mass is learnt from a motion.

The plant is a module; its parameters are tensors by name, of which any may be trained.
"""

import importlib.util

import numpy as np

import pam_ocp as pam

# %%
# What was measured: a load of 9.2 kg that nobody has weighed.

plant = pam.HangingLoad(pam.muscle("DMSP-20-300"), 10.0)
plant = plant.with_values(plant.equilibrium({"x": 0.02}))
command = plant.vector("state")[2] + 3e4
times = np.linspace(0.0, 0.2, 101)
measured = pam.simulate(plant, {"muscle.command": command}, t=times, parameters={"mass": 9.2})
figure, ((axes,),) = pam.figures.new_figure(1, size=(7.0, 4.0))
axes.plot(times, 1e3 * measured["x"], "k", lw=3, alpha=0.3, label="measured")

# %%
# Gauss-Newton on the mass alone.

if importlib.util.find_spec("torch"):
    import torch

    module = pam.export.to_torch(plant)
    held, target = torch.tensor([command]), torch.tensor(measured["x"])

    def motion(mass):
        return module.run(module.x0, held, {"mass": mass}, step=2e-3, steps=100)[:, 0]

    mass = torch.tensor(10.0, dtype=torch.float64)
    for k in range(4):
        x, slope = torch.func.jvp(motion, (mass,), (torch.ones_like(mass),))
        axes.plot(times, 1e3 * x.detach(), "--", label=f"step {k}: {mass:.3f} kg")
        mass = (mass - slope @ (x - target) / (slope @ slope)).detach()
    print(f"the load weighs {mass:.4f} kg")
else:
    print("this example needs PyTorch: pip install 'pam_ocp[torch]'")
axes.set(xlabel="time [s]", ylabel="position [mm]")
axes.legend()
figure.savefig("world_torch.png", dpi=120)
