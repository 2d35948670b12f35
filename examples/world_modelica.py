"""A muscle as Modelica source: a component with two flanges and a pneumatic port.

The equations are those of the fitted law, written out, with units and sources. What pulls in the
model is drawn from the law here.
"""

import numpy as np

import pam_ocp as pam

# %%
# The package has connectors of its own, of the form of Modelica's translational flanges.

muscle = pam.muscle("DMSP-20-300")
path = pam.export(muscle, "Muscle.mo")
lines = path.read_text("utf-8").splitlines()
print("\n".join(line for line in lines if "flange" in line or "port" in line))

# %%
# A whole plant becomes a model with inputs and outputs.

plant = pam.HangingLoad(muscle, 10.0)
print(pam.export(plant, "Load.mo").read_text("utf-8")[-700:])

kappa = np.linspace(0.0, 0.25, 101)
figure, ((axes,),) = pam.figures.new_figure(1, size=(7.0, 4.0))
for bar in (1, 2, 3, 4, 5):
    axes.plot(100 * kappa, muscle.force(bar * 1e5, kappa), label=f"{bar} bar")
axes.set(xlabel="contraction [%]", ylabel="force [N]")
axes.legend()
figure.savefig("world_modelica.png", dpi=120)
