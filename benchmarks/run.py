"""All benchmarks by one command: figures, their growth, peers; a file, a page, and a comparison.

    python benchmarks/run.py [--quick] [--out FILE] [--page] [--only GROUP ...] [--peers]
    python benchmarks/run.py --quick --against-commit REVISION     before a change lands
    python benchmarks/run.py --quick --against FILE

Every group of measured.py runs in a process of its own, ``--repeats`` times (five; three with
--quick); medians are kept, with the machine, the versions, the load and the commit, in a JSON
file. ``--against-commit`` measures another state of the package, too, the two taking turns: what a
change costs, whatever the machine. ``--against`` names a file of an earlier run, on this machine.
Figures that are more than 20 % slower are listed, and the exit code is 1 (0 where there is none, 2
where the call is wrong). Peers (peers/run.py: planners, lmfit, python-control) get environments of
their own in a folder of caches, once, with ``--install``; ``--peers`` runs them. ``--page`` writes
the plots (light and dark) and tables of docs/benchmarks.md, and figures.md; with ``--read FILE``
of a run before.

Measure on a quiet machine: ``uptime`` below 0.5. The load at the start is written down.
"""

from __future__ import annotations

import argparse
import compileall
import io
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
import zipfile
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import median
from typing import Any

from harness import SINGLE, printed, write
from measured import GROUPS, HERE

LIMIT = {True: 120.0, False: 900.0}
"""Seconds that a process may take; quick, and in full."""
SLOWER = 1.2
MORE_IS_BETTER = ("SciPy", "python-control", "scaling")
"""Beginnings or parts of figures that had better be large."""
NO_SPEED = ("laws that", "plain,", "plain CasADi", "plain loop [", "SciPy LM")
NO_SPEED += ("error", "wall", "worst")
"""Parts of figures that say nothing of our own speed, or scatter too much to be compared. Ratios to
plain CasADi are compared: they move with ours."""
ON_REQUEST = ("long_works",)
"""Groups that take minutes: measured where --only names them."""
NOISE = 2e-4
"""What is less than this in both is not compared [s, ms, or a ratio]."""
PACKAGES = ("casadi", "numpy", "scipy", "control", "fmpy", "matplotlib", "pyarrow", "distributed")
WANTED: dict[str, tuple[str, float]] = {
    "(a) whole process / plain": ("<=", 1.0),
    "(b) whole process / plain": ("<=", 1.0),
    "(a) first plan / plain": ("<=", 0.5),
    "(b) first plan / plain": ("<=", 0.5),
    "(a) re-solve, whole call / plain cold": ("<=", 0.07),
    "(b) re-solve, whole call / plain cold": ("<=", 0.15),
    "(a) to 1e-6 [s]": ("<=", 0.3),
    "(a) to 1e-6, intervals": ("<=", 20),
    "(a) to 1e-6 by arcs [s]": ("<=", 0.3),
    "(a) to 1e-6 by arcs, intervals": ("<=", 20),
    "Mpc compiled 50, one iteration [ms]": ("<=", 0.5),
    "Mpc compiled 50, converged [ms]": ("<=", 1.0),
    "Mpc compiled 50, one iteration, worst / median": ("<=", 2.5),
    "Mpc compiled 50, converged, worst / median": ("<=", 2.5),
    "Kalman filter [ms]": ("<=", 0.1),
    "Kalman filter, compiled [ms]": ("<=", 0.1),
    "moving horizon [ms]": ("<=", 0.3),
    "moving horizon, compiled [ms]": ("<=", 0.3),
    "fit_force with intervals [s]@60": ("<=", 0.010),
    "fit_force with intervals [s]@10000": ("<=", 0.1),
    "fit_force with intervals [s]@50000": ("<=", 0.5),
    "SciPy LSODA / simulate": (">=", 20),
    "python-control / simulate": (">=", 40),
    "SciPy Radau / simulate": (">=", 80),
    "SciPy LSODA / simulate, compiled": (">=", 20),
    "python-control / simulate, compiled": (">=", 40),
    "SciPy Radau / simulate, compiled": (">=", 80),
    "cvodes / simulate": ("<=", 1.5),
    "simulate, functions of time [ms]": ("<=", 5),
    "simulate 1000 s, 100 001 samples, compiled [s]": ("<=", 1.0),
    "Mpc 50 as FMU, compiled [s]": ("<=", 4.0),
    "Mpc 50 as C, single precision [s]": ("<=", 2.0),
    "examples/robust_plan.py [s]": ("<=", 15),
    "documentation, built [s]": ("<=", 120),
    **{
        f"FMU, {kind}, {case} [units]": ("<=", 2.5)
        for kind in ("slide", "valves")
        for case in ("at rest", "jumps 10 steps apart", "jumps in each step")
    },
    "import beyond CasADi [s]": ("<=", 0.05),
    "tour, warm caches [s]": ("<=", 3.0),
    "compare_laws, 100 cells [s]": ("<=", 0.5),
    "simulations, cost of a case / plain loop": ("<=", 1.05),
    "plans, cost of a case / plain loop": ("<=", 1.05),
    "simulations, scaling on two processes (wall)": (">=", 1.9),
    "plans, scaling on two processes (wall)": (">=", 1.9),
    **{f"iterations@{n}": ("<=", 60) for n in (25, 50, 100, 200, 400, 800)},
}


TREE = HERE.parent
KNOWN = f"of {', '.join(GROUPS)}"


def environment(tree: Path = TREE) -> dict[str, str]:
    """One thread each, and a tree's package: this one's, where no other is named."""
    paths = [str(tree), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    return {**os.environ, **SINGLE, "PYTHONPATH": os.pathsep.join(p for p in paths if p)}


def once(name: str, quick: bool, tree: Path = TREE) -> dict[str, float] | str:
    """The figures of a group with a tree's package, or why there are none."""
    command = [sys.executable, str(HERE / "measured.py"), name, *(["--quick"] if quick else [])]
    return printed(command, "FIGURES", LIMIT[quick], environment(tree))


def about(commit: str = "") -> dict[str, Any]:
    """The machine, what is installed, the load, the commit: this tree's, or one that is named."""

    def installed(package: str) -> str:
        try:
            return version(package)
        except PackageNotFoundError:
            return ""

    named = [commit] if commit else ["--dirty"]
    git = ["git", "-C", str(HERE), "describe", "--always", *named]
    processor = platform.processor() or platform.machine()
    if Path("/proc/cpuinfo").exists():
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = next((li.split(": ")[1] for li in lines if "model name" in li), processor)
    return {
        "time": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "commit": subprocess.run(git, capture_output=True, text=True).stdout.strip(),
        "machine": {"processor": processor, "processors": os.cpu_count()},
        "system": platform.platform(terse=True),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "versions": {"python": platform.python_version()}
        | {p: installed(p) for p in PACKAGES if installed(p)},
    }


class Measured:
    """Runs of groups with one tree's package."""

    def __init__(self, tree: Path = TREE, commit: str = "") -> None:
        self.tree, self.about = tree, about(commit)
        self.runs: dict[str, list[dict[str, float]]] = {}
        self.missing: dict[str, str] = {}
        # an installed package is compiled; where the interpreter writes no caches this one is not
        compileall.compile_dir(tree / "pam_ocp", quiet=2)

    def run(self, name: str, quick: bool) -> str:
        """A group once more; what went wrong. What failed is not tried again."""
        if name in self.missing:
            return ""
        found = once(name, quick, self.tree)
        if isinstance(found, str):
            self.missing[name] = found
            return found
        self.runs.setdefault(name, []).append(found)
        return ""

    def result(self, quick: bool, repeats: int) -> dict[str, Any]:
        """All of it, for a file."""
        figures: dict[str, dict[str, Any]] = {}
        for done in self.runs.values():
            for name in dict.fromkeys(n for run in done for n in run):
                values = [run[name] for run in done if name in run]
                figures[name] = {"median": median(values), "values": values}
        kept = {"quick": quick, "repeats": repeats, "figures": figures, "missing": self.missing}
        return {**self.about, **kept}


def measure(
    names: list[str], quick: bool, repeats: int, trees: list[Measured]
) -> list[dict[str, Any]]:
    """The figures of each tree; groups and trees take turns, so that a busy minute hits all."""
    for turn in range(repeats):
        for name in names:
            for measured in trees:
                begin = time.perf_counter()
                said = measured.run(name, quick)
                seconds, who = time.perf_counter() - begin, measured.about["commit"]
                print(f"{turn + 1}/{repeats} {name:<12}{seconds:7.1f} s  {who}  {said}", flush=True)
    return [measured.result(quick, repeats) for measured in trees]


def unpacked(revision: str, folder: Path) -> Path:
    """The package as it was at a commit, in a folder; SystemExit(2) where git knows none."""
    git = ["git", "-C", str(TREE), "archive", "--format=zip", revision, "pam_ocp", "fmu"]
    done = subprocess.run(git, capture_output=True)
    if done.returncode:
        print(f"--against-commit {revision}: {done.stderr.decode().strip()}", file=sys.stderr)
        raise SystemExit(2)
    with zipfile.ZipFile(io.BytesIO(done.stdout)) as packed:
        packed.extractall(folder)
    return folder


def reached(name: str, value: float) -> bool | None:
    """Whether a figure is what is wanted of it; None where nothing is."""
    if name not in WANTED:
        return None
    sign, wanted = WANTED[name]
    return value <= wanted if sign == "<=" else value >= wanted


def goal(name: str) -> str:
    """What is wanted of a figure, in words."""
    return "{} {:g}".format(*WANTED[name]) if name in WANTED else ""


def show(result: dict[str, Any]) -> None:
    """The figures as a table."""
    for name, figure in result["figures"].items():
        said = reached(name, figure["median"])
        mark = "" if said is None else "reached" if said else "MISSED"
        span = f"{min(figure['values']):.3g} .. {max(figure['values']):.3g}"
        print(f"{name:<54}{figure['median']:>10.4g}  {span}  {goal(name):>9} {mark}")
    for name, why in result["missing"].items():
        print(f"{name}: not measured: {why}")
    for task, tools in result.get("peers", {}).items():
        print(task if isinstance(tools, dict) else f"{task}: {tools}")
        for tool, said in tools.items() if isinstance(tools, dict) else ():
            words = (
                said if isinstance(said, str) else "  ".join(f"{k} {v:g}" for k, v in said.items())
            )
            print(f"  {tool:<44}{words}")


def slower(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """What has become more than 20 % slower, in words; best values are compared."""
    found = []
    for name, figure in after["figures"].items():
        old = before["figures"].get(name)
        if old is None or any(part in name for part in NO_SPEED):
            continue
        if any(part in name for part in MORE_IS_BETTER):
            ratio = max(old["values"]) / max(max(figure["values"]), 1e-12)
        else:
            least = min(old["values"])
            if max(least, min(figure["values"])) < NOISE or least <= 0:
                continue
            ratio = min(figure["values"]) / least
        if ratio > SLOWER:
            medians = f"median {old['median']:.4g} -> {figure['median']:.4g}"
            found.append(f"{name}: {100 * (ratio - 1):.0f} % slower ({medians})")
    for name, why in after["missing"].items():
        if name not in before["missing"]:
            found.append(f"{name}: not measured any more: {why}")
    return found


def apart(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """In what two runs differ beside the package, so that their seconds cannot be compared."""
    found = []
    for what in ("machine", "system", "quick", "versions"):
        if before.get(what) != after.get(what):
            found.append(f"{what}: {before.get(what)} -> {after.get(what)}")
    return found


def peers(tools: bool, repeats: int) -> dict[str, Any]:
    """Other tools at the same tasks, by peers/run.py; those that fail are listed as such."""
    command = [sys.executable, str(HERE / "peers" / "run.py"), "--json", "--repeat", str(repeats)]
    command += ["--install"] if tools else []
    found: dict[str, Any] = {}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment()) as work:
        for line in work.stdout or ():
            if line.startswith("PEERS "):
                found = json.loads(line[len("PEERS ") :])
            else:
                print(line, end="", flush=True)
    return found or {"all": f"peers/run.py ended with {work.returncode} and told nothing"}


def stored(path: str) -> dict[str, Any]:
    """A file of an earlier run, for argparse."""
    try:
        found: dict[str, Any] = json.loads(Path(path).read_text("utf-8"))
        missing = {"figures", "missing", "quick"} - set(found)
    except (OSError, ValueError) as error:
        raise argparse.ArgumentTypeError(f"{path}: {error}") from error
    if missing:
        raise argparse.ArgumentTypeError(
            f"{path} has no {', '.join(sorted(missing))}: not of --out"
        )
    return found


def parsed(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="small sizes; below 6 minutes")
    parser.add_argument("--repeats", type=int, help="of each group (5; 3 with --quick)")
    parser.add_argument("--out", type=Path, default=Path("benchmarks.json"), metavar="FILE")
    other = parser.add_mutually_exclusive_group()
    other.add_argument("--against", type=stored, metavar="FILE", help="of an earlier run")
    other.add_argument("--against-commit", metavar="REVISION", help="measured in the same minutes")
    parser.add_argument("--only", nargs="+", choices=list(GROUPS), metavar="GROUP", help=KNOWN)
    parser.add_argument("--peers", action="store_true", help="other tools, too")
    parser.add_argument("--install", action="store_true", help="make the peers' environments first")
    parser.add_argument("--page", action="store_true", help="plots and tables of the page")
    parser.add_argument("--read", type=stored, metavar="FILE", help="measure nothing; take this")
    options = parser.parse_args(arguments)
    if options.repeats is not None and options.repeats < 1:
        parser.error(f"--repeats must be at least 1, not {options.repeats}")
    if options.read and options.against_commit:
        parser.error("--read measures nothing: compare files with --against FILE")
    return options


def found(options: argparse.Namespace) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """This tree's figures, and those that they are compared with."""
    if options.read:
        return options.read, options.against
    repeats = options.repeats or (3 if options.quick else 5)
    names = options.only or [name for name in GROUPS if name not in ON_REQUEST]
    with tempfile.TemporaryDirectory() as folder:
        trees = [Measured()]
        if options.against_commit:
            tree = unpacked(options.against_commit, Path(folder))
            trees.append(Measured(tree, options.against_commit))
        result, *others = measure(names, options.quick, repeats, trees)
    if options.peers or options.install:
        result["peers"] = peers(options.install, repeats if options.quick else 3)
    write(options.out, json.dumps(result, indent=1) + "\n")
    return result, others[0] if others else options.against


def main(arguments: list[str] | None = None) -> int:
    options = parsed(arguments)
    result, before = found(options)
    show(result)
    if (result["load"] or 0) > 0.5:
        print(f"the load was {result['load']:.1f} at the start: seconds are not to be trusted")
    if options.page:
        from page import write_page

        print("-> " + ", ".join(str(p) for p in write_page(result)))
    if before is None:
        return 0
    for difference in apart(before, result):
        print(f"not the same {difference}")
    worse = slower(before, result)
    print("\n".join(worse) if worse else "nothing is more than 20 % slower")
    return 1 if worse else 0


if __name__ == "__main__":
    sys.exit(main())
