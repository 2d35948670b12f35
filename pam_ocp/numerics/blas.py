"""One thread for the linear algebra inside CasADi's solvers.

Their dense blocks are small, so threads wait for each other: a plan of 20 states takes three times
the processor time on two threads, and twice as long. And sums in another order have other last
digits, so that a plan would depend on how many processors a machine has.
"""

from __future__ import annotations

import ctypes
import os
from functools import cache
from pathlib import Path

import casadi as ca

SAID = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
"""Variables of the environment by which a user says how many: then it stays at that."""


def environment() -> dict[str, str]:
    """For processes of our own: one thread each, unless the user says otherwise."""
    return {**dict.fromkeys(SAID, "1"), **os.environ}


@cache
def one_thread() -> bool:
    """Have the OpenBLAS that came with CasADi (NumPy has its own) compute in one thread, once in a
    process; whether it was found.
    """
    if any(name in os.environ for name in SAID):
        return False
    for path in sorted(Path(ca.__file__).parent.glob("*casadi-tp-openblas*")):
        try:
            set_threads = ctypes.CDLL(str(path)).openblas_set_num_threads
        except (OSError, AttributeError):  # a link that leads nowhere, a text that names a library
            continue
        set_threads(1)
        return True
    return False
