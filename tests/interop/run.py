"""The FMUs in other people's importers: ``python tests/interop/run.py``, in the project's
environment.

Makes a virtual environment beside this file, installs each importer there, exports the FMUs and the
reference motions with this interpreter, runs the tests, and prints what every importer deviates by.
An importer that cannot be installed or loaded is a skip that says why; one that disagrees is a
failure. Nothing is fetched for what is installed already. Further arguments go to pytest.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
VENV = Path(os.environ.get("PAM_OCP_INTEROP_VENV", HERE / ".venv"))
PYTHON = VENV / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
PIP = ("-m", "pip", "--disable-pip-version-check", "--retries", "1", "--timeout", "20")


def requirements() -> list[str]:
    lines = (HERE / "requirements.txt").read_text(encoding="utf-8").splitlines()
    return [line for line in lines if line and not line.startswith("#")]


def install() -> dict[str, str]:
    """Install one requirement after the other; returns what could not be installed, and why."""
    if not PYTHON.exists():
        subprocess.run([sys.executable, "-m", "venv", str(VENV)], check=True)
    missing = {}
    for line in requirements():
        done = subprocess.run(
            [str(PYTHON), *PIP, "install", "--quiet", line],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode != 0:
            name = line.partition(">")[0]
            words = [w for w in done.stderr.splitlines() if w.startswith("ERROR")]
            missing[name.replace("-", "_")] = "; ".join(words[:2]) or "pip failed"
            print(f"{name} cannot be installed: {missing[name.replace('-', '_')]}")
    return missing


def table(folder: Path) -> str:
    """Importers, their modes, and the largest deviation of each."""
    largest: dict[tuple[str, str], float | str] = {}
    for line in (folder / "results.jsonl").read_text(encoding="utf-8").splitlines():
        tool, mode, value = json.loads(line)
        known = largest.get((tool, mode), 0.0)
        largest[tool, mode] = (
            value if isinstance(value, str) or isinstance(known, str) else max(known, value)
        )
    rows = [
        f"{tool:<26}{mode:<34}{value if isinstance(value, str) else format(value, '.1e'):>16}"
        for (tool, mode), value in sorted(largest.items())
    ]
    head = f"{'importer':<26}{'mode':<34}{'deviation':>16}"
    return "\n".join([head, *rows, "(largest deviation of any state or output, / nominal)"])


def main(arguments: list[str]) -> int:
    print(f"== importers, in {VENV.name} ==", flush=True)
    missing = install()
    with tempfile.TemporaryDirectory(prefix="pam_ocp_interop_") as name:
        folder = Path(name)
        print("== FMUs and reference motions ==", flush=True)
        subprocess.run([sys.executable, str(HERE / "build.py"), name], check=True)
        (folder / "not_installed.json").write_text(json.dumps(missing), encoding="utf-8")
        (folder / "results.jsonl").touch()
        command = [str(PYTHON), "-m", "pytest", str(HERE), f"--confcutdir={HERE}", "-q", "-ra"]
        done = subprocess.run(
            [*command, "-p", "no:cacheprovider", *arguments],
            env={**os.environ, "PAM_OCP_INTEROP": name},
            check=False,
        )
        print(table(folder))
    return done.returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
