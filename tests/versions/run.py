"""The oldest and the newest set of dependencies: ``python tests/versions/run.py [oldest|newest]
...``.

Each set gets a virtual environment beside this file: "oldest" what oldest.txt pins, on Python 3.10;
"newest" what pip finds, on the newest Python of this machine. A part of the tests runs in each,
chosen to touch every dependency. A machine without such a Python skips that set, and says so; a set
that cannot be installed, or a test that fails, is a failure. Nothing is fetched for what is
installed already.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
PIP = ("-m", "pip", "--disable-pip-version-check", "install", "--quiet")
OLDEST_PYTHON = (3, 10)
TESTS = (
    "cli/test_cli.py",
    "control/test_design_lqr.py",
    "core/test_doors.py",
    "fitting/test_fit_static.py",
    "export/test_fmu_interface.py",
    "export/test_fmu_simulation.py",
    "operating/test_linear.py",
    "operating/test_nlsys.py",
    "package/test_package.py",
    "planning/test_plan.py",
    "plants/test_plants.py",
    "figures/test_plot_plan.py",
    "fitting/test_records.py",
    "simulation/test_simulate.py",
    "fitting/test_tables.py",
    "core/test_trajectory.py",
)


def pythons() -> dict[tuple[int, int], str]:
    """The interpreters of this machine by version: on the path, and those of pyenv."""
    found: dict[tuple[int, int], str] = {}
    versions = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    for minor in range(OLDEST_PYTHON[1], 30):
        name = f"python3.{minor}"
        candidates = [
            shutil.which(name),
            *map(str, sorted(versions.glob(f"3.{minor}.*/bin/python"))),
        ]
        for path in filter(None, candidates):
            code = "import sys, venv; print(*sys.version_info[:2])"
            done = subprocess.run([path, "-c", code], capture_output=True, text=True, check=False)
            if done.stdout.split() == ["3", str(minor)]:
                found[3, minor] = path
    return found


def pinned() -> dict[str, str]:
    """What oldest.txt pins, by name."""
    return dict(re.findall(r"(?m)^([\w-]+)==([\d.]+)$", (HERE / "oldest.txt").read_text("utf-8")))


def install(venv: Path, python: str, requirements: list[str]) -> Path:
    """The interpreter of an environment with these requirements and this project."""
    if not venv.exists():
        subprocess.run([python, "-m", "venv", str(venv)], check=True)
    inside = venv / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    subprocess.run([str(inside), *PIP, *requirements, "-e", f"{ROOT}[cross,excel]"], check=True)
    return inside


def run(name: str) -> int:
    """Install and test one set; pytest's exit code."""
    known = pythons()
    version = OLDEST_PYTHON if name == "oldest" else max(known, default=OLDEST_PYTHON)
    if version not in known:
        print(f"SKIPPED: the {name} set of dependencies, no Python {version[0]}.{version[1]} here")
        return 0
    print(f"== {name} set, Python {version[0]}.{version[1]} ==", flush=True)
    wanted = (
        ["-r", str(HERE / "oldest.txt")]
        if name == "oldest"
        else ["--upgrade", "--upgrade-strategy", "eager", *sorted(pinned())]
    )
    python = install(HERE / f".venv-{name}", known[version], wanted)
    print(
        subprocess.run(
            [str(python), "-m", "pip", "freeze", "--exclude-editable"],
            capture_output=True,
            text=True,
            check=True,
        ).stdout
    )
    command = [
        str(python),
        "-m",
        "pytest",
        "-q",
        "-n",
        "2",
        "-m",
        "not slow",
        "-p",
        "no:cacheprovider",
    ]
    tests = [str(ROOT / "tests" / test) for test in TESTS]
    return subprocess.run([*command, *tests], cwd=ROOT, check=False).returncode


if __name__ == "__main__":
    codes = [run(name) for name in sys.argv[1:] or ("oldest", "newest")]
    sys.exit(max(codes))
