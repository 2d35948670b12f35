"""The curves of docs/model.md and docs/air.md, drawn by the package: ``python docs/curves.py``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from drawings import INK, LOAD, MUSCLE
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import pam_ocp as pam
from pam_ocp.muscles import ConstantHeatTransfer
from pam_ocp.muscles.gas import Gas, iso6358

HERE = Path(__file__).resolve().parent
THIRD = "#009e73"
L, F = pam.losses, pam.feeds


# ---- force -------------------------------------------------------------------------------------


def force(ax: Axes) -> None:
    muscle = pam.muscle("DMSP-20-300")
    kappa = np.linspace(0.0, 0.26, 120)
    for bar in range(7):
        ax.plot(100 * kappa, muscle.force(bar * 1e5, kappa), color=MUSCLE, alpha=0.3 + 0.1 * bar)
        ax.annotate(f"{bar} bar", (100 * kappa[6], muscle.force(bar * 1e5, kappa[6])), fontsize=8)
    ax.set(xlabel="contraction [%]", ylabel="pull F [N]", title="Force, eq. (3)")


def stiffness(ax: Axes) -> None:
    muscle = pam.muscle("DMSP-20-300")
    kappa = np.linspace(0.0, 0.24, 120)
    for bar in (3, 5):
        held, shut = (
            f(bar * 1e5, kappa) / 1e3
            for f in (muscle.stiffness, lambda p, k: pam.gas.closed_stiffness(muscle, p, k))
        )
        pulls = muscle.force(bar * 1e5, kappa) > 2
        for values, style, name in ((held, "-", "constant pressure"), (shut, "--", "valve shut")):
            label = name if bar == 5 else None
            ax.plot(100 * kappa[pulls], values[pulls], style, color=MUSCLE, label=label)
        ax.annotate(f"{bar} bar", (100 * kappa[pulls][-1] + 0.4, held[pulls][-1]), fontsize=8)
    ax.set(xlabel="contraction [%]", ylabel="stiffness [N/mm]", title="Stiffness", xlim=(0, 27))
    ax.legend(fontsize=8)


def slack(ax: Axes) -> None:
    muscle = pam.muscle("DMSP-20-300")
    kappa = np.linspace(0.15, 0.25, 20001)
    tension = muscle.law.tension(3e5, kappa)
    ax.plot(tension, tension, ":", color=INK, label="the law alone")
    ax.plot(tension, muscle.force(3e5, kappa), color=MUSCLE, label="pull F")
    ax.set(xlim=(-3, 3), ylim=(-3, 3), title="A muscle only pulls")
    ax.set(xlabel="the law's tension [N]", ylabel="pull [N]")
    ax.legend(fontsize=8)


# ---- losses --------------------------------------------------------------------------------------


class Drawn(pam.Plant):
    """A muscle that is drawn along a path at a pressure: what its loss answers."""

    def __init__(self, loss: Any) -> None:
        super().__init__("drawn")
        muscle = pam.muscle("DMSP-20-200N")
        x = self.state("x", unit="m", nominal=0.01)
        rate = self.input("rate", unit="m/s")
        self.der(x, rate)

        self.add_muscle(
            "muscle", muscle, shortening=x, rate=rate, feed=F.IdealPressure(), losses=[loss]
        )


def loop(loss: Any, turns: list[float], speed: float = 0.02, pressure: float = 3e5) -> Any:
    """(contraction [%], loss [N]) along straight strokes between contractions."""
    plant = Drawn(loss)
    x = 0.2 * np.array(turns)
    t = np.append(0.0, np.cumsum(np.abs(np.diff(x)) / speed))
    rates = np.append(speed * np.sign(np.diff(x)), 0.0)
    times = np.linspace(0, t[-1], 240)
    inputs = {"rate": (t, rates), "muscle.pressure": pressure}
    run = pam.simulate(plant, inputs, t=times, start={"x": x[0]}, rtol=1e-8)
    return 500 * run["x"], run["muscle.loss"]


def hysteresis(ax: Axes) -> None:
    turns = [0.02, 0.2, 0.02, 0.14, 0.08, 0.14, 0.02]
    slip = L.MaxwellSlip((6.0, 6.0), (0.005, 0.02))
    play = L.PrandtlIshlinskii((6.0, 6.0), (4.0, 4.0), (0.005, 0.02), 4.0)
    for loss, color, name in ((slip, MUSCLE, "MaxwellSlip"), (play, LOAD, "PrandtlIshlinskii")):
        ax.plot(*loop(loss, turns), color=color, label=name)
    ax.set(xlabel="contraction [%]", ylabel="loss [N]", title="Memory, minor loops")
    ax.legend(fontsize=8)


def softening(ax: Axes) -> None:
    loss = L.Preconditioning(stiffness=300.0, softening=0.4)
    ax.plot(*loop(loss, [0.0, 0.12, 0.0, 0.12, 0.2, 0.0]), color=MUSCLE)
    ax.set(xlabel="contraction [%]", ylabel="loss [N]", title="Preconditioning (Mullins)")


def over_speed(ax: Axes) -> None:
    v = np.linspace(-0.2, 0.2, 401)
    kinds = (
        (L.CoulombFriction(15.0, excess=0.5), MUSCLE, "CoulombFriction"),
        (L.StrandFriction(), THIRD, "StrandFriction"),
        (L.ForceVelocity(), LOAD, "ForceVelocity"),
    )
    for loss, color, name in kinds:
        plant = Drawn(loss)
        inputs = np.vstack([v, np.full(v.size, 3e5)])
        y = plant.function(0.02 * np.ones((1, v.size)), inputs, plant.vector("parameter"))[1]
        row = [o.name for o in plant.outputs].index("muscle.loss")
        ax.plot(1e3 * v, np.asarray(y)[row], color=color, label=name)
    ax.set(xlabel="speed of shortening [mm/s]", ylabel="loss [N]", title="Friction, 3 bar")
    ax.legend(fontsize=8)


def creep(ax: Axes) -> None:
    for loss, color, name in (
        (L.Creep((500.0,), (2.0,)), MUSCLE, "Creep"),
        (L.LoadCreep((500.0,), (2.0,), load=200.0), LOAD, "LoadCreep"),
    ):
        plant = pam.HangingLoad("DMSP-20-200N", 20.0, damping=200.0, losses=loss)
        run = pam.simulate(plant, {"muscle.command": 3e5}, t=np.linspace(0, 8, 161))
        ax.plot(run.t, 1e3 * run["x"], color=color, label=name)
    ax.set(xlabel="time [s]", ylabel="position [mm]", title="Creep: 20 kg, step to 3 bar")
    ax.legend(fontsize=8)


# ---- air and valves ------------------------------------------------------------------------------


def orifice(ax: Axes) -> None:
    ratio = np.linspace(0, 1, 200)
    flow = [1e3 * float(iso6358(7e5, r * 7e5, 2.75e-8, 0.3)) for r in ratio]
    ax.plot(ratio, flow, color=MUSCLE)
    ax.axvline(0.3, color=INK, lw=0.7, ls=":")
    ax.text(0.31, 2, "b", fontsize=10, style="italic")
    ax.set(xlabel="p2/p1", ylabel="flow [g/s]", title="ISO 6358, p1 = 7 bar absolute")


def venting(ax: Axes) -> None:
    kinds = (
        (Gas(exponent=1.0), THIRD, "isothermal (n = 1)"),
        (Gas(heat=ConstantHeatTransfer(60.0)), MUSCLE, "h = 60 W/(m2 K)"),
        (Gas(heat=ConstantHeatTransfer(0.0)), LOAD, "adiabatic (h = 0)"),
    )
    warm = ax.twinx()
    for gas, color, name in kinds:
        plant = pam.HangingLoad(
            "DMSP-20-200N", 10.0, damping=300.0, feed=F.SpoolValve(gas=gas, conductance=5e-9)
        )
        start = {"x": 0.035, "muscle.pressure": 5e5}
        t = np.linspace(0, 0.3, 151)
        run = pam.simulate(plant, {"muscle.command": -0.5}, t=t, start=start)
        ax.plot(t, run["muscle.pressure"] / 1e5, color=color, label=name)
        if gas.heat is not None:
            warm.plot(t, run["muscle.temperature"], "--", color=color, lw=1)
    ax.set(xlabel="time [s]", ylabel="pressure [bar]", title="Venting; air's temperature dashed")
    warm.set_ylabel("temperature [K]")
    ax.legend(fontsize=8)


def tube(ax: Axes) -> None:
    kinds = (
        (F.Tube(2.5e-5, 0.01), THIRD, "Tube"),
        (F.LumpedTube(2.0, 4e-3, 1), MUSCLE, "LumpedTube, 1 segment"),
        (F.LumpedTube(2.0, 4e-3, 8), LOAD, "8 segments"),
    )
    for part, color, name in kinds:
        feed = F.SpoolValve(tube=part, conductance=5e-9)
        plant = pam.HangingLoad("DMSP-20-200N", 10.0, damping=300.0, feed=feed)
        start = {v.name: 2e5 for v in plant.states if "pressure" in v.name}
        t = np.linspace(0, 0.05, 151)
        run = pam.simulate(plant, {"muscle.command": 0.5}, t=t, start={"x": 0.01, **start})
        ax.plot(1e3 * t, run["muscle.mass_flow"] * 1e3, color=color, label=name)
    ax.axvline(1e3 * 2.0 / 343, color=INK, lw=0.7, ls=":")
    ax.text(1e3 * 2.0 / 343 + 0.7, 0.1, "length/343 m/s", fontsize=8)
    ax.set(xlabel="time [ms]", ylabel="flow into the muscle [g/s]", title="Two metres of tube")
    ax.legend(fontsize=8)


def spool(ax: Axes) -> None:
    for part, color, name in (
        (F.FirstOrderSpool(8e-3, hysteresis=0.05), MUSCLE, "FirstOrderSpool, play 5 %"),
        (F.SecondOrderSpool(60.0, 0.5), LOAD, "SecondOrderSpool, damping 0.5"),
    ):
        plant = pam.HangingLoad("DMSP-20-200N", 10.0, feed=F.SpoolValve(spool=part))
        t = np.linspace(0, 0.16, 321)
        inputs = {"muscle.command": ([0.0, 0.02, 0.09, 0.16], [0.0, 0.4, -0.2, -0.2])}
        run = pam.simulate(plant, inputs, t=t)
        seen = run["muscle.valve.spool"]
        if "muscle.valve.play" in run:
            seen = seen - 0.025 * run["muscle.valve.play"]
        ax.plot(1e3 * t, seen, color=color, label=name)
    ax.plot([0, 20, 20, 90, 90, 160], [0, 0, 0.4, 0.4, -0.2, -0.2], ":", color=INK, label="command")
    ax.set(xlabel="time [ms]", ylabel="what the lands see", title="Spools")
    ax.legend(fontsize=7, loc="lower left")


FIGURES = {
    "model_force.svg": (force, stiffness, slack),
    "model_losses.svg": (hysteresis, softening, over_speed, creep),
    "model_air.svg": (orifice, venting, tube, spool),
}


def main() -> None:
    same = {"svg.hashsalt": "pam_ocp", "svg.fonttype": "none", "font.size": 9}
    for name, draws in FIGURES.items():
        with rc_context(same):
            figure = Figure(figsize=(3.6 * len(draws), 3.2), layout="constrained")
            for draw, ax in zip(draws, figure.subplots(1, len(draws)), strict=True):
                draw(ax)
                ax.spines[["top", "right"]].set_visible(False)
                ax.title.set_fontsize(10)
            figure.savefig(HERE / name, metadata={"Date": None})


if __name__ == "__main__":
    main()
