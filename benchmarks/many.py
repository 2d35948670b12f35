"""Memory and time of simulate_many into a folder, by the number of cases.

    python benchmarks/many.py [cases ...]

The largest resident memory of this process and of one worker is read at every tenth of the cases:
what grows with them shows. Short cases, 3 output times. Then the same again, all there.
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import pam_ocp as pam


def cases(count: int) -> Iterator[dict[str, Any]]:
    """Loads from 5 to 50 kg, made one by one."""
    return ({"parameters": {"mass": 5.0 + 45.0 * i / count}} for i in range(count))


def peak(who: int = resource.RUSAGE_SELF) -> float:
    """The largest resident memory so far [MB]."""
    return resource.getrusage(who).ru_maxrss / 1024


def main() -> None:
    plant = pam.HangingLoad("DMSP-20-400N")
    common = {
        "inputs": {"muscle.command": 4e5},
        "t": np.linspace(0.0, 0.02, 3),
        "rtol": 1e-4,
        "chunk": 500,
        "workers": 2,
    }
    for count in [int(a) for a in sys.argv[1:]] or [100_000]:
        met: dict[int, float] = {}

        def note(done: int, _: int | None, count: int = count, met: dict[int, float] = met) -> None:
            if done * 10 // count > len(met):
                met[done] = peak()

        with tempfile.TemporaryDirectory() as folder:
            seconds = []
            for _ in range(2):  # the second time everything is there
                begin = time.perf_counter()
                stored = pam.simulate_many(
                    plant, cases(count), into=folder, progress=note, **common
                )
                seconds.append(time.perf_counter() - begin)
            size = sum(p.stat().st_size for p in Path(folder).iterdir()) / 1e6
            print("peak memory [MB] after so many cases:")
            print(", ".join(f"{done}: {mb:.0f}" for done, mb in met.items()))
            print(
                f"{count} cases, {len(stored.failures)} failed: {seconds[0]:.0f} s, again "
                f"{seconds[1]:.1f} s, {size:.0f} MB on disk, a worker "
                f"{peak(resource.RUSAGE_CHILDREN):.0f} MB",
                flush=True,
            )


if __name__ == "__main__":
    main()
