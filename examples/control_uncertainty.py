"""What an uncertain force law means for a loop: clouds of Bode plots, and margins.

The law is fitted to a measured table and its coefficients are drawn from the fit's covariance; each
draw rests at its own place under the same pressures. That is the uncertainty of one muscle in one
laboratory, and small. Muscles differ more: a second cloud adds a scatter of 10 % in the force of
each muscle (an assumption; published sets differ by 14 to 27 %). The same LQI is looked at on all
of them.

Run:  python examples/control_uncertainty.py [folder for the results]
"""

import sys
from importlib import resources
from pathlib import Path

import numpy as np

import pam_ocp as pam
from pam_ocp.control.analysis import bode_cloud, margins_over
from pam_ocp.control.linear_quadratic import lqr
from pam_ocp.figures.control import plot_bode_cloud

BAR = 1e5
DRAWS = 60


def cases(fit: pam.fitting.ForceFit, scatter: float) -> list[dict[str, dict[str, float]]]:
    """Parameters of both muscles: one draw of the law for both, a factor of force for each."""
    values = {n: float(v) for n, v in fit.law.values.items()}
    factors = 1 + scatter * np.random.default_rng(1).standard_normal((DRAWS, 2))
    exponent = "a3"  # all other coefficients of the six-parameter law scale its force
    return [
        {
            "parameters": {
                f"muscle{i + 1}.{n}": v if n == exponent else v * factor
                for i, factor in enumerate(both)
                for n, v in case["parameters"].items()
            }
        }
        for case, both in zip(
            pam.simulation.draws(values, fit.covariance, DRAWS), factors, strict=True
        )
    ]


def main(folder: Path) -> None:
    with resources.as_file(resources.files("pam_ocp.data") / "DMSP-20-300_static.csv") as path:
        table = pam.read_table(path, rest_length=0.300)
    fit = pam.fit_force(table)
    muscle = fit.muscle(rest_length=0.300, diameter=0.020)
    plant = pam.AntagonisticSlide(muscle, mass=5.0, feed=pam.feeds.Regulator(0.05))
    rest = {"muscle1.command": 2.6 * BAR, "muscle2.command": 2.0 * BAR}
    feedback = lqr(plant, plant.equilibrium(rest), integral={"x": 100.0, "stiffness": 5.0})
    for scatter, name in ((0.0, "fit"), (0.10, "scatter")):
        drawn = cases(fit, scatter)
        cloud = bode_cloud(
            plant, rest, drawn, source="muscle1.command", output="x", hertz=(0.2, 60.0)
        )
        low, high = cloud.band(0.95)
        found = margins_over(feedback, drawn, rest)
        phase = np.array([min(m.phase) for m, _ in found])
        slowest = np.array([poles.real.max() for _, poles in found])
        print(
            f"scatter {scatter:.0%}: 95 % of {DRAWS} draws in a band at most "
            f"{np.max(high / low):.2f} wide, phase margin {phase.min():.1f} .. {phase.max():.1f} "
            f"deg, slowest closed-loop pole {slowest.min():.2f} .. {slowest.max():.2f} 1/s"
        )
        extra = f" and {scatter:.0%} scatter of force" if scatter else ""
        plot_bode_cloud(
            cloud, title=f"Slide on two fitted muscles: {DRAWS} draws from the fit{extra}"
        ).savefig(folder / f"control_uncertainty_{name}.png", dpi=120)


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "control_uncertainty")
    target.mkdir(parents=True, exist_ok=True)
    main(target)
