"""PAM-2DIR (a) by other optimal-control tools, each in a process and an environment of its own.

The problem is that of benchmarks/plan.py: minimum time over 30 mm, half a cycle whose second half
is its mirror image, 50 intervals of constant input. Every tool states it in its own words
(``*_peer.py``), with equations.py as the plant; the runner compares those equations with the Plant
before anything else.

- whole: seconds from the start of the process to the first result, imports included.
- first: the same without imports: statement, transcription, build and solve.
- solve: of the solver alone, the best of three.
- error: the start, inputs and duration found, integrated by SciPy's DOP853 at 1e-11, the largest
  deviation over mesh points and states, over (0.03 m, 1 m/s, 6 bar, 6 bar).

Figures are ratios to plain CasADi (Opti, Radau of degree 3, unscaled, expanded) in the same run.

Run:  python benchmarks/peers/run.py --install [TOOL ...]   (once: an environment per tool)
      python benchmarks/peers/run.py [TOOL ...]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import venv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from equations import forces, slopes
from scipy.integrate import solve_ivp

HERE = Path(__file__).parent
CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pam_ocp" / "peers"
TOOLS = {
    "rockit": ["rockit-meco"],
    "yapss": ["yapss"],
    "dompc": ["do-mpc"],
    "pycollo": ["pycollo"],
    "maptor": ["maptor"],
    "acados": ["acados-template"],
}
"""Peer: what to install from the package index."""
OWN = ("casadi_opti", "pam_ocp")
"""Run by this interpreter."""
WAYS = (
    ("casadi_opti", ""),
    ("pam_ocp", "held"),
    ("pam_ocp", "fine"),
    ("pam_ocp", "high"),
    ("rockit", "collocation"),
    ("rockit", "shooting"),
    ("yapss", "low"),
    ("yapss", "high"),
    ("dompc", ""),
    ("pycollo", ""),
    ("maptor", ""),
    ("acados", ""),
)
"""(peer, which of its ways), in the order of the table."""
LIMIT = 600.0
"""Seconds after which a process is given up."""
SCALE = np.array([0.03, 1.0, 6.0, 6.0])


@dataclass
class Result:
    """What a peer printed: seconds, iterations, and the motion found [SI]."""

    tool: str
    name: str
    whole: float
    first: float
    solve: float
    iterations: int | None
    """Of IPOPT; None where the tool does not tell."""
    duration: float
    states: np.ndarray
    """(4, intervals + 1) at the mesh points; m, m/s, bar."""
    inputs: np.ndarray
    """(intervals, 2, points): their polynomial in each interval is the input [bar]."""
    breaks: np.ndarray
    """Where intervals meet, as fractions of the duration."""
    points: np.ndarray
    """Of the inputs, as fractions of an interval."""

    def error(self) -> float:
        """Largest deviation of a tight integration of the inputs from the motion found."""
        z, worst = self.states[:, 0] / SCALE, 0.0
        for k, values in enumerate(self.inputs):
            begin, end = self.duration * self.breaks[k : k + 2]
            polynomial = np.polynomial.polynomial.polyfit(
                self.points, values.T, len(self.points) - 1
            )

            def slope(t, y, begin=begin, end=end, polynomial=polynomial):
                u = np.polynomial.polynomial.polyval((t - begin) / (end - begin), polynomial)
                return np.array(slopes(*(y * SCALE), *u)) / SCALE

            run = solve_ivp(slope, (begin, end), z, method="DOP853", rtol=1e-11, atol=1e-11)
            z = run.y[:, -1]
            worst = max(worst, float(np.max(np.abs(z - self.states[:, k + 1] / SCALE))))
        return worst


def interpreter(tool: str) -> Path:
    """The Python that runs a peer."""
    if tool in OWN:
        return Path(sys.executable)
    folder = CACHE / tool
    return folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def install(tools: list[str]) -> None:
    """Make the environments that are missing; one that cannot be made is named and left out."""
    for tool in tools:
        if tool in OWN or (CACHE / tool / "ready").is_file():
            continue
        print(f"{tool}: installing {', '.join(TOOLS[tool])} into {CACHE / tool}", flush=True)
        venv.create(CACHE / tool, with_pip=True, clear=True)
        command = [str(interpreter(tool)), "-m", "pip", "install", "-q", *TOOLS[tool]]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            print(f"{tool}: not installed: {done.stderr.strip().splitlines()[-1]}")
        else:
            (CACHE / tool / "ready").touch()


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


def _environment() -> dict[str, str]:
    """One thread each; byte code kept for all, as for tools that an installer has compiled."""
    kept = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    return {**kept, "OMP_NUM_THREADS": "1"}


def run(tool: str, way: str) -> Result | str:
    """A peer's result, or why there is none."""
    if not (HERE / f"{tool}_peer.py").is_file():
        return (
            "installs, not stated here" if (CACHE / tool / "ready").is_file() else "not installed"
        )
    if tool not in OWN and not (CACHE / tool / "ready").is_file():
        return "not installed (--install)"
    try:
        done = subprocess.run(
            [str(interpreter(tool)), str(HERE / f"{tool}_peer.py"), *([way] if way else [])],
            capture_output=True,
            text=True,
            timeout=LIMIT,
            env=_environment(),
        )
    except subprocess.TimeoutExpired:
        return f"no result in {LIMIT:.0f} s"
    line = next((li for li in done.stdout.splitlines() if li.startswith("RESULT ")), None)
    if done.returncode or line is None:
        return (done.stderr.strip().splitlines() or ["it printed no result"])[-1]
    read = json.loads(line[len("RESULT ") :])
    arrays = {n: np.array(read.pop(n)) for n in ("states", "inputs", "breaks", "points")}
    return Result(tool, **read, **arrays)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("tools", nargs="*", metavar="TOOL", help=f"of {', '.join(TOOLS)}")
    parser.add_argument("--install", action="store_true", help="make the environments first")
    parser.add_argument("--json", action="store_true", help="at the end, all figures in one line")
    parser.add_argument("--repeat", type=int, default=3, help="processes a tool, the best counts")
    options = parser.parse_args()
    unknown = set(options.tools) - set(TOOLS)
    if unknown:
        parser.error(f"unknown tool {', '.join(unknown)}; known: {', '.join(TOOLS)}")
    tools = options.tools or list(TOOLS)
    if options.install:
        install(tools)
    check_equations()
    head = (
        f"{'tool':<44}{'T [s]':>10}{'whole':>8}{'first':>8}"
        f"{'solve':>8}{'iterations':>12}{'error':>10}"
    )
    print(head)
    base: Result | None = None
    figures: dict[str, object] = {}
    for tool, way in WAYS:
        if tool not in (*OWN, *tools):
            continue
        found = [run(tool, way) for _ in range(options.repeat)]
        done = [f for f in found if isinstance(f, Result)]
        if not done:
            print(f"{f'{tool} {way}':<44}{found[0]}")
            figures[f"{tool} {way}".strip()] = found[0]
            continue
        best = min(done, key=lambda r: r.whole)
        best.first, best.solve = (min(getattr(r, e) for r in done) for e in ("first", "solve"))
        base = base or best
        figures[best.name] = {
            e: round(getattr(best, e) / getattr(base, e), 3) for e in ("whole", "first", "solve")
        } | {"error": float(f"{best.error():.1e}")}
        ratios = (getattr(best, e) / getattr(base, e) for e in ("whole", "first", "solve"))
        print(
            f"{best.name:<44}{best.duration:>10.6f}"
            + "".join(f"{r:>8.2f}" for r in ratios)
            + f"{best.iterations or '-':>12}{best.error():>10.1e}",
            flush=True,
        )
    if base:
        print(
            f"({base.name}: whole {base.whole:.2f} s, first {base.first:.2f} s, "
            f"solve {base.solve:.2f} s)"
        )
    if options.json:
        print("PEERS " + json.dumps(figures))


if __name__ == "__main__":
    main()
