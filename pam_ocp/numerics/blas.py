"""One thread for the linear algebra inside CasADi's solvers, and memory that stays with them.

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


KEPT = 128 * 2**20
"""Freed memory that is not handed back to the system, and blocks that are not asked of it alone
[bytes]: more than MUMPS works in."""
TRIM, MMAP = -1, -3
"""Names of these two in the GNU C library's ``mallopt``."""


@cache
def hold_memory() -> bool:
    """Let the C library hold on to freed memory, once in a process; whether it can.

    MUMPS asks anew for its working space in each factorisation, and to get it from the system is a
    tenth of a long plan's time. A user's own settings stay.
    """
    if any(name.startswith(("MALLOC_", "GLIBC_TUNABLES")) for name in os.environ):
        return False
    try:
        settle = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):  # another C library
        return False
    return all(settle(name, KEPT) for name in (TRIM, MMAP))
