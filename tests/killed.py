"""kill -9 in a loop: whole files, no helpers left, and the next run goes on as if nothing happened.

    python tests/killed.py [--count 10] [--seed 1] [tour|export|simulate_many ...]

Each run of a command is killed at a random moment of the time that it takes; what lies in its
folder is read. Behind the last one the command runs to its end, and its results are looked at.
Exit code 1 when something did not hold. tests/core/test_killed.py runs a few.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
START = "import sys, pam_ocp as pam; out = sys.argv[1]; "
COMMANDS = {
    "tour": "from pam_ocp.studies.tour import tour; tour(__import__('pathlib').Path(out))",
    "export": "pam.export_fmu(pam.HangingLoad('DMSP-20-300', mass=float(sys.argv[2])), "
    "f'{out}/plant.fmu', platforms=['native', 'aarch64-linux'])",
    "simulate_many": "pam.simulate_many(pam.HangingLoad('DMSP-20-300'), "
    "[{'parameters': {'mass': 5.0 + 0.01 * i}} for i in range(2000)], "
    "inputs={'muscle.command': 3e5}, duration=0.2, chunk=50, workers=2, into=out)",
}
PATIENCE = 30.0
"""Till helpers must be gone: a compiler runs to its own end [s]."""


def damaged(folder: Path) -> Iterator[str]:
    """What is not whole among the files of a folder."""
    for path in folder.rglob("*"):
        if path.is_dir() or path.name.startswith("."):
            continue
        content = path.read_bytes()
        try:
            if path.suffix in (".fmu", ".zip"):
                with zipfile.ZipFile(path) as archive:
                    assert archive.testzip() is None
            elif path.suffix == ".json":
                json.loads(content)
            elif path.suffix == ".png":
                assert content.endswith(b"IEND\xaeB`\x82")
            elif path.suffix == ".parquet":
                assert content[:4] == content[-4:] == b"PAR1"
            else:
                assert content
        except (AssertionError, ValueError, zipfile.BadZipFile) as error:
            yield f"{path.name} is not whole: {error!r}"


def hidden(folder: Path) -> list[str]:
    """Temporary files."""
    return sorted(str(p.relative_to(folder)) for p in folder.rglob(".*"))


def helpers(mark: str) -> list[str]:
    """Processes that carry the mark in their environment."""
    found = []
    for process in Path("/proc").iterdir():
        try:
            if process.name.isdigit() and mark.encode() in (process / "environ").read_bytes():
                found.append((process / "cmdline").read_text().replace("\0", " ")[:80])
        except OSError:
            continue
    return found


def begun(name: str, folder: Path, number: int, mark: str) -> subprocess.Popen[bytes]:
    """The command in a process of its own; exports are of another plant each, so they compile."""
    return subprocess.Popen(
        [sys.executable, "-c", START + COMMANDS[name], str(folder), str(10.0 + 1e-3 * number)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        env={**os.environ, "PAM_KILLED": mark, "MPLBACKEND": "Agg"},
    )


def loop(name: str, count: int, chance: random.Random) -> list[str]:
    """Kill the command so often; what did not hold."""
    wrong: list[str] = []
    most = 0
    with tempfile.TemporaryDirectory() as place:
        folder, began, first = Path(place), time.monotonic(), chance.randrange(10**6)
        with tempfile.TemporaryDirectory() as other:
            begun(name, Path(other), first, "whole").communicate()
            whole = sorted(p.name for p in Path(other).rglob("*"))
        lasts = time.monotonic() - began
        for number in range(1, count + 1):
            mark = f"{os.getpid()}-{name}-{number}-"
            process = begun(name, folder, first + number, mark)
            try:
                process.communicate(timeout=chance.uniform(0.0, lasts))
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGKILL)
                process.communicate()
            ends = time.monotonic() + PATIENCE
            while left := helpers(mark):
                if time.monotonic() > ends:
                    wrong.append(f"still running: {left}")
                    break
                time.sleep(0.1)
            wrong += damaged(folder)
            most = max(most, len(hidden(folder)))
        process = begun(name, folder, first + count + 1, "last")
        said = process.communicate()[1].decode()
        if process.returncode:
            wrong.append(f"the run behind the kills failed: {said[-500:]}")
        if hidden(folder):
            wrong.append(f"left: {hidden(folder)}")
        found = sorted(p.name for p in folder.rglob("*"))
        if found != whole:
            wrong.append(f"there are {found}, not {whole}")
    print(f"{name}: killed {count} times, at most {most} temporary files; {len(wrong)} wrong")
    return wrong


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("commands", nargs="*", metavar="COMMAND", help=", ".join(COMMANDS))
    parser.add_argument("--count", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    wrong = []
    for name in options.commands or COMMANDS:
        wrong += loop(name, options.count, random.Random(options.seed))
    print("\n".join(wrong))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
