"""A part of the tests as on another machine: ``python tests/elsewhere.py [--seed N] [part ...]``.

locale  German: decimal commas in C's and Python's numbers, for FMUs and tables.
zone    Chatham Islands, 12 h 45 min (13 h 45 min in summer) ahead.
user    nobody, without a home (where this one is root).
order   modules, and tests within each, in random order; the seed is told, and repeats it.

All at once, or the parts named. What a machine does not have is left out, and said.
"""

from __future__ import annotations

import argparse
import os
import random
import site
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
TESTS = (
    "cli/test_cli.py",
    "core/test_damaged_files.py",
    "core/test_stop.py",
    "core/test_trajectory.py",
    "core/test_variables.py",
    "core/test_writing.py",
    "export/test_fmu_cache.py",
    "export/test_fmu_export.py",
    "export/test_fmu_simulation.py",
    "fitting/test_records.py",
    "fitting/test_tables.py",
    "muscles",
    "planning/test_plan_file.py",
    "simulation/test_many_stored.py",
    "simulation/test_simulate.py",
)
"""Quick ones that read, write, print, compile, or start processes."""
NOBODY = 65534
LOCALE = "de_DE"


def localised(folder: Path) -> dict[str, str] | None:
    """The environment of the other locale, made where it is not installed."""
    # the system's own sentences stay English: tests look for their words
    spoken = {"LANG": f"{LOCALE}.UTF-8", "LC_MESSAGES": "C", "PAM_TEST_LOCALE": "1"}
    there = subprocess.run(["locale", "-a"], capture_output=True, text=True, check=False).stdout
    if f"{LOCALE}.utf8" in there.split():
        return spoken
    made = folder / f"{LOCALE}.UTF-8"
    command = ["localedef", "-i", LOCALE, "-f", "UTF-8", str(made)]
    try:
        done = subprocess.run(command, capture_output=True, check=False)
    except FileNotFoundError:
        return None
    if done.returncode > 1 or not made.is_dir():  # 1: warnings
        return None
    return {**spoken, "LOCPATH": str(folder)}


def another_user(environment: dict[str, str]) -> list[str]:
    """The Python that nobody runs, and what stands before it; empty where that cannot be.

    An interpreter in a closed home cannot; the system's of the same version does with our packages.
    """
    if not hasattr(os, "getuid") or os.getuid() != 0:
        return []
    drop = ["setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups"]
    probe = "import subprocess, sys, pytest, xdist, pam_ocp.core.stop\n"
    probe += "subprocess.run([sys.executable, '-c', 'import pam_ocp.core.stop'], check=True)"
    for python in (sys.executable, f"/usr/bin/python3.{sys.version_info.minor}"):
        command = [*drop, python]
        try:
            subprocess.run(
                [*command, "-c", probe], env=environment, cwd=ROOT, capture_output=True, check=True
            )
        except (FileNotFoundError, subprocess.CalledProcessError):
            continue
        return command
    return []


def main() -> int:
    parts = ("locale", "zone", "user", "order")
    parser = argparse.ArgumentParser()
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(parts))
    parser.add_argument("--seed", type=int, default=random.randrange(10**6))
    parser.add_argument("--tests", nargs="*", default=[f"tests/{t}" for t in TESTS])
    options = parser.parse_args()
    wanted = options.parts or parts
    environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1", "MPLBACKEND": "Agg"}
    python = [sys.executable]
    arguments = ["-q", "-n", "2", "-m", "not slow", "-p", "no:cacheprovider"]
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        folder.chmod(0o777)
        if "locale" in wanted:
            found = localised(folder)
            print(f"locale: {found['LANG']}" if found else "SKIPPED: no other locale here")
            if found:
                environment.pop("LC_ALL", None)
                environment |= found
        if "zone" in wanted:
            environment["TZ"] = "Pacific/Chatham"
        if "user" in wanted:
            own = {**environment, "HOME": "/nonexistent", "MPLCONFIGDIR": str(folder / "mpl")}
            own["PYTHONPATH"] = os.pathsep.join([str(ROOT), *site.getsitepackages()])
            found_python = another_user(own)
            print("user: nobody" if found_python else "SKIPPED: nobody can run this Python here")
            if found_python:
                python, environment = found_python, own
                os.chown(folder, NOBODY, NOBODY)
                arguments += [f"--basetemp={folder}/tests"]
        if "order" in wanted:
            print(f"order: --seed {options.seed}")
            arguments += ["--shuffle", str(options.seed)]
        sys.stdout.flush()
        command = [*python, "-m", "pytest", *arguments, *options.tests]
        return subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
