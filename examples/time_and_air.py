"""Quick or thrifty: the least time, the least air, and what lies between.

A slide between two muscles is fed by spool valves. The quickest cycle fills and vents both muscles
as hard as the valves allow; the thriftiest takes its time. The front between them says how much air
a little patience saves.
"""

import pam_ocp as pam

slide = pam.AntagonisticSlide(
    "DMSP-20-300",
    mass=5.0,
    pre_contraction=0.10,
    damping=60.0,
    feed=pam.feeds.SpoolValve(conductance=1e-8),
)

# %%
# The ends of the front are the least of each; between them the least air under a bound of the time.

front = pam.pareto(
    slide,
    [{"x": -0.010}, {"x": 0.010}],
    cyclic=True,
    first="time",
    second="air",
    points=5,
    until=0.3,
    method=pam.Collocation(15, 3),
)
print(front)
front.plot().savefig("time_and_air.png", dpi=120)

# %%
# The quickest motion, and the knee of the front.

quick, wise = front.plans[0], front.plans[front.knee]
saved = 1 - front.values[front.knee][1] / front.values[0][1]
print(f"{100 * (wise.duration / quick.duration - 1):.0f} % more time, {100 * saved:.0f} % less air")
quick.plot().savefig("quickest.png", dpi=120)
wise.plot().savefig("knee.png", dpi=120)
