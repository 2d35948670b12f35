"""What every solver is to a plan, and the first of them: IPOPT, with cold and warm starts from one
set of derivatives, log, live progress. Before a warm start Newton's method is tried.
"""

from __future__ import annotations

import contextlib
import logging
import re
import time
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.errors import ExportError, InputError, require_flag
from ...core.quantities import outside
from ...core.registry import Registry
from ...numerics.solvers import Nlp, nlpsol, quiet_ipopt
from ..stages import require_work, written
from ..transcription.derivatives import derivatives, iteration_cost
from ..transcription.transcription import Program
from .ipopt import BARRIER_OF_TIME, DAMPED, DEFAULTS, STARTS, WANDERING, Start

if TYPE_CHECKING:  # loaded with the first re-solve
    from .newton import Newton, Optimality

LOG = logging.getLogger(__name__)

Array: TypeAlias = NDArray[np.float64]
Progress: TypeAlias = "Callable[[int, float, float], None] | bool"

FAR, NEAR_BY = (24.0, 250, 800), (8.0, 30)
"""Work of one solve, iterations at least and at most: from far away (hundreds are worth it there),
and where a motion is there already whose costs are all that is left to gain.
"""
LIMIT = 60.0, 2e-2
"""Processor seconds of one solve, at least and for each unknown, which none needs: where the linear
algebra gets stuck in fill-in another start is the better use of time. What is found depends on
iterations.
"""


def most_iterations(cost: float, start: Start) -> int:
    """Of one solve: hundreds are worth it where they cost little."""
    own = STARTS[start].get("max_iter")
    work, least, most = FAR if own is None else (NEAR_BY[0], min(NEAR_BY[1], own), own)
    return int(np.clip(work / cost, least, most))


def limit(program: Program) -> float:
    """Processor seconds of one solve, at most."""
    return max(LIMIT[0], LIMIT[1] * program.nlp["x"].numel())


STOPPED = ("User_Requested_Stop", "NonIpopt_Exception_Thrown")
"""IPOPT's return status when somebody stopped it."""
ACCEPTABLE, SETTLED = "Solved_To_Acceptable_Level", "Settled"
LIMITS = "max_iter", "max_cpu_time", "max_wall_time"
"""Options whose values, where a user gives them, end all work on a solve."""
SLOW = "Slow_Progress"
ENDED_LATE = ("Maximum_Iterations_Exceeded", "Maximum_CpuTime_Exceeded", SLOW)
ENDED_BLOCKED = (
    "Infeasible_Problem_Detected",
    "Restoration_Failed",
    "Error_In_Step_Computation",
    "Search_Direction_Becomes_Too_Small",
)
"""Return status where long steps found no way back to the constraints; short ones may, from a
violation of ``LITTLE`` at most.
"""
LITTLE = 1e-3
PROGRESS = 30, 1e-4
"""So many iterations beside the constraints in which costs fall by less than this part end a solve
where no finer mesh is to lower them: on flat costs hundreds more gain next to nothing.
"""
LEAST_COST = 1e-5
"""Residual of stationarity up to which costs count as the least."""
SLOWLY = "the search ended where costs fell slowly and may not be at their least (slope {:.0e})"
STUCK = "the solver stopped beside the constraints ({}); costs may not be at their least"
PROJECTIONS: tuple[Start, ...] = ("feasible", "nearest")
"""Starts that look for a motion next to the guess, whatever it costs."""
ENDED_SLOW: tuple[Start, ...] = ("cold", "near", "last", "finer", "damped")
SETTLING: tuple[Start, ...] = ("damped", *PROJECTIONS)
"""Starts of what brings an outcome to a place, or on its way there."""
EXACT = 1e-7
"""Residual of the constraints from which on what has settled is not led on for more."""
CLOSE = 1e-2, 3.0
"""Residuals of stationarity and constraints from which damped steps end a solve in 20 iterations or
so that went to and fro for hundreds.
"""
NEARLY = 1e-2, 1e-2
"""The same from which a motion is brought back to its constraints as it is: where costs are flat,
hundreds of damped iterations more gain next to nothing.
"""


@dataclass(frozen=True)
class Outcome:
    """What a solver made of a program."""

    w: Array
    objective: float
    status: str
    success: bool
    iterations: int
    seconds: float
    lam_g: Array
    lam_x: Array
    log: tuple[dict[str, float], ...] = field(default=())
    """One entry per iteration: objective, infeasibilities, barrier, step lengths."""
    solver: str = "IPOPT"
    warning: str = ""
    """What did not go as asked."""
    advice: str = ""
    """Of a failure: what in the statement or the mesh may be its cause, and the remedy."""

    @classmethod
    def of(cls, arrays: Mapping[str, Array], stats: Mapping[str, Any], seconds: float) -> Outcome:
        """From what CasADi's interface to IPOPT gives."""
        log = _log(stats.get("iterations") or {})
        return cls(
            arrays["x"],
            float(arrays["f"][0]),
            str(stats["return_status"]),
            bool(stats["success"]),
            int(stats["iter_count"]) if log else 0,  # of what IPOPT refuses it is any number
            seconds,
            arrays["lam_g"],
            arrays["lam_x"],
            log,
        )

    @property
    def wandered(self) -> bool:
        """Whether it ended at an optimum that is no one place; see ``WANDERING``."""
        slope, violation = (WANDERING[f"acceptable_{n}_tol"] for n in ("dual_inf", "constr_viol"))
        late, blocked = self.within(slope, violation), self.within(slope, LITTLE, ENDED_BLOCKED)
        return self.status == ACCEPTABLE or late or blocked

    def led_on(self, damped: bool) -> tuple[Start, ...]:
        """The starts that bring it to a place; none where it is at one, or at nothing.

        damped : whether its steps were.
        """
        if self.wandered:
            return ("feasible",) if damped and self.success else ("damped", "feasible")
        slow = self.status == SLOW  # beside the constraints, whatever the slope
        if damped:
            return ("feasible",) if slow or self.within(*NEARLY) else ()
        return ("last", "feasible") if slow or self.within(*CLOSE) else ()

    def within(
        self, stationarity: float, violation: float, ended: tuple[str, ...] = ENDED_LATE
    ) -> bool:
        """Whether it ended, for want of time or as ``ended`` says, with residuals of that size, at
        most.
        """
        if self.status not in ended or not self.log:
            return False
        last = self.log[-1]
        return last["inf_du"] <= stationarity and last["inf_pr"] <= violation

    @property
    def beside(self) -> bool:
        """Whether it failed beside the constraints, with nothing but costs left to gain."""
        return not self.success and self.within(np.inf, LITTLE, (*ENDED_LATE, *ENDED_BLOCKED))

    @property
    def stopped(self) -> bool:
        """Whether the solver was stopped, rather than failed."""
        return self.status in STOPPED

    @property
    def ended(self) -> bool:
        """Whether nothing else should be tried."""
        return self.success or self.stopped


class Solver(Protocol):
    """What solves a program, and others of the same expressions with other numbers."""

    def __call__(
        self, program: Program, guess: Array, start: Start = "cold", warm: Outcome | None = None
    ) -> Outcome:
        """The outcome from a guess of the program's unknowns (scaled, as ``program.nlp["x"]``).

        A solver minimises ``program.nlp["f"]`` under ``program.bounds()`` of x and
        ``program.limits()`` of g, with ``program.parameters()`` for p. An outcome that is a success
        keeps them; its multipliers have CasADi's signs (zeros where a solver has none).

        start : where the guess comes from; see ``STARTS``. A solver may take each of them as
            "corrector", "last" and "damped".

        A solver never raises because it found nothing: it says so in the outcome. InputError is for
        options that it does not know.
        """


SOLVERS: Registry[Callable[..., Solver]] = Registry("solver", __package__)
"""What makes a solver: (program, options, progress) -> Solver; ``compiled`` where it knows that.

options : the user's (None for none). progress : True prints, a function is called.
"""


def _printed(iteration: int, objective: float, violation: float) -> None:
    print(f"{iteration:5d}  objective {objective:14.8g}  largest violation {violation:9.2e}")


@SOLVERS.register("ipopt")
class Ipopt:
    """IPOPT for a program, built once, for any number of solves.

    compiled : the program's functions as machine code; see below.
    """

    def __init__(
        self,
        program: Program,
        options: Mapping[str, Any] | None = None,
        progress: Progress = False,
        compiled: bool = False,
    ) -> None:
        self.program = program
        self.report = progress if callable(progress) else _printed if progress else None
        self._iteration, self._limits = 0, program.limits()
        self._costs: list[float] = []
        self._slow = self._ends_slow = False
        self._given = dict(options or {})
        self._derivatives = derivatives(program)
        self.cost = iteration_cost(program)
        self._library: str | None = None
        self._solvers: dict[str, Nlp] = {}
        self._newton: Newton | Literal["unknown"] | None = "unknown"
        if compiled:
            self._library = _library_of(self._solver("cold").function)
            self._solvers.clear()
        self._first = self._solver("cold")

    @property
    def _acceptance_given(self) -> bool:
        """Whether the user says what is acceptable: then it is."""
        return any(n.startswith("acceptable") for n in self._given)

    def _options(self, name: Start) -> dict[str, Any]:
        """Of the solver of this name, but for its functions."""
        time, own = limit(self.program), dict(STARTS[name])
        if name in DAMPED or "max_iter" not in own:
            own["max_iter"] = most_iterations(self.cost, name)
        if self._acceptance_given:
            own = {n: v for n, v in own.items() if not n.startswith("acceptable")}
        chosen = {**DEFAULTS, **own, "max_cpu_time": time}
        chosen |= self._given
        goal = self.program.problem.objective
        if name == "cold" and goal.only_time and "mu_init" not in self._given:
            chosen["mu_init"] = BARRIER_OF_TIME * goal.time
        return quiet_ipopt(**chosen)  # without multipliers of the parameters: duals.py finds them

    def _solver(self, name: Start) -> Nlp:
        """The solver of this name, made at its first use; all share the same functions."""
        if name not in self._solvers:
            options = self._options(name)
            if self._library is None:
                options |= self._derivatives
            if name in DAMPED and "hess_lag" in options:
                options["hess_lag"] = _damped(options["hess_lag"], DAMPED[name])
            nlp, problem = self.program.nlp, self._library or self.program.nlp
            if name in PROJECTIONS:  # the length of a step in place of costs
                problem = {**nlp, "f": ca.MX(0)}
                options.pop("grad_f", None)
                options["jac_g"] = self._derivatives["jac_g"]
                options["hess_lag"] = _unity(self._derivatives["hess_lag"])
            sizes = (nlp["x"].numel(), nlp["g"].numel(), nlp["p"].numel())
            try:
                solver = nlpsol(name, "ipopt", problem, options, sizes=sizes, report=self._progress)
            except RuntimeError as error:
                said = re.sub(r"^\S+\.[ch]pp:\d+: ", "", str(error).splitlines()[-1])
                raise InputError(
                    f"options = {self._given}: {said}; see IPOPT's list of options"
                ) from None
            if not self._derivatives:  # CasADi's own, taken over from the first
                functions = {"hess_lag": "nlp_hess_l", "jac_g": "nlp_jac_g", "grad_f": "nlp_grad_f"}
                self._derivatives = {o: solver.get_function(f) for o, f in functions.items()}
            self._solvers[name] = solver
        return self._solvers[name]

    def _progress(self, x: ca.DM, f: ca.DM, g: ca.DM) -> bool:
        """Count an iteration; report its number, objective and largest violation. Whether to stop
        for want of progress.
        """
        require_work(self._iteration * self.cost)
        values, (low, high) = np.asarray(g, float).ravel(), self._limits
        worst = max(np.max(low - values, initial=0.0), np.max(values - high, initial=0.0))
        if self.report is not None:
            self.report(self._iteration, float(f), float(worst))
        self._iteration += 1
        count, part = PROGRESS
        self._costs.append(float(f) if worst <= LITTLE else np.inf)
        before, now = self._costs[:-count], self._costs[-count:]
        self._slow = (
            self._ends_slow
            and bool(before)
            and max(now) < np.inf
            and min(before) - min(now) < part * abs(now[-1])
        )
        return self._slow

    def __call__(
        self, program: Program, guess: Array, start: Start = "cold", warm: Outcome | None = None
    ) -> Outcome:
        """Solve for the program's values (same expressions as the one built).

        start : of ``STARTS``. warm : an outcome whose multipliers start the solve, too.
        """
        begin, processor = time.perf_counter(), time.process_time()
        given = self.arguments(program, guess)
        if start == "warm" and warm is not None:
            found = self._by_newton(given, warm, begin)
            if found is not None:
                written(program, start, found, time.process_time() - processor, self.cost)
                return found
        solver = self._solver(start)
        if warm is not None and start not in PROJECTIONS:
            given |= {"lam_x0": warm.lam_x, "lam_g0": warm.lam_g}
        self._iteration, self._limits, self._costs = 0, (given["lbg"], given["ubg"]), []
        to_the_end = self._acceptance_given or self.program.problem.objective.economical
        self._ends_slow = start in ENDED_SLOW and not to_the_end
        result = solver(**given)
        arrays = {k: np.asarray(result[k], float).ravel() for k in ("x", "f", "lam_g", "lam_x")}
        outcome = Outcome.of(arrays, solver.stats(), time.perf_counter() - begin)
        if self._slow and outcome.stopped:
            outcome = replace(outcome, status=SLOW)
        if start in PROJECTIONS:
            outcome = self._beside(outcome, given["p"], warm)
        written(program, start, outcome, time.process_time() - processor, self.cost)
        return outcome if start in SETTLING else self.settled(program, outcome, start)

    def _beside(self, found: Outcome, p: Array, warm: Outcome | None) -> Outcome:
        """What was brought back to the constraints, with its costs, and the multipliers of where
        it was (zeros where none are known).
        """
        value = float(self._first.get_function("nlp_f")(found.w, p))
        given = (0.0 * found.lam_g, 0.0 * found.lam_x) if warm is None else (warm.lam_g, warm.lam_x)
        status = SETTLED if found.success else found.status
        return replace(found, objective=value, status=status, lam_g=given[0], lam_x=given[1])

    def settled(self, program: Program, outcome: Outcome, start: Start = "cold") -> Outcome:
        """The outcome, brought to a place where it wandered; a failure where that fails."""
        out_of_limit = outcome.status in ENDED_LATE and any(n in self._given for n in LIMITS)
        starts = outcome.led_on(start in DAMPED)
        if self._acceptance_given or out_of_limit or not starts:
            return outcome
        found, solves, slope = outcome, [outcome], outcome.log[-1]["inf_du"]
        for following in starts:
            found = self(program, found.w, following, found)
            solves.append(found)
            slope = slope if following == "feasible" else found.log[-1]["inf_du"]
            exact = found.success and found.log[-1]["inf_pr"] <= EXACT
            if exact or not (found.success or found.within(*NEARLY)):
                break
        spent: dict[str, Any] = {
            "iterations": sum(each.iterations for each in solves),
            "seconds": sum(each.seconds for each in solves),
            "log": tuple(line for each in solves for line in each.log),
        }
        if found.success:
            said = SLOWLY.format(slope) if slope > LEAST_COST else found.warning
            return replace(found, status=SETTLED, warning=said, **spent)
        if found.stopped:
            return replace(found, **spent)
        status = outcome.status if outcome.status != ACCEPTABLE else ENDED_LATE[0]
        return replace(outcome, success=False, status=status, **spent)

    def _by_newton(self, given: Mapping[str, Array], warm: Outcome, begin: float) -> Outcome | None:
        """By Newton's method from a neighbour's optimum; None where IPOPT has to solve it.

        What it finds is judged by the program's own derivatives, to IPOPT's tolerances. Options are
        IPOPT's, and machine code is its: with these it solves all.
        """
        if self._given or self._library is not None or not warm.success:
            return None
        from .newton import Newton, Point

        if self._newton == "unknown":
            self._newton = Newton.made(self.program)
        if self._newton is None:
            return None
        found = self._newton(given, Point(given["x0"], warm.lam_g, warm.lam_x))
        if found is None:
            LOG.info("Newton's method gave up; IPOPT goes on from the neighbour")
            return None
        misses = self._optimality(given, found.w, found.lam_g, found.lam_x)
        keys = ("tol", "constr_viol_tol", "compl_inf_tol")
        if not all(m <= DEFAULTS[k] for m, k in zip(misses, keys, strict=True)):
            return None
        steps, seconds = len(found.log) - 1, time.perf_counter() - begin
        LOG.info("Newton's method: %d steps, %.3f s", steps, seconds)
        for i, entry in enumerate(found.log):
            if self.report is not None:
                self.report(i, entry["obj"], entry["inf_pr"])
        return Outcome(
            found.w,
            found.log[-1]["obj"],
            "Newton's method: solved",
            True,
            steps,
            seconds,
            found.lam_g,
            found.lam_x,
            found.log,
            solver="Newton",
        )

    @cached_property
    def _optimality(self) -> Optimality:
        from .newton import Optimality

        return Optimality(*(self._first.get_function(n) for n in ("nlp_grad_f", "nlp_jac_g")))

    def arguments(self, program: Program, guess: Array) -> dict[str, Array]:
        """Of a solve without multipliers."""
        (lbx, ubx), (lbg, ubg) = program.bounds(), program.limits()
        bounds = {"lbx": lbx, "ubx": ubx, "lbg": lbg, "ubg": ubg}
        return {
            "x0": np.clip(program.completed(guess), lbx, ubx),
            "p": program.parameters(),
            **bounds,
        }

    def portable(self, starts: Iterable[Start]) -> tuple[ca.Function, dict[str, dict[str, Any]]]:
        """(the problem, options by start) for another process; all of it can be pickled."""
        nlp = self.program.nlp
        problem = ca.Function("problem", [nlp["x"], nlp["p"]], [nlp["f"], nlp["g"]])
        return problem, {name: {**self._options(name), **self._derivatives} for name in starts}


def _damped(hessian: ca.Function, value: float) -> ca.Function:
    """The Hessian of a Lagrangian with a value added to its diagonal."""
    names = hessian.name_in()
    given = [ca.MX.sym(n, hessian.sparsity_in(i)) for i, n in enumerate(names)]
    exact = hessian(*given)
    found = exact + value * ca.MX.eye(exact.size1())
    return ca.Function(hessian.name(), given, [found], names, hessian.name_out())


def _unity(hessian: ca.Function) -> ca.Function:
    """In place of a Lagrangian's Hessian: that of half the square of a step."""
    names = hessian.name_in()
    given = [ca.MX.sym(n, hessian.sparsity_in(i)) for i, n in enumerate(names)]
    unity = ca.DM.eye(hessian.size1_out(0))
    return ca.Function(hessian.name(), given, [unity], names, hessian.name_out())


def _log(iterations: Mapping[str, Any]) -> tuple[dict[str, float], ...]:
    """One mapping per iteration, from lists by name."""
    keys = [k for k, v in iterations.items() if isinstance(v, list)]
    return tuple(
        dict(zip(keys, map(float, row), strict=True))
        for row in zip(*(iterations[k] for k in keys), strict=True)
    )


# ---- a program's functions as machine code -------------------------------------------------------
# C by CasADi, compiled by cc or zig, kept by content. It pays where the functions cost more than
# the linear algebra: on re-solves by shooting, 0.3 to 0.4 of the time; for collocation 0.7 to 0.9.
# The compiler takes a few seconds, once. (``benchmarks/resolve.py``.)
NAME = "pam_ocp_plan"
HEAD = """\
#ifdef __GNUC__
#define CASADI_SYMBOL_EXPORT __attribute__((visibility("default")))
#pragma GCC diagnostic ignored "-Wint-conversion"
#endif
"""
"""The compiler is told to hide what is not declared otherwise; and where a mapped function has an
argument without entries, CasADi copies nothing to an address written as a number."""


def _library_of(solver: ca.Function) -> str:
    """The path of a library with a solver's problem and derivatives, for ``casadi.nlpsol(name,
    "ipopt", path)``.

    Raises InputError where there is no C compiler.
    """
    from ...export.cache import digest, usable_folder
    from ...export.compile import compile_library, native

    generator = ca.CodeGenerator(f"{NAME}.c")
    generator.add(solver.oracle())
    for name in solver.get_function():
        generator.add(solver.get_function(name))
    source = f"{NAME}.c"
    try:
        platform = native()
        library = compile_library({source: HEAD + generator.dump()}, source, platform, NAME)
    except ExportError as error:
        raise InputError(f"compiled = True: {error}; or leave compiled out") from None
    path = usable_folder("plan") / f"{digest(library)}{platform.suffix}"
    return str(_stored(path, library))


def _stored(path: Path, library: bytes) -> Path:
    """The library as a whole file in the cache."""
    from ...export.cache import write_whole

    with contextlib.suppress(OSError):  # not there yet
        if path.read_bytes() == library:
            return path
    try:
        write_whole(path, library)
    except OSError as error:
        raise InputError(f"compiled = True: {path} cannot be written ({error.strerror})") from None
    return path


# ---- the choice of a solver by its name ----------------------------------------------------------
SolverName: TypeAlias = 'Literal["ipopt"] | str'
"""Of those in ``SOLVERS``; this one comes with the library."""

KEPT = 8
"""Solvers that are kept at a time."""


@dataclass(frozen=True)
class Backend:
    """Which solver, and how; :meth:`build` makes it for a program."""

    name: SolverName = "ipopt"
    compiled: bool = False
    options: Mapping[str, Any] | None = None
    progress: Progress = False
    keeps: bool = False
    """Whether the solvers built last are kept: neighbours are solved on one finer mesh many times.
    """
    kept: dict[int, tuple[Program, Solver]] = field(default_factory=dict, repr=False, compare=False)
    """These with their programs, by the identity of the expressions."""

    def __post_init__(self) -> None:
        if self.name == "fatrop" and self.name not in SOLVERS:
            warnings.warn(
                "solver = 'fatrop' is solver = 'ipopt' since version 0.3, which is as quick from "
                "another solution and several times quicker from a guess; its options are not used",
                DeprecationWarning,
                stacklevel=outside(),
            )
            object.__setattr__(self, "name", "ipopt")
            object.__setattr__(self, "options", None)
        if self.name not in SOLVERS:
            raise InputError(f"solver = {self.name!r}: choose one of {', '.join(SOLVERS)}")
        require_flag("compiled", self.compiled)
        if self.compiled and "compiled" not in SOLVERS.arguments(self.name):
            able = [repr(n) for n in SOLVERS if "compiled" in SOLVERS.arguments(n)]
            raise InputError(
                f"compiled = True goes with solver = {' or '.join(able)}, not {self.name!r}"
            )

    @property
    def ipopt_options(self) -> Mapping[str, Any] | None:
        """The user's options where they are IPOPT's."""
        return self.options if self.name == "ipopt" else None

    def near(self) -> Backend:
        """What solves a finer mesh: IPOPT, not compiled; not every solver can start near."""
        near = replace(self, name="ipopt", compiled=False, options=self.ipopt_options)
        return replace(near, keeps=True)

    def build(self, program: Program) -> Solver:
        """A solver for this program, and for others of the same expressions."""
        key = id(program.nlp)
        if self.keeps and key in self.kept:
            return self.kept[key][1]
        compiled = {"compiled": True} if self.compiled else {}
        solver = SOLVERS[self.name](program, self.options, self.progress, **compiled)
        if self.keeps:
            while len(self.kept) >= KEPT:
                del self.kept[next(iter(self.kept))]
            self.kept[key] = program, solver
        return solver

    @property
    def programs(self) -> tuple[Program, ...]:
        """Those whose solvers are kept."""
        return tuple(program for program, _ in self.kept.values())
