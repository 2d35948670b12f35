"""Do other starts lead to other plans? Random minimum-time tasks, each from twelve starts.

Two first guesses (states held, or running between the equilibria), three durations of it, two
barrier strategies. Printed: how far the plan from the planner's own start is above the best of
them.

Run:  python benchmarks/local_optima.py [number of tasks]
"""

import sys
import warnings

import numpy as np
import plan_study as study

import pam_ocp as pam


def main(count: int = 20) -> None:
    warnings.simplefilter("ignore")
    rng = np.random.default_rng(4)
    gaps: dict[str, list[float]] = {"regulator": [], "valve": []}
    while sum(map(len, gaps.values())) < count:
        task = study.random_task(rng)
        task.arguments.pop("tolerance")
        if "minimise" in task.arguments:
            continue
        plan = pam.plan(task.plant, task.stops, starts=12, **task.arguments)
        ends = plan.statistics["starts"]  # the planner's own first
        values = [end["objective"] for end in ends if end["solved"]]
        gap = values[0] / min(values) - 1 if ends[0]["solved"] else float("inf")
        gaps["valve" if ", valve" in task.words else "regulator"].append(gap)
        print(
            f"{len(values):2d} of 12 starts solved; own {values[0]:.6f} s, best {min(values):.6f} "
            f"s, {gap:7.1e} above: {task.words.split(', {')[0]}",
            flush=True,
        )
    for feed, each in gaps.items():
        if each:
            print(
                f"{feed}: {len(each)} tasks, at most {max(each):.1e} above the best of the starts"
            )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
