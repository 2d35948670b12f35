"""A cost of your own: the heat of the damper, and a smooth ride for what is carried.

Besides the terms of the library a plan minimises any expression of the plant's variables: its
integral along the motion (`integrand`), or its value at the end (`final`).
"""

import pam_ocp as pam

slide = pam.AntagonisticSlide("DMSP-20-300", mass=2.0, pre_contraction=0.10, damping=60.0)
stops = [{"x": -0.010}, {"x": 0.010}]
method = pam.Collocation(20, 3)

# %%
# What the damper turns into heat: the integral of damping times velocity squared [J].

velocity = slide.expression("v")
heat = slide.expression("damping") * velocity**2

# %%
# What shakes a cargo: the square of the force that moves it, in units of 1 kN.

net = slide.expression("muscle1.force") - slide.expression("muscle2.force")
shake = (net / 1e3) ** 2

# %%
# Three plans for the same time, and one row for each.

figure, axes = pam.figures.new_figure(2, size=(8.0, 6.0), sharex=True)
position, force = axes.ravel()
for name, cost in (("least heat", heat), ("least shake", shake)):
    plan = pam.plan(
        slide, stops, duration=0.15, minimise={"rate": 1e-6}, integrand=cost, method=method
    )
    motion = plan.trajectory
    position.plot(1e3 * motion.t, 1e3 * motion["x"], label=name)
    force.plot(1e3 * motion.t, motion["muscle1.force"] - motion["muscle2.force"])
    print(f"{name}: largest speed {motion['v'].max():.3f} m/s, {plan.verdict}")
position.set(ylabel="x [mm]")
position.legend()
force.set(xlabel="t [ms]", ylabel="net force [N]")
figure.savefig("own_cost.png", dpi=120)

# %%
# A cost that many plans use gets a name: `@running_cost` of
# `pam_ocp.judge.statement` registers it, and problem files know it, too (CONTRIBUTING.md).
