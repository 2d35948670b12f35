"""CasADi's solvers and integrators as this library calls them: signals and time limits end them.

Nothing else makes one by CasADi's own names, so no place can forget; tests/package has a check.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import casadi as ca
import numpy as np

from ..core.errors import InputError
from ..core.stop import ask, native
from .blas import hold_memory, one_thread


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

    report : called with (x, f, g) in each iteration. What it raises ends the solve.
    """

    def __init__(
        self, sizes: tuple[int, int, int], report: Callable[[Any, Any, Any], None] | None
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
                self._report(*arguments[:3])
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
    report: Callable[[Any, Any, Any], None] | None = None,
) -> Nlp:
    """``casadi.nlpsol``, which prints nothing of programs with more equations than unknowns.

    sizes : numbers of unknowns, constraints and parameters, where ``problem`` does not show them.
    report : called with (x, f, g) at each iteration of IPOPT.
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
