"""A force law of your own: fitted, compared, and used like any other.

The formula is written once, as a CasADi expression. Everything else (fit, intervals, inverse,
simulation, plan, FMU) comes from it.
"""

import casadi as ca

import pam_ocp as pam

# %%
# A braid's parabola with a wall whose force grows exponentially: four coefficients.


def force(p: ca.SX, kappa: ca.SX, area: ca.SX, slope: ca.SX, wall: ca.SX, rate: ca.SX) -> ca.SX:
    return p * area * (1 - slope * kappa) ** 2 + wall * (ca.exp(-rate * kappa) - 1)


BraidAndWall = pam.laws.own_law(
    "braid-and-wall",
    force,
    {
        "area": pam.laws.coefficient("m2", 3e-3, "of the braid at rest", minimum=0.0),
        "slope": pam.laws.coefficient("1", 3.0, "of its square root over contraction"),
        "wall": pam.laws.coefficient("N", 300.0, "force of the wall", minimum=0.0),
        "rate": pam.laws.coefficient("1", 20.0, "at which it is reached", minimum=0.1),
    },
)

# %%
# Fitted to the shipped table, and ranked beside laws of the literature by levels left out.

table = pam.read_table("DMSP-20-300_static.csv", rest_length=0.300)
fit = pam.fit_force(table, BraidAndWall)
print(fit.report())
print(pam.compare_laws(table, [BraidAndWall, "six-parameter", "five-parameter", "hildebrandt"]))
fit.plot().savefig("own_law.png", dpi=120)

# %%
# And moved: the law goes into the plan as it is.

muscle = fit.muscle(rest_length=0.300, diameter=0.020)
slide = pam.AntagonisticSlide(muscle, mass=2.0, pre_contraction=0.10)
print(pam.plan(slide, [{"x": -0.010}, {"x": 0.010}], cyclic=True))
