"""A controller as an ONNX model: what runs where only an ONNX runtime is.

A state feedback is exported, and closes the loop around the plant, sample after sample, from the
runtime; the loop of the package draws the line that it has to meet.
"""

import importlib.util

import numpy as np

import pam_ocp as pam

# %%
# A hanging load and its linear-quadratic regulator.

plant = pam.HangingLoad(pam.muscle("DMSP-20-300"), 10.0)
rest = plant.equilibrium({"x": 0.02})
law = pam.lqr(plant, rest, sample_time=5e-3)
block = pam.control.block(law, plant=plant, guard=False)
moved = plant.with_values(rest).with_values(x=0.0205)
loop = pam.closed_loop(law, moved, duration=0.3)
figure, ((axes,),) = pam.figures.new_figure(1, size=(7.0, 4.0))
axes.plot(loop.t, 1e3 * loop["x"], label="closed_loop")

# %%
# The same law from its file; the plant is simulated from sample to sample.

if importlib.util.find_spec("onnx") and importlib.util.find_spec("onnxruntime"):
    import onnxruntime

    session = onnxruntime.InferenceSession(pam.export(block, "law.onnx"))
    told = {i.name for i in session.get_inputs()}
    memory, x = block.start("memory")[None], moved.vector("state")
    names = [v.name for v in plant.states]
    for k in range(60):
        values = dict(zip(names, x, strict=True))
        seen = [values.get(v.name, v.start) for v in block.inputs]
        given = {"memory": memory, "inputs": np.array([seen]), "p": block.start("parameters")[None]}
        memory, sent = session.run(None, {n: v for n, v in given.items() if n in told})
        move = {"muscle.command": float(np.clip(sent[0, 0], 0.0, 6e5))}
        run = pam.simulate(plant, move, t=np.linspace(0, 5e-3, 3), start=values)
        x = np.array([run[n][-1] for n in names])
        axes.plot(5e-3 * (k + 1), 1e3 * x[0], "k.", label="" if k else "ONNX runtime")
    print(f"after 0.3 s: {1e3 * x[0]:.4f} mm, closed_loop {1e3 * loop['x'][-1]:.4f} mm")
else:
    print("this example needs ONNX: pip install 'pam_ocp[onnx]'")
axes.set(xlabel="time [s]", ylabel="position [mm]")
axes.legend()
figure.savefig("world_onnx.png", dpi=120)
