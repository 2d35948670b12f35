"""Other tools at the same tasks, each in a process and an environment of its own.

- planning: PAM-2DIR (a), minimum time over 30 mm, half a cycle whose second half is its mirror
  image, 50 intervals of constant input, or as near to that as a tool comes.
- fitting: the six coefficients of a force law to 60 and to 10 000 cells, with intervals of 95 %.
- simulation: one second of the same slide, its commands joined by lines, tolerance 1e-8.

Every tool states them in its own words (``*_peer.py``), with equations.py as the plant; those
equations are compared with the Plant before anything else, and every answer is verified
(answers.py). One that fails is listed with its message.

- whole: processor seconds from the start of the process to the first result, imports and child
  processes (compilers) included.
- first: the same without imports: statement, transcription, build and solve.
- solve: of the solver alone, or of the whole call again, the best of some.
- error of a plan: the start, inputs and duration found, integrated by SciPy's DOP853 at 1e-11, the
  largest deviation over mesh points and states, over (0.03 m, 1 m/s, 6 bar, 6 bar); of a
  simulation: of the states at all samples, in the same way.
- miss: the largest excess of a plan over the ends and limits of the task, in units as above.
- excess: of the sum of squares above the least one; ends: by how much those of the intervals miss
  the profile likelihood, relative.

Seconds are ratios to the first tool of a table in the same run, the best of some processes.

Run:  python benchmarks/peers/run.py --install [TOOL ...]   (once: an environment per tool)
      python benchmarks/peers/run.py [TOOL ...]
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from answers import Measurements, plan_error, plan_miss, simulation_error
from environments import HERE, OWN, TOOLS, call, install
from equations import forces, slopes

SECONDS = ("whole", "first", "solve")
Checks = Callable[[dict[str, Any]], dict[str, float]]


@dataclass(frozen=True)
class Task:
    """A table: who takes part, and what is told of an answer beside its seconds."""

    name: str
    ways: tuple[tuple[str, ...], ...]
    """(peer, its arguments); the first is the base of all ratios."""
    checks: Checks


def planning() -> Task:
    """PAM-2DIR (a)."""
    ways = (
        ("casadi_opti",),
        ("pam_ocp", "plan", "held"),
        ("pam_ocp", "plan", "fine"),
        ("pam_ocp", "plan", "high"),
        ("rockit", "collocation"),
        ("rockit", "shooting"),
        ("yapss", "low"),
        ("yapss", "high"),
        ("dompc",),
        ("pycollo",),
        ("maptor", "low"),
        ("maptor", "high"),
        ("acados",),
    )
    return Task(
        "planning",
        ways,
        lambda found: {
            "T [s]": found["duration"],
            "iterations": found["iterations"] or float("nan"),
            "error": plan_error(found),
            "miss": plan_miss(found),
        },
    )


def fitting(cells: int, folder: Path) -> Task:
    """A force law to made-up measurements, which are written into the folder."""
    measurements, file = Measurements(cells), folder / f"cells{cells}.json"
    measurements.write(file)
    return Task(
        f"fitting, {cells} cells",
        (("pam_ocp", "fit", str(file)), ("lmfit", str(file))),
        lambda found: {
            "excess": measurements.excess(found["coefficients"]),
            "ends": measurements.ends(found["intervals"]),
        },
    )


def simulation() -> Task:
    """One second of the slide."""
    ways = (
        ("pam_ocp", "simulate"),
        ("pam_ocp", "simulate", "compiled"),
        ("control", "LSODA"),
        ("control", "RK45"),
    )
    return Task("simulation", ways, lambda found: {"error": simulation_error(found)})


def check_equations() -> None:
    """equations.py is the Plant's dynamics: to rounding, wherever the muscles are taut."""
    sys.path.insert(0, str(HERE.parent))
    from pam_2dir import slide

    from pam_ocp.muscles.law import SLACK_WIDTH

    plant, random = slide(), np.random.default_rng(0)
    parameters, checked = plant.vector("parameter"), 0
    while checked < 100:
        x, u = random.uniform([-0.015, -1, 0.5, 0.5], [0.015, 1, 6, 6]), random.uniform(0, 6, 2)
        if min(forces(x[0], x[2], x[3])) < SLACK_WIDTH:
            continue
        units = np.array([1, 1, 1e5, 1e5])
        expected = np.asarray(plant.function(x * units, 1e5 * u, parameters)[0]).ravel() / units
        np.testing.assert_allclose(slopes(*x, *u), expected, rtol=1e-9, atol=1e-9)
        checked += 1


def best(way: tuple[str, ...], repeat: int) -> dict[str, Any] | str:
    """The least seconds of some processes, with the answer of the quickest; or why there is none.

    What fails is not tried again.
    """
    done: list[dict[str, Any]] = []
    for _ in range(repeat):
        found = call(*way)
        if isinstance(found, str):
            return found
        done.append(found)
    chosen = min(done, key=lambda r: float(r["whole"]))
    return chosen | {e: min(r[e] for r in done) for e in SECONDS}


def compare(task: Task, tools: list[str], repeat: int) -> dict[str, Any]:
    """Run and print a table: {name: figures, or the message of a failure}."""
    print(f"\n{task.name}")
    figures: dict[str, Any] = {}
    base: dict[str, Any] | None = None
    for way in task.ways:
        if way[0] not in (*OWN, *tools):
            continue
        found = best(way, repeat)
        if isinstance(found, str):
            name = " ".join(part for part in way if "/" not in part and "\\" not in part)
            figures[name] = found
            print(f"{name:<44}{found}", flush=True)
            continue
        base = base or found
        checked = task.checks(found)
        figures[found["name"]] = {e: round(found[e] / base[e], 3) for e in SECONDS} | {
            n: _rounded(n, v) for n, v in checked.items() if np.isfinite(v)
        }
        ratios = "".join(f"  {e} {found[e] / base[e]:<7.3g}" for e in SECONDS)
        print(f"{found['name']:<44}" + ratios + _words(checked), flush=True)
    if base:
        figures["base"] = {e: float(f"{base[e]:.3g}") for e in SECONDS}
        print(f"1 is {base['name']}: " + ", ".join(f"{e} {base[e]:.3g} s" for e in SECONDS))
    return figures


def _rounded(name: str, value: float) -> float:
    return float(f"{value:.2g}") if name in ("error", "miss", "excess", "ends") else round(value, 6)


def _words(checked: dict[str, float]) -> str:
    shown = ((n, _rounded(n, v)) for n, v in checked.items() if np.isfinite(v))
    return "  ".join(f"{n} {v:g}" for n, v in shown)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tools", nargs="*", metavar="TOOL", help=f"of {', '.join(TOOLS)}")
    parser.add_argument("--install", action="store_true", help="make the environments first")
    parser.add_argument("--json", action="store_true", help="at the end, all figures in one line")
    parser.add_argument("--repeat", type=int, default=3, help="processes a tool, the best counts")
    options = parser.parse_args()
    unknown = set(options.tools) - set(TOOLS)
    if unknown:
        parser.error(f"unknown tool {', '.join(unknown)}; known: {', '.join(TOOLS)}")
    if options.repeat < 1:
        parser.error(f"--repeat must be at least 1, not {options.repeat}")
    tools = options.tools or list(TOOLS)
    failed = install(tools) if options.install else {}
    check_equations()
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        tasks = (planning(), fitting(60, Path(folder)), fitting(10_000, Path(folder)), simulation())
        for task in tasks:
            if any(way[0] in tools for way in task.ways):
                figures[task.name] = compare(task, tools, options.repeat)
    for table in figures.values():
        for name in table:
            table[name] = failed.get(name.split()[0], table[name])
    if options.json:
        print("PEERS " + json.dumps(figures))


if __name__ == "__main__":
    main()
