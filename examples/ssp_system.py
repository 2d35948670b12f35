"""A system of FMUs: a plant, its PID and a planned motion, connected in one SSP file.

The file runs in any tool that reads SSP 1.0. Each part is an FMU of its own; start values and
parameters may be changed in the SSP. Here FMPy plays it.
"""

import fmpy.ssp.simulation

import pam_ocp as pam

slide = pam.AntagonisticSlide("DMSP-20-200N", mass=2.0, stroke=0.016, damping=100.0)
gently = {"minimise": "effort", "bounds": {"stiffness": (2e4, None)}}
plan = pam.plan(slide, [{"x": -0.010}, {"x": 0.010}], duration=0.3, **gently)

# %%
# The plan's commands are the feed-forward; the PID takes up what the plant does otherwise.

commands = ("muscle1.command", "muscle2.command")
pid = pam.control.pid_controller(
    slide,
    "x",
    {commands[0]: 1.0, commands[1]: -1.0},
    proportional=5e5,
    integral=1e7,
    derivative=0.0,
)
wires = {"pid.position": "slide.x", "pid.reference": "motion.x"}
for name in commands:
    wires |= {f"slide.{name}": f"pid.{name}", f"pid.feedforward.{name}": f"motion.{name}"}
begin = {v.name: plan.trajectory[v.name][0] for v in slide.states}
parts = {"slide": slide.with_values({**begin, "mass": 2.4}), "pid": pid, "motion": plan.trajectory}
system = pam.export_ssp(parts, wires, "system.ssp", stop_time=0.8, platforms=["native"])
print(f"{system.name}: {', '.join(parts)}, {len(wires)} connections")

# %%
# The slide is 0.4 kg heavier than the plan knows; the PID brings it to the stop all the same.

result = fmpy.ssp.simulation.simulate_ssp(str(system), stop_time=0.8, step_size=1e-3)
figure, axes = pam.figures.new_figure(2, size=(8.0, 6.0), sharex=True)
position, command = axes.ravel()
position.plot(result["time"], 1e3 * result["slide.x"], label="slide, 2.4 kg")
position.plot(result["time"], 1e3 * result["motion.x"], "k:", label="plan, 2 kg")
position.set(ylabel="x [mm]")
position.legend()
for name in commands:
    command.plot(result["time"], result[f"pid.{name}"] / 1e5, label=name)
command.set(xlabel="t [s]", ylabel="pressure [bar]")
command.legend()
figure.savefig("ssp_system.png", dpi=120)
print(f"at the end {1e3 * (result['slide.x'][-1] - 0.010):.3f} mm beside the stop")
