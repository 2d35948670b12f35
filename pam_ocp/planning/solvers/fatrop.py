"""fatrop on the stage-ordered program, in a process of its own that a time limit can end.

fatrop (Vanroye, Sathya, De Schutter, Decre, FATROP: a fast constrained optimal control problem
solver, IROS 2023) eliminates stage after stage instead of factorising one large matrix. Its version
1.1.8 may run for ever, in C, where no exception reaches it: hence the process.
"""

from __future__ import annotations

import contextlib
import pickle
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError
from ..transcription.stage_order import stage_ordered
from ..transcription.transcription import Program
from .solver import Outcome

__all__ = ["DEFAULTS", "TIME_LIMIT", "Fatrop"]

Array: TypeAlias = NDArray[np.float64]

DEFAULTS: dict[str, Any] = {
    "tolerance": 1e-9,
    "mu_init": 1e-2,
    "max_iter": 300,
    "print_level": 0,
}
"""fatrop's options; ``plan(..., solver="fatrop", options=...)`` overrides them."""

TIME_LIMIT = 20.0
"""Seconds for one solve; the first takes the start of the process and the derivatives besides."""

SERVER = Path(__file__).with_name("fatrop_server.py")


class Fatrop:
    """fatrop for a program, built once, for any number of solves.

    ``time_limit`` [s], among the options, ends a solve: its process is killed, and the outcome says
    so. A solve starts from primal values alone: fatrop takes no multipliers.
    """

    def __init__(self, program: Program, options: Mapping[str, Any] | None = None) -> None:
        if not ca.has_nlpsol("fatrop"):
            raise InputError("solver = 'fatrop': this CasADi has no fatrop; use solver='ipopt'")
        given = dict(options or {})
        limit = given.pop("time_limit", TIME_LIMIT)
        if not (isinstance(limit, int | float) and limit > 0):
            raise InputError(f"options: time_limit = {limit!r}: give seconds > 0")
        self.time_limit = float(limit)
        self.stages = stage_ordered(program)
        self._options = {
            "print_time": False,
            "inputs_check": False,
            "structure_detection": "manual",
            **self.stages.sizes,
            "expand": program.mesh.form.scheme
            != "shooting",  # RK4 expanded is slow to differentiate
            "fatrop": {**DEFAULTS, **given},
        }
        self._process: subprocess.Popen[bytes] | None = None

    def __call__(self, program: Program, guess: Array) -> Outcome:
        """Solve for the program's values (same expressions as the one built)."""
        begin = time.perf_counter()
        stages, parameters = self.stages, program.parameters()
        lbx, ubx = stages.bounds(program)
        lbg, ubg = stages.limits(program)
        z = stages.lifted(np.clip(program.completed(guess), *program.bounds()), parameters)
        arguments = {"x0": z, "p": parameters, "lbx": lbx, "ubx": ubx, "lbg": lbg, "ubg": ubg}
        answer, status = self._asked(arguments)
        seconds = time.perf_counter() - begin
        if "option not supported" in str(answer.get("error")):
            raise InputError(f"options: {str(answer['error']).splitlines()[-1]}")
        if "x" not in answer:
            nothing = np.zeros(program.nlp["g"].numel())
            return Outcome(
                guess, float("nan"), status, False, 0, seconds, nothing, np.zeros(len(guess))
            )
        lam_g, lam_x = stages.lowered_multipliers(answer["lam_g"], answer["lam_x"])
        success = bool(answer["success"] and np.all(np.isfinite(answer["x"])))
        return Outcome(
            stages.lowered(answer["x"]),
            float(answer["f"][0]),
            "fatrop: solved" if success else "fatrop: not converged",
            success,
            int(answer["iterations"]),
            seconds,
            lam_g,
            lam_x,
            solver="fatrop",
        )

    def _asked(self, arguments: dict[str, Any]) -> tuple[dict[str, Any], str]:
        """(answer of the process, status); an empty answer when there is none in time."""
        messages: list[Any] = [arguments]
        if self._process is None:
            self._process = self._started()
            messages.insert(0, (self._serialized(), self._options, self.time_limit))
        process, late = self._process, threading.Event()
        assert process.stdin is not None
        assert process.stdout is not None

        def kill() -> None:
            late.set()
            process.kill()

        timer = threading.Timer(self.time_limit, kill)
        timer.start()
        try:
            for message in messages:
                pickle.dump(message, process.stdin)
            process.stdin.flush()
            answer: dict[str, Any] = pickle.load(process.stdout)
        except (EOFError, OSError, pickle.UnpicklingError):
            self._end()
            if late.is_set():
                return {}, f"fatrop: no result within {self.time_limit:g} s"
            return {}, "fatrop: its process died"
        except BaseException:  # interrupted: an answer still to come would be taken for the next
            self._end()
            raise
        finally:
            timer.cancel()
            if late.is_set():
                self._end()
        return answer, f"fatrop: {answer['error']}" if "error" in answer else ""

    def _started(self) -> subprocess.Popen[bytes]:
        process = subprocess.Popen(
            [sys.executable, str(SERVER)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        self._finalizer = weakref.finalize(self, _ended, process)
        return process

    def _serialized(self) -> str:
        nlp = self.stages.nlp
        problem = ca.Function("problem", [nlp["x"], nlp["p"]], [nlp["f"], nlp["g"]])
        return str(problem.serialize())

    def _end(self) -> None:
        """End the process; the next solve starts another."""
        if self._process is not None:
            self._finalizer()
            self._process = None


def _ended(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()
    for stream in (process.stdin, process.stdout):
        if stream is not None:
            with contextlib.suppress(OSError):  # what was being written is lost with the process
                stream.close()
