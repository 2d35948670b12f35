"""Two muscles on a slide in MuJoCo, side by side with the package's own simulation.

MuJoCo has the masses and joints, the muscles are actuators of it: pressure and hysteresis are their
activations, their force that of the fitted law.
"""

import importlib.util

import numpy as np

import pam_ocp as pam

# %%
# The slide as a plant.

muscle, feed = pam.muscle("DMSP-20-300"), pam.feeds.Regulator(0.05)
losses = (pam.losses.BoucWen(20.0, 0.005),)
common = {"feed": feed, "losses": losses}
plant = pam.AntagonisticSlide(muscle, mass=2.0, pre_contraction=0.1, damping=20.0, **common)
commands = {"muscle1.command": 3e5, "muscle2.command": 2e5}
truth = pam.simulate(plant, commands, t=np.linspace(0.0, 0.5, 501))
figure, ((axes,),) = pam.figures.new_figure(1, size=(7.0, 4.0))
axes.plot(truth.t, 1e3 * truth["x"], label="simulate")

# %%
# The same muscles on a slide of MuJoCo's: a muscle's length is its offset and that of its tendon.

MODEL = """<mujoco><option timestep="0.001" integrator="RK4" gravity="0 0 0"/><worldbody><body>
<joint name="x" type="slide" axis="1 0 0" damping="20"/>
<geom type="box" size=".05 .05 .05" mass="2"/></body></worldbody>{muscles}</mujoco>"""
muscles = [
    pam.export.MujocoMuscle(name, muscle, {"x": arm}, offset=0.27, **common)
    for name, arm in (("muscle1", -1.0), ("muscle2", 1.0))
]
if importlib.util.find_spec("mujoco"):
    import mujoco

    made = pam.export.to_mujoco(muscles)
    model = mujoco.MjModel.from_xml_string(MODEL.format(muscles=made.mjcf()))
    data = mujoco.MjData(model)
    made.reset(model, data, commands)
    path = [0.0]
    with made.installed(model):
        for _ in range(500):
            mujoco.mj_step(model, data)
            path.append(data.qpos[0])
    axes.plot(truth.t[::10], 1e3 * np.array(path)[::10], ".", label="MuJoCo")
    print(f"largest distance {1e3 * np.max(np.abs(path - truth['x'])):.1e} mm")
else:
    print("this example needs MuJoCo: pip install 'pam_ocp[mujoco]'")
axes.set(xlabel="time [s]", ylabel="position [mm]")
axes.legend()
figure.savefig("world_mujoco.png", dpi=120)
