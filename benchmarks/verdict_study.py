"""Can a verdict be trusted? Random tasks at the default call, each plan judged by SciPy.

Each task (``random_tasks.py``: everything that there is) runs in a process of its own. What is
verified is *right* where ``motion_check.py`` finds nothing wrong with it: it shares nothing with
the planner but the equations, and judges by the words of the task. Printed is a line a task and a
summary; the table is also written as JSON lines. Times are those of the processor, all processes of
a task together, and of the clock.

Run:  python benchmarks/verdict_study.py [tasks] [seed] [--seconds 240] [--only i,j] [--start i]
      [--end j] [--terms work,air] [--table FILE]
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import pickle
import resource
import signal
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import motion_check
import numpy as np
import random_tasks

import pam_ocp as pam

WRONG, RIGHT = "WRONGLY VERIFIED", "verified"


def drawn(index: int, seed: int) -> random_tasks.Task:
    """The task of this number."""
    return random_tasks.random_task(np.random.default_rng([seed, index]))


def spent() -> float:
    """Processor seconds of this process and of those it started."""
    each = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in each)


def judged(task: random_tasks.Task, keep: Path | None = None) -> dict[str, Any]:
    """What plan says of one task, and what the check says of that; the answer is kept in a file."""
    begin, clock = spent(), time.monotonic()

    def taken() -> dict[str, float]:
        return {"processor": round(spent() - begin, 2), "clock": round(time.monotonic() - clock, 2)}

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            plan = pam.plan(task.plant, task.stops, **task.arguments)
        except pam.PamError as error:
            words = " ".join(str(error).split())[:400]
            return {"verdict": "refused", "why": [words], **taken()}
    used = taken()
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


def _child(connection: Any, index: int, seed: int, keep: Path | None) -> None:
    os.setsid()  # the processes that it starts are counted and ended with it
    warnings.simplefilter("ignore")
    try:
        task = drawn(index, seed)
        connection.send(str(task))
        connection.send(judged(task, keep and keep / f"{seed}-{index}.pickle"))
    except Exception as error:  # a raw exception is a finding of its own
        words = f"{type(error).__name__}: {error}"
        connection.send({"verdict": "RAISED", "why": [words]})


def spent_by(session: int) -> float:
    """Processor seconds of all processes of a session, those that have ended and were waited for
    included.
    """
    ticks = 0
    for each in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = each.read_text().rpartition(")")[2].split()
        except OSError:  # it has just ended
            continue
        if int(fields[3]) == session:
            ticks += sum(map(int, fields[11:15]))
    return ticks / os.sysconf("SC_CLK_TCK")


def limited(index: int, seed: int, limit: float, keep: Path | None = None) -> dict[str, Any]:
    """``judged`` in a process of its own, given up after ``limit`` seconds of the processor."""
    here, there = multiprocessing.Pipe()
    context = multiprocessing.get_context("fork")
    process = context.Process(target=_child, args=(there, index, seed, keep))
    process.start()
    there.close()
    result: dict[str, Any] = {"index": index, "seed": seed, "task": ""}
    while True:
        if not here.poll(0.2):
            if spent_by(process.pid or 0) > limit:
                result |= {"verdict": "over time", "why": [], "processor": limit}
                break
            continue
        try:
            message = here.recv()
        except EOFError:
            result |= {"verdict": "DIED", "why": []}
            break
        if isinstance(message, dict):
            result |= message
            break
        result["task"] = message
    if process.is_alive() and os.getpgid(process.pid) == process.pid:
        os.killpg(process.pid, signal.SIGKILL)
    process.join(5)
    return result


def numbers(arguments: argparse.Namespace) -> Iterator[int]:
    """Of the tasks that are asked for."""
    if arguments.only:
        yield from map(int, arguments.only.split(","))
        return
    index, left = arguments.start, arguments.count
    terms = set(arguments.terms.split(",")) if arguments.terms else None
    while left and (arguments.end is None or index < arguments.end):
        if terms is None or drawn(index, arguments.seed).arguments.get("minimise") in terms:
            yield index
            left -= 1
        index += 1


def summary(results: list[dict[str, Any]]) -> str:
    """How many of each verdict, and seconds of the processor."""
    names = sorted({r["verdict"] for r in results})
    lines = [f"{sum(r['verdict'] == n for r in results):4d} of {len(results)} {n}" for n in names]
    seconds = np.array([r.get("processor", np.nan) for r in results])
    lines.append(
        f"seconds a task: median {np.nanmedian(seconds):.2f}, worst {np.nanmax(seconds):.1f}"
    )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("count", nargs="?", type=int, default=150)
    parser.add_argument("seed", nargs="?", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=240.0, help="of the processor, for a task")
    parser.add_argument("--only", default="", help="numbers of tasks, as 3,17")
    parser.add_argument("--start", type=int, default=0, help="first number")
    parser.add_argument("--end", type=int, help="before this number")
    parser.add_argument("--terms", default="", help="only tasks that minimise these, as work,air")
    parser.add_argument("--table", type=Path, default=Path("verdicts.jsonl"), help="to write")
    parser.add_argument("--keep", type=Path, help="folder for the answers, to judge them again")
    arguments = parser.parse_args()
    results = []
    with arguments.table.open("a", encoding="utf-8") as table:
        for index in numbers(arguments):
            result = limited(index, arguments.seed, arguments.seconds, arguments.keep)
            results.append(result)
            table.write(json.dumps(result) + "\n")
            table.flush()
            head = f"{index:4d} {result['verdict']:17s} {result.get('processor', np.nan):6.1f} s"
            print(head, result["task"][:400], flush=True)
            for each in result["why"][:6]:
                print(f"       {each[:300]}", flush=True)
    print(summary(results))


if __name__ == "__main__":
    main()
