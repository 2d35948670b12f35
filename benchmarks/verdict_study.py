"""Can a verdict be trusted? Random tasks at the default call, each plan judged by SciPy.

    python benchmarks/verdict_study.py [tasks] [seed] [--seconds 240] [--only i,j] [--start i]
                                       [--end j] [--terms work,air] [--table FILE] [--keep FOLDER]

Each task (``random_tasks.py``: everything that there is) runs in a process of its own. What is
verified is *right* where ``motion_check.py`` finds nothing wrong with it: it shares nothing with
the planner but the equations, and judges by the words of the task. Printed is a line a task and a
summary; the table is also written as JSON lines. Times are those of the processor, all processes of
a task together, and of the clock.
"""

from __future__ import annotations

import pickle
from functools import partial
from pathlib import Path

import harness
import motion_check
import numpy as np
import random_tasks

import pam_ocp as pam

WRONG, RIGHT = "WRONGLY VERIFIED", "verified"


def drawn(index: int, seed: int) -> random_tasks.Task:
    """The task of this number."""
    return random_tasks.random_task(np.random.default_rng([seed, index]))


def judged(task: random_tasks.Task, keep: Path | None = None) -> harness.Row:
    """What plan says of one task, and what the check says of that; the answer is kept in a file."""
    begin = harness.spent()
    try:
        plan = pam.plan(task.plant, task.stops, **task.arguments)
    except pam.PamError as error:
        return {"verdict": "refused", "why": [" ".join(str(error).split())[:400]]}
    used = {"processor": round(harness.spent() - begin, 2)}
    if not plan.solved:
        return {"verdict": "unverified", "why": [str(plan.verdict)], **used}
    answer = motion_check.Answer.of(plan)
    if keep is not None:
        keep.write_bytes(pickle.dumps((answer, plan.verified, str(plan.verdict))))
    findings = [str(each) for each in motion_check.wrong(task, answer)]
    verdict = (WRONG if findings else RIGHT) if plan.verified else "unverified"
    if verdict == "unverified":
        findings = [str(plan.verdict), *(findings or ["but right"])]
    figures = {"duration": plan.duration, "objective": plan.objective}
    return {"verdict": verdict, "why": findings, **figures, **used}


def one(index: int, seed: int, keep: Path | None) -> harness.Row:
    task = drawn(index, seed)
    harness.about(str(task))
    file = keep and keep / f"{seed}-{index}.pickle"
    return {"index": index, "task": str(task), "text": str(task), **judged(task, file)}


def cases(given: harness.Given) -> harness.Keyed:
    terms = set(given.terms.split(",")) if given.terms else None

    def wanted(index: int) -> bool:
        if terms is None:
            return True
        return str(drawn(index, given.seed).arguments.get("minimise")) in terms  # sums are dicts

    for index in harness.numbers(given, wanted):
        yield index, partial(one, index, given.seed, given.keep)


OPTIONS = {
    "--terms": {"default": "", "help": "only tasks that minimise these, as work,air"},
    "--keep": {"type": Path, "help": "folder for the answers, to judge them again"},
}

if __name__ == "__main__":
    harness.main(__doc__, cases, count=150, seed=1, options=OPTIONS, seconds=240.0)
