"""CasADi's solvers and integrators as this library calls them: signals and time limits end them,
their linear algebra has one thread, memory stays with them; and functions on fixed memory.

Nothing else makes one by CasADi's own names, so no place can forget; tests/package has a check.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.stop import ask, native


class Native:
    """A CasADi function whose calls may take long; see :func:`pam_ocp.core.stop.native`."""

    def __init__(self, function: ca.Function, held: bool = False) -> None:
        self.function = function
        self._held = held

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return native(self.function, *args, held=self._held, **kwargs)

    def __getattr__(self, name: str) -> Any:
        if name == "function":
            raise AttributeError(name)
        return getattr(self.function, name)


def stoppable(function: ca.Function) -> Native:
    """A function with an integrator in it, so that its calls can be broken off."""
    return Native(function)


def integrator(
    name: str, plugin: str, dae: Mapping[str, Any], t0: float, times: Any, options: Any
) -> Native:
    """``casadi.integrator``; ``.function`` is CasADi's own, for expressions."""
    return Native(native(ca.integrator, name, plugin, dae, t0, times, options))


def conic(name: str, plugin: str, sparsities: Mapping[str, Any], options: Any) -> Native:
    """``casadi.conic``; ``.function`` is CasADi's own, for expressions and buffers."""
    return Native(ca.conic(name, plugin, sparsities, options))


def quiet_ipopt(plugin: Mapping[str, Any] | None = None, /, **ipopt: Any) -> dict[str, Any]:
    """Options of :func:`nlpsol` for IPOPT that prints nothing and only tells how it ended.

    plugin : further options of CasADi's interface. ipopt : of IPOPT itself.
    """
    return {
        "print_time": False,
        "error_on_fail": False,
        "calc_lam_p": False,
        "show_eval_warnings": False,
        **(plugin or {}),
        "ipopt": {"print_level": 0, "sb": "yes", **ipopt},
    }


class _Watch(ca.Callback):
    """An ``iteration_callback`` for CasADi's interface to IPOPT.

    report : called with (x, f, g) in each iteration. What it raises ends the solve, and True.
    """

    def __init__(
        self, sizes: tuple[int, int, int], report: Callable[[Any, Any, Any], bool | None] | None
    ) -> None:
        ca.Callback.__init__(self)
        nx, ng, parameters = sizes
        self._sizes = {"x": nx, "f": 1, "g": ng, "lam_x": nx, "lam_g": ng, "lam_p": parameters}
        self._report = report
        self.error: BaseException | None = None
        self.construct("watch", {})

    def get_n_in(self) -> int:
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        return 1

    def get_name_in(self, i: int) -> str:
        return str(ca.nlpsol_out(i))

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self._sizes[ca.nlpsol_out(i)], 1)

    def eval(self, arguments: Any) -> list[int]:
        end = ask()
        if self._report is not None and not end:
            try:
                end = bool(self._report(*arguments[:3]))
            except BaseException as error:
                self.error = error
        return [int(end or self.error is not None)]


class Nlp(Native):
    """A solver of nonlinear programs; made by :func:`nlpsol`."""

    def __init__(self, function: ca.Function, watch: _Watch | None) -> None:
        super().__init__(function, held=watch is not None)
        self._watch = watch

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """CasADi's results. Ended by a signal, a time limit or the report it raises what that
        raised.
        """
        _require_bounds(kwargs)
        if self._watch is not None:
            self._watch.error = None
        found = super().__call__(*args, **kwargs)
        if self._watch is not None and self._watch.error is not None:
            raise self._watch.error
        return found

    def stats(self) -> dict[str, Any]:
        """CasADi's, but no iterations of a program that IPOPT refused (CasADi has any number)."""
        found: dict[str, Any] = self.function.stats()
        if self._watch is not None and not any((found.get("iterations") or {}).values()):
            found["iter_count"] = 0
        return found


def _require_bounds(given: Mapping[str, Any]) -> None:
    """InputError where a lower bound lies above its upper one, or is NaN."""
    for kind in "xg":
        low, high = (given.get(f"{end}b{kind}") for end in "lu")
        if low is None or high is None or isinstance(low, ca.SX | ca.MX):
            continue
        ends = (np.asarray(ca.DM(end), float).ravel() for end in (low, high))
        lower, upper = np.broadcast_arrays(*ends)
        wrong = ~((lower <= upper) & (lower < np.inf) & (upper > -np.inf))
        if wrong.any():
            raise InputError(
                f"bound {int(np.argmax(wrong))} of {kind}: the lower end must be a number, and not "
                "above the upper one"
            )


def nlpsol(
    name: str,
    plugin: str,
    problem: Any,
    options: Mapping[str, Any],
    *,
    sizes: tuple[int, int, int] | None = None,
    report: Callable[[Any, Any, Any], bool | None] | None = None,
) -> Nlp:
    """``casadi.nlpsol``, which prints nothing of programs with more equations than unknowns.

    sizes : numbers of unknowns, constraints and parameters, where ``problem`` does not show them.
    report : called with (x, f, g) at each iteration of IPOPT, which stops where it returns True.
    """
    one_thread()
    hold_memory()
    watch = None
    # CasADi's own look at the bounds also prints lines about equations in excess, one per call:
    # a conflict is told by whoever asked; what is ill-posed by _require_bounds
    options = {"inputs_check": False, **options}
    if plugin == "ipopt":
        shown = sizes or tuple(problem[k].numel() if k in problem else 0 for k in ("x", "g", "p"))
        watch = _Watch((shown[0], shown[1], shown[2]), report)
        # its own check prints that there are more equations than unknowns, which the status says
        options = {**options, "iteration_callback": watch, "inputs_check": False}
    return Nlp(native(ca.nlpsol, name, plugin, problem, options), watch)


# ---- functions on fixed memory -------------------------------------------------------------------
Array: TypeAlias = NDArray[np.float64]


class Buffered:
    """A function with dense arguments and results: a call copies its arguments and makes nothing. A
    plain call costs 30 times as much around it.

    ``results`` are matrices as views of the memory that the next call writes to. arguments : memory
    from which it reads, by default its own.
    """

    def __init__(self, function: ca.Function, arguments: Sequence[Array] = ()) -> None:
        self._buffer, self.call = function.buffer()
        """Evaluates at what stands in ``arguments``."""
        own = (np.zeros(function.nnz_in(i)) for i in range(function.n_in()))
        self.arguments = list(arguments or own)
        self._memory = [np.zeros(function.nnz_out(i)) for i in range(function.n_out())]
        for i, array in enumerate(self.arguments):
            self._buffer.set_arg(i, memoryview(array))  # type: ignore
        for i, array in enumerate(self._memory):
            self._buffer.set_res(i, memoryview(array))  # type: ignore
        self.results: list[Array] = [
            m.reshape(function.size2_out(i), function.size1_out(i)).T
            for i, m in enumerate(self._memory)
        ]

    def __call__(self, *arguments: Any) -> list[Array]:
        """The results for these arguments (vectors, or matrices column by column)."""
        for own, given in zip(self.arguments, arguments, strict=True):
            own[:] = given
        self.call()
        return self.results


# ---- one thread, and memory that stays -----------------------------------------------------------
# Dense blocks in solvers are small, so threads wait for each other: a plan of 20 states takes three
# times the processor time on two threads, and twice as long. And sums in another order have other
# last digits, so that a plan would depend on how many processors a machine has.
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
