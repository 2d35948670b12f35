"""Random economical tasks at the default call: those of verdict_study.py that minimise work, air or
exergy, each in a process of its own with so many processor seconds, replayed by SciPy.

Run:  python benchmarks/economy_study.py [tasks] [seed] [--limit SECONDS]
"""

import argparse

import numpy as np
import verdict_study

GOALS = ("work", "air", "exergy")


def economical(seed):
    """Numbers of the tasks of a seed that minimise one of these."""
    index = 0
    while True:
        if verdict_study.drawn(index, seed, False).arguments.get("minimise") in GOALS:
            yield index
        index += 1


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("count", nargs="?", type=int, default=20)
    parser.add_argument("seed", nargs="?", type=int, default=1)
    parser.add_argument("--limit", type=int, default=120)
    arguments = parser.parse_args()
    results = []
    for index, _ in zip(economical(arguments.seed), range(arguments.count), strict=False):
        results.append(verdict_study.limited(index, arguments.seed, False, arguments.limit))
        each = results[-1]
        print(
            f"{index:4d} {each['verdict']:22s} {each['seconds']:6.1f} s  {each['words']}\n"
            f"       {each['why']}",
            flush=True,
        )
    for verdict in sorted({r["verdict"] for r in results}):
        print(f"{sum(r['verdict'] == verdict for r in results):4d} of {len(results)} {verdict}")
    seconds = np.array([r["seconds"] for r in results])
    print(f"seconds a task: median {np.median(seconds):.1f}, worst {seconds.max():.1f}")


if __name__ == "__main__":
    main()
