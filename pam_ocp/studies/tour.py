"""The tour: the whole chain on a measured muscle, with its figures, FMUs and a summary."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..core.files import atomic_path, make_folder
from ..figures.canvas import save_figure

TABLE = "DMSP-20-300_static.csv"
REST_LENGTH, DIAMETER = 0.300, 0.020
MASS, PRE_CONTRACTION, REACH = 2.0, 0.10, 0.015
RATE = 40e5
CO_CONTRACTION = (2e5, 4e5, 6e5)
LICENCE = (
    "M. Martens, I. Boblan, Actuators 2017, 6(4), 33, doi 10.3390/act6040033, Table A2 (CC BY 4.0)"
)


def tour(folder: Path, say: Callable[[str], None] = print) -> dict[str, Any]:
    """Run the chain and write all results into ``folder``; returns what summary.json holds.

    Raises InputError when the folder cannot be made.
    """
    run = _Tour(make_folder(folder), say)
    steps = (run.fit, run.plant, run.plan, run.export, run.replay, run.linearize)
    for number, step in enumerate(steps, 1):
        run.step(f"[{number}/{len(steps)}] {step.__doc__}")
        step()
    run.finish()
    return run.summary


class _Tour:
    """The steps of the tour; each leaves its results for the next ones."""

    def __init__(self, folder: Path, say: Callable[[str], None]) -> None:
        self.folder, self.say = folder, say
        self.begin = time.perf_counter()
        self.summary: dict[str, Any] = {}

    def step(self, text: str) -> None:
        self.say(f"{time.perf_counter() - self.begin:6.1f} s  {text}")

    def show(self, text: str) -> None:
        for line in text.splitlines():
            self.say(f"          {line}")

    def save(self, figure: Any, name: str) -> None:
        self.show(f"-> {save_figure(figure, self.folder / name)}")

    def fit(self) -> None:
        """fit the six-parameter force law to the measured table"""
        from ..figures.trajectory import plot_fit
        from ..fitting.static.static import fit_force
        from ..fitting.tables.force_table import read_table
        from ..muscles.muscle_file import save_muscle

        self.table = read_table(TABLE, rest_length=REST_LENGTH)
        fitted = fit_force(self.table)
        self.muscle = fitted.muscle(
            rest_length=REST_LENGTH, diameter=DIAMETER, name="DMSP-20-300", source=LICENCE
        )
        save_muscle(self.muscle, self.folder / "muscle.json")
        self.show(fitted.report())
        self.save(plot_fit(fitted), "fit.png")
        self.summary["fit"] = {
            "table": TABLE,
            "source": LICENCE,
            "cells": len(self.table.taut),
            "rmse_N": fitted.rmse,
            "r2": fitted.r2,
            "coefficients": {
                n: {"value": c.value, "stderr": c.stderr} for n, c in fitted.coefficients.items()
            },
        }

    def plant(self) -> None:
        """build the antagonistic slide from two of these muscles"""
        from ..plants.feeds import Regulator
        from ..plants.slide import AntagonisticSlide

        self.slide = AntagonisticSlide(
            self.muscle, MASS, PRE_CONTRACTION, feed=Regulator(0.05, max_rate=RATE), name="slide"
        )
        self.show(repr(self.slide))

    def plan(self) -> None:
        """plan the quickest motion between -15 mm and +15 mm and back"""
        from ..figures.plan import plot_plan
        from ..planning.planner import plan

        self.motion = plan(
            self.slide, stops=[{"x": -REACH}, {"x": REACH}], cyclic=True, minimise="time"
        )
        self.show(str(self.motion))
        self.motion.trajectory.save(self.folder / "plan.csv")
        self.save(plot_plan(self.motion), "motion.png")
        replay = self.motion.replay
        assert replay is not None
        self.summary["plan"] = {
            "duration_s": self.motion.duration,
            "phases_s": list(self.motion.durations),
            "iterations": self.motion.statistics["iterations"],
            "solve_s": self.motion.statistics["solve_seconds"],
            "replay_error_of_nominal": replay.error,
            "bound_violation_of_nominal": replay.violation,
        }

    def export(self) -> None:
        """export the plant as FMU 2.0 and FMU 3.0 for five platforms"""
        from ..export import export_fmu

        self.fmus = {
            version: export_fmu(self.slide, self.folder / f"slide_fmi{version[0]}.fmu", fmi=version)
            for version in ("2.0", "3.0")
        }
        for path in self.fmus.values():
            self.show(f"-> {path} ({path.stat().st_size / 1e3:.0f} kB)")

    def replay(self) -> None:
        """replay the planned motion in Python and in the FMUs (fmpy), and compare"""
        from ..export.check import check_fmus
        from ..figures.trajectory import plot_comparison
        from ..simulation.simulator import simulate

        reference = simulate(self.slide, self.motion.trajectory)
        self.summary["fmu"] = {}
        checks = check_fmus(list(self.fmus.values()), against=reference)
        for version, check in zip(self.fmus, checks, strict=True):
            self.show(str(check))
            self.summary["fmu"][version] = check.to_dict()
        names = ["x", "muscle1.pressure", "muscle1.force"]
        played = check.trajectories["CoSimulation"]
        self.save(plot_comparison(reference, played, names, ("Python", "FMU")), "fmu.png")

    def linearize(self) -> None:
        """linearise about the middle position at three co-contractions"""
        from ..figures.trajectory import plot_bode
        from ..operating.linear import linear_model, modes

        systems = {}
        self.summary["linear"] = []
        for pressure in CO_CONTRACTION:
            point = self.slide.equilibrium({"x": 0.0, "muscle1.pressure": float(pressure)})
            system = linear_model(self.slide, point, stuck=True)
            systems[f"both muscles at {pressure / 1e5:g} bar"] = system
            (frequency, damping), *_ = modes(system)
            self.show(
                f"{pressure / 1e5:g} bar: stiffness {point['stiffness'] / 1e3:.2f} N/mm, "
                f"{frequency:.2f} Hz, damping ratio {damping:.3f}"
            )
            self.summary["linear"].append(
                {
                    "pressure_Pa": pressure,
                    "stiffness_N_per_m": point["stiffness"],
                    "frequency_Hz": frequency,
                    "damping_ratio": damping,
                    "poles": [[float(s.real), float(s.imag)] for s in np.asarray(system.poles())],
                }
            )
        self.save(plot_bode(systems, "x", "muscle1_command", units=("m", "Pa")), "bode.png")

    def finish(self) -> None:
        self.summary["seconds"] = time.perf_counter() - self.begin
        with atomic_path(self.folder / "summary.json") as temporary:
            temporary.write_text(json.dumps(self.summary, indent=2) + "\n", "utf-8")
        with atomic_path(self.folder / "summary.md") as temporary:
            temporary.write_text(_markdown(self.summary), "utf-8")
        self.step(f"done; read {self.folder / 'summary.md'}")


def _markdown(summary: dict[str, Any]) -> str:
    fit, plan = summary["fit"], summary["plan"]
    lines = [
        "# Tour of pam_ocp",
        "",
        f"Measured muscle: {fit['table']}, {fit['source']}.",
        "",
        "| step | result |",
        "|---|---|",
        f"| force law | six parameters, {fit['cells']} taut cells, RMSE {fit['rmse_N']:.2f} N, R2 "
        f"{fit['r2']:.5f} |",
        f"| plan | -15 mm -> +15 mm -> -15 mm in {plan['duration_s'] * 1e3:.2f} ms, "
        f"{plan['iterations']} iterations, {plan['solve_s']:.2f} s |",
        f"| replay of the plan | {plan['replay_error_of_nominal']:.1e} (scaled); bounds kept to "
        f"{plan['bound_violation_of_nominal']:.1e} |",
    ]
    for version, check in summary["fmu"].items():
        worst = ", ".join(f"{mode} {value:.1e}" for mode, value in check["largest"].items())
        verdict = "valid" if not check["findings"] else f"{len(check['findings'])} findings"
        lines.append(
            f"| FMU {version} | {verdict}; against Python: {worst} (scaled by nominal values) |"
        )
    lines += [
        f"| linearised at {row['pressure_Pa'] / 1e5:g} bar | {row['frequency_Hz']:.2f} Hz, "
        f"damping ratio {row['damping_ratio']:.3f}, stiffness "
        f"{row['stiffness_N_per_m'] / 1e3:.2f} N/mm |"
        for row in summary["linear"]
    ]
    lines += [
        "",
        "![Force law](fit.png)\n\n![Motion](motion.png)\n\n![FMU against "
        "Python](fmu.png)\n\n![Bode](bode.png)\n\n"
        f"All of it took {summary['seconds']:.1f} s.",
        "",
    ]
    return "\n".join(lines)
