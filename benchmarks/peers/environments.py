"""Environments of the peers: made once in a folder of caches, from the package index; their runs.

A peer is a script ``NAME_peer.py``, which prints one line ``RESULT {...}``. What fails, to
install or to run, is told with its message.
"""

from __future__ import annotations

import os
import subprocess
import sys
import venv
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path.append(str(HERE.parent))
import harness  # noqa: E402

CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pam_ocp" / "peers"
TOOLS: dict[str, tuple[list[str], ...]] = {
    "rockit": (["rockit-meco"],),
    "yapss": (["yapss"],),
    "dompc": (["do-mpc"],),
    "pycollo": (["pycollo"],),
    "maptor": (["maptor"],),
    # library, headers and code generator in one wheel, with a CasADi of one Python version alone:
    # the usual one is put over it
    "acados": (["comma-deps-acados"], ["scipy", "casadi"]),
    "lmfit": (["lmfit"],),
    "control": (["control"],),
}
"""Peer: what is installed from the package index, one step after another."""
OWN = ("casadi_opti", "pam_ocp")
"""Run by this interpreter."""
LIMIT = 600.0
"""Seconds after which a process is given up."""


def interpreter(tool: str) -> Path:
    """The Python that runs a peer."""
    if tool in OWN:
        return Path(sys.executable)
    return CACHE / tool / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def install(tools: list[str]) -> dict[str, str]:
    """Make the environments that are missing; those that cannot be made, and why."""
    failed = {}
    for tool in tools:
        ready = CACHE / tool / "ready"
        if tool in OWN or ready.is_file():
            continue
        wanted = ", ".join(name for step in TOOLS[tool] for name in step)
        print(f"{tool}: installing {wanted} into {CACHE / tool}", flush=True)
        try:
            venv.create(CACHE / tool, with_pip=True, clear=True)
            for step in TOOLS[tool]:
                command = [str(interpreter(tool)), "-m", "pip", "install", "-q", *step]
                subprocess.run(command, capture_output=True, text=True, check=True)
        except (OSError, subprocess.CalledProcessError) as error:
            said = getattr(error, "stderr", None) or str(error)
            failed[tool] = f"not installed: {harness.last_line(said)}"
            print(f"{tool}: {failed[tool]}", flush=True)
        else:
            ready.touch()
    return failed


def call(tool: str, *arguments: str) -> dict[str, Any] | str:
    """What a peer printed, or why it printed nothing."""
    if tool not in OWN and not (CACHE / tool / "ready").is_file():
        return "not installed (--install)"
    command = [str(interpreter(tool)), str(HERE / f"{tool}_peer.py"), *arguments]
    found = harness.printed(command, "RESULT", LIMIT, _environment(tool))
    return f"failed: {found}" if isinstance(found, str) else found


def _environment(tool: str) -> dict[str, str]:
    """One thread each; byte code kept for all, as for tools that an installer has compiled."""
    left_out = {"PYTHONDONTWRITEBYTECODE"} | (set() if tool in OWN else {"PYTHONPATH"})
    kept = {k: v for k, v in os.environ.items() if k not in left_out}
    return {**kept, **harness.SINGLE}
