"""The whole chain: from a measured table to a verified motion, a linear model and an FMU.

A table of static forces is fitted, two of these muscles pull a slide, the quickest motion between
two stops is planned and replayed by an independent integrator, the slide is linearised at rest, and
leaves as an FMU that is checked against the replay.
"""

# %%
# The table is that of Martens and Boblan (Actuators 2017, 6(4), 33), shipped with the package. The
# law is that of Sárosi et al. (2015), eq. (3).

import pam_ocp as pam

table = pam.read_table("DMSP-20-300_static.csv", rest_length=0.300)
fit = pam.fit_force(table)
print(fit.report())
fit.plot().savefig("chain_fit.png", dpi=120)

# %%
# Two muscles with 10 % of contraction each hold 2 kg between them.

muscle = fit.muscle(rest_length=0.300, diameter=0.020)
slide = pam.AntagonisticSlide(muscle, mass=2.0, pre_contraction=0.10)
plan = pam.plan(slide, [{"x": -0.015}, {"x": 0.015}], cyclic=True, minimise="time")
print(plan)
plan.plot().savefig("chain.png", dpi=120)

# %%
# The plan's inputs drive the plant itself; the deviation is that of the plan's mesh.

replay = pam.simulate(slide, plan.trajectory)
print(plan.trajectory.compare(replay.at(plan.trajectory.t)))

# %%
# At rest it is a linear system of python-control, with names.

rest = slide.equilibrium(x=0.0, stiffness=2e4)
system = slide.linearize(rest)
for frequency, ratio in pam.operating.modes(system):
    print(f"{frequency:.2f} Hz, damping ratio {ratio:.3f}")

# %%
# And an FMU, checked in each of its modes against the replay.

fmu = pam.export_fmu(slide, "slide.fmu", platforms=["native"])
print(pam.check_fmu(fmu, against=replay))
