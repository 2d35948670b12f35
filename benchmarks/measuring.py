"""How figures are measured: groups, processor seconds, the plant that most of them share."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from statistics import median
from time import process_time
from typing import Any

HERE = Path(__file__).resolve().parent
GROUPS: dict[str, Callable[[bool], dict[str, float]]] = {}
BAR = 1e5
STOPS = [{"x": -0.015}, {"x": 0.015}]


def group(function: Callable[[bool], dict[str, float]]) -> Callable[[bool], dict[str, float]]:
    """A function that measures figures."""
    GROUPS[function.__name__] = function
    return function


def spent(*command: str) -> float:
    """Processor seconds of a whole process and its children; RuntimeError when it fails."""
    import resource

    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([sys.executable, *command], capture_output=True, text=True, cwd=HERE)
    if done.returncode:
        raise RuntimeError(done.stderr.strip()[-500:])
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def timed(work: Callable[[], Any], repeats: int = 3) -> float:
    """Median processor seconds of a call, after one for warming up."""
    work()
    seconds = []
    for _ in range(repeats):
        begin = process_time()
        work()
        seconds.append(process_time() - begin)
    return median(seconds)


def slide(case: str = "a") -> Any:
    """The plant of PAM-2DIR."""
    sys.path.insert(0, str(HERE))
    import pam_2dir

    return pam_2dir.slide() if case == "a" else pam_2dir.commanded()


def wish(case: str) -> dict[str, Any]:
    """What is asked of it."""
    if case == "a":
        return {"cyclic": "mirrored"}
    return {"cyclic": "mirrored", "duration": 0.15, "minimise": {"effort": 1e-2}}


def write(path: Path, text: str) -> None:
    """A file at once: into a new one beside it, which then takes its name."""
    part = path.with_name(f"{path.name}.part")
    part.write_text(text, "utf-8")
    part.replace(path)
