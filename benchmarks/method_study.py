"""The planner as one method (``method/``) beside the chain of stages: the same tasks, one by one.

Each task of ``random_tasks.py`` is planned by both in one process each; printed are verdict (of the
judge, and of ``motion_check.py``), objective and processor seconds, and with --stages what the
prototype did, stage by stage.

Run:  python benchmarks/method_study.py SEED 0,3,17 [--seconds 60] [--stages] [--one]
"""

from __future__ import annotations

import argparse
import time
import warnings
from typing import Any

import motion_check
import verdict_study
from method.candidate import Engine
from method.search import Search

import pam_ocp as pam
from pam_ocp.core.stop import TimeIsUp, limited
from pam_ocp.planning.assembly import assembled
from pam_ocp.planning.planner import Planner


def by_method(plant: pam.Plant, stops: Any, seconds: float, **arguments: Any) -> Any:
    """(plan of the prototype or None, its stages)."""
    tolerance, starts = arguments.pop("tolerance", 1e-3), arguments.pop("starts", None)
    planner = Planner(plant, stops, **arguments)
    engine = Engine(planner._program, planner._solver, planner._backend)
    try:
        with limited(seconds):
            found = Search(engine, planner._statement, starts, tolerance).best()
    except (TimeIsUp, pam.PamError):
        return None, engine.stages
    if found.best is None:
        return None, engine.stages
    check = found.best.check
    figures = {"iterations": engine.iterations, **found.figures}
    meshes = (planner._program.mesh, found.best.mesh)
    plan = assembled(check.found, planner._statement, figures, check, meshes, None, tolerance)
    return plan, engine.stages


def told(name: str, task: Any, plan: Any, seconds: float) -> str:
    if plan is None:
        return f"  {name:7s} nothing in {seconds:.1f} s"
    wrong = motion_check.wrong(task, motion_check.Answer.of(plan)) if plan.verified else []
    verdict = "WRONG" if wrong else "verified" if plan.verified else "unverified"
    return f"  {name:7s} {verdict:10s} {plan.objective:.7g} in {seconds:.1f} s"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("seed", type=int)
    parser.add_argument("tasks", help="numbers, as 0,3,17")
    parser.add_argument("--seconds", type=float, default=60.0, help="for each, of the clock")
    parser.add_argument("--stages", action="store_true")
    parser.add_argument("--one", action="store_true", help="the prototype alone")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    for index in map(int, arguments.tasks.split(",")):
        task = verdict_study.drawn(index, arguments.seed)
        print(index, str(task)[:150], flush=True)
        begin = time.process_time()
        plan, stages = by_method(task.plant, task.stops, arguments.seconds, **task.arguments)
        print(told("method", task, plan, time.process_time() - begin), flush=True)
        for stage in stages if arguments.stages else ():
            print("   ", stage)
        if arguments.one:
            continue
        begin = time.process_time()
        try:
            plan = pam.plan(task.plant, task.stops, time_limit=arguments.seconds, **task.arguments)
        except pam.PamError:
            plan = None
        print(told("chain", task, plan, time.process_time() - begin), flush=True)


if __name__ == "__main__":
    main()
