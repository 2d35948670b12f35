"""All numbers of the planner's method, each with where it comes from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf


@dataclass(frozen=True)
class Settings:
    """Numbers of the search for a plan. Limits count work, never seconds: what is found does not
    depend on the machine.

    "Measured" means: on random tasks (``benchmarks/random_tasks.py``), see docs/validation.md.
    """

    aim: float = 0.8
    """Part of the plan's tolerance that refinement aims at, so that whoever looks at other times
    finds it kept, too."""
    exact: float = 1e-9
    """Tolerance [nominal] below which no mesh is refined: the replay's own integration is not more
    exact (measured: there errors no longer fall from mesh to mesh)."""
    resolved: float = 0.1
    """Sum of the intervals' errors [nominal] up to which a mesh resolves a motion at large; beyond,
    the solver exploits the errors. Up to it defects are corrected without a finer mesh (R. Frank,
    C. W. Ueberhuber, BIT 17 (1977) 146-159)."""
    step: float = 0.15
    """Part of the smoothing path of one step, at most: longer ones lead to worse optima (measured).
    """
    grow: float = 1.4
    """Of the step after a success (E. L. Allgower, K. Georg, Introduction to Numerical Continuation
    Methods, SIAM 2003, ch. 6)."""
    shrink: float = 0.4
    """Of the step after a failure (the same)."""
    least_step: float = 0.01
    """Of the path, before it counts as blocked."""
    reentry: float = 0.6
    """Place of the path from which a plan that is given is led on where it is not solved at once,
    and from which shooting is tried where the next place is not."""
    coarsest: int = 10
    """Intervals of a leg that the mesh sequence begins with where work, air or exergy counts: from
    a rough guess fine meshes take hundreds of iterations or fail there (measured)."""
    few: int = 50
    """The same for other objectives on meshes of at least ``many`` intervals (measured: 800
    intervals take 176 iterations at once, 56 from the solution on 50)."""
    many: int = 150
    """See ``few``."""
    rounds: int = 12
    """Of refinement of one candidate with the plant's own equations, at most."""
    polynomial_rounds: int = 5
    """The same before polynomial inputs are held instead: refinement may chase their switches."""
    corrections: int = 4
    """Of the defects of one mesh, at most; each has to halve the error."""
    marked: float = 0.7
    """Part of the estimated gain whose intervals are split (bulk marking: W. Dörfler, SIAM J.
    Numer. Anal. 33 (1996) 1106-1124)."""
    finest: int = 400
    """Intervals of a leg, on average, beyond which no objective is refined."""
    points: int = 1000
    """Of a mesh, up to which one that is more than twice as fine is solved at once: what is far
    finer has other optima."""
    several: int = 4
    """Starts where local optima are many (measured, docs/validation.md "Local optima")."""
    candidates: int = 3
    """Of different starts that are led to the end, at most, until one is verified."""
    tie: float = 1e-4
    """Relative difference of two objectives up to which they count as one optimum."""
    dearer: float = 1e-2
    """Part of the objective by which a finer mesh may cost more where its least was not found: what
    a solver had is kept, and the next mesh not tried."""
    work: float = 40.0
    """Processor seconds of a common machine (``iteration_cost``) for one candidate before, on and
    behind its path each, and of a search that has found a plan."""
    all_work: float = 120.0
    """The same of a whole search: then costs are left as they are, and what is missed of the
    tolerance is all that goes on to fall. A ``time_limit`` takes its place, and that of the next.
    """
    most_work: float = 160.0
    """At which a search ends in any case: with building, replays and verdict three to five minutes
    (measured: with half of it random tasks with many states are lost)."""


SETTINGS = Settings()
UNBOUNDED = replace(SETTINGS, all_work=inf, most_work=inf)
"""Of a search that a time limit ends."""
