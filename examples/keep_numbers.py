"""Which parameter matters: Sobol indices of two numbers of a motion, over some thousand cases.

`keep=` names numbers of a motion by words, and each case leaves one row. The cases are those of
Saltelli's scheme; SALib makes the indices (`pip install pam_ocp[sensitivity]`).
"""

import numpy as np

import pam_ocp as pam

plant = pam.AntagonisticSlide("DMSP-20-400N", mass=2.0)
ranges = {
    "mass": (1.0, 4.0),
    "damping": (50.0, 200.0),
    "muscle1.lag": (0.02, 0.1),
    "muscle2.lag": (0.02, 0.1),
}
cases = pam.simulation.SobolCases(ranges, 256)

# %%
# Where the slide comes to rest, and how far it swings beyond. Nothing else is kept.
numbers = pam.simulate_many(
    plant,
    cases,
    keep={"peak force": "max(muscle1.force)", "settling time": "settling(x)"},
    inputs={"muscle1.command": 4e5, "muscle2.command": 3e5},
    t=np.linspace(0.0, 1.5, 301),
    executor=0,
    rtol=1e-8,
)
print(numbers)

# %%
# First order and total indices, with their 95 % intervals.
figure, (row,) = pam.figures.new_figure(1, 2, size=(8.0, 3.5))
for axes, name in zip(row, numbers.names, strict=True):
    found = numbers.sobol(name)
    print(name, found, sep="\n")
    for shift, label, indices in ((-0.2, "first order", found.first), (0.2, "total", found.total)):
        heights, widths = np.array(list(indices.values())).T
        axes.bar(np.arange(len(ranges)) + shift, heights, 0.4, yerr=widths, label=label)
    axes.set(title=name, xticks=range(len(ranges)), ylim=(-0.05, 1.1))
    axes.set_xticklabels(list(ranges), rotation=30, ha="right")
row[0].legend(loc="upper left")
figure.savefig("keep_numbers.png", dpi=120)
