"""One thread inside CasADi's solvers, however many processors there are; memory that stays."""

import ctypes
import os
import subprocess
import sys

import pytest

from pam_ocp.numerics.solvers import SAID

ASKED = """
import ctypes
from pathlib import Path
import casadi as ca
path = min(Path(ca.__file__).parent.glob("libcasadi-tp-openblas.*"))
library = ctypes.CDLL(str(path))
library.openblas_set_num_threads(3)
from pam_ocp.numerics.solvers import nlpsol, quiet_ipopt
x = ca.SX.sym("x")
solver = nlpsol("solver", "ipopt", {"x": x, "f": (x - 2) ** 2}, quiet_ipopt())
assert abs(float(solver(x0=0)["x"]) - 2) < 1e-8
print(library.openblas_get_num_threads())
"""


@pytest.mark.skipif(sys.platform == "win32", reason="the library has another name there")
@pytest.mark.parametrize(("said", "threads"), [({}, 1), ({SAID[0]: "2"}, 3), ({SAID[1]: "2"}, 3)])
def test_a_solver_computes_in_one_thread_unless_the_user_said_how_many(said, threads):
    plain = {name: value for name, value in os.environ.items() if name not in SAID}
    run = [sys.executable, "-c", ASKED]
    done = subprocess.run(run, env={**plain, **said}, capture_output=True, text=True, check=True)
    assert int(done.stdout) == threads


BLOCK = """
import ctypes
from pam_ocp.numerics.solvers import nlpsol, quiet_ipopt
import casadi as ca
x = ca.SX.sym("x")
nlpsol("solver", "ipopt", {"x": x, "f": x**2}, quiet_ipopt())
library = ctypes.CDLL(None)
class Info(ctypes.Structure):
    _fields_ = [(n, ctypes.c_size_t) for n in ("arena", "o", "s", "blocks", "bytes", *"abcde")]
library.mallinfo2.restype, library.malloc.restype = Info, ctypes.c_void_p
before = library.mallinfo2().blocks
held = library.malloc(ctypes.c_size_t(100 * 2**20))
print(library.mallinfo2().blocks - before)
"""


@pytest.mark.skipif(
    not hasattr(ctypes.CDLL(None) if sys.platform == "linux" else None, "mallinfo2"),
    reason="another C library",
)
@pytest.mark.parametrize(("said", "asked"), [({}, 0), ({"MALLOC_ARENA_MAX": "4"}, 1)])
def test_large_blocks_come_from_memory_that_is_kept_unless_the_user_said_how(said, asked):
    plain = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    run = [sys.executable, "-c", BLOCK]
    done = subprocess.run(run, env={**plain, **said}, capture_output=True, text=True, check=True)
    assert int(done.stdout) == asked  # of the system alone
