"""Memory and time of simulate_many into a folder, by the number of cases.

    python benchmarks/many.py [cases ...]

The largest resident memory of this process (its workers' stays that of one task) is read after each
number of cases, in one run: what grows with the cases shows. Short cases, 3 output times.
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


def main() -> None:
    plant = pam.HangingLoad("DMSP-20-400N")
    common = {
        "inputs": {"muscle.command": 4e5},
        "t": np.linspace(0.0, 0.05, 3),
        "rtol": 1e-6,
        "chunk": 200,
        "workers": 2,
    }
    for count in [int(a) for a in sys.argv[1:]] or [2_000, 20_000, 100_000]:
        with tempfile.TemporaryDirectory() as folder:
            seconds = []
            for _ in range(2):  # the second time everything is there
                begin = time.perf_counter()
                stored = pam.simulate_many(plant, cases(count), into=folder, **common)
                seconds.append(time.perf_counter() - begin)
            size = sum(p.stat().st_size for p in Path(folder).iterdir()) / 1e6
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            print(
                f"{count} cases, {len(stored.failures)} failed: {seconds[0]:.0f} s, again "
                f"{seconds[1]:.1f} s, {size:.0f} MB on disk, peak memory {peak:.0f} MB",
                flush=True,
            )


if __name__ == "__main__":
    main()
