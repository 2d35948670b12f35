"""All numbers of the planner's method, each with where it comes from."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["SETTINGS", "Settings"]


@dataclass(frozen=True)
class Settings:
    """Numbers of the search for a plan. Limits count work, never seconds: what is found does not
    depend on the machine.

    "Measured" means: on the reference tasks of ``benchmarks/verdict_study.py``, see
    docs/validation.md.
    """

    aim: float = 0.8
    """Part of the plan's tolerance that refinement aims at: who looks at other times finds it kept,
    too."""
    resolved: float = 0.1
    """Sum of the intervals' errors [nominal] up to which a mesh resolves a motion at large; beyond,
    the solver makes use of the errors. Asked for on the way, before costs or limits are looked at.
    """
    step: float = 0.15
    """Part of the smoothing path that is gone at once, at most: longer steps lead to other, worse
    optima (measured)."""
    grow: float = 1.4
    """Of the step after a success (E. L. Allgower, K. Georg, Introduction to Numerical Continuation
    Methods, SIAM 2003, ch. 6)."""
    shrink: float = 0.4
    """Of the step after a failure (the same)."""
    least_step: float = 0.01
    """Of the path, before it counts as blocked."""
    reentry: float = 0.6
    """Place of the path from which a finer mesh is approached where it is not solved at once."""
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
    marked: float = 0.7
    """Part of the estimated gain whose intervals are split (bulk marking: W. Dörfler, SIAM J.
    Numer. Anal. 33 (1996) 1106-1124)."""
    finest: int = 400
    """Intervals of a leg, on average, beyond which no objective is refined."""
    more_intervals: int = 300
    """That one round may add."""
    several: int = 4
    """Starts where local optima are many (measured, docs/validation.md "Local optima")."""
    brought: int = 3
    """Candidates of different starts that are led to the end, at most."""
    tie: float = 1e-4
    """Relative difference of two objectives up to which they count as one optimum."""
    near_best: float = 0.02
    """Part of the objective that a further start may lie above the best on the first mesh, to be
    led to the end as well."""
    work: float = 4e6
    """Iterations times unknowns for one candidate: half a minute or so (measured: 5e-6 to 2e-5 s
    each)."""
    damping: float = 1e-4
    """Added to the Hessian's diagonal from solutions that are near: steps along which costs are
    flat become short (K. Levenberg, Quart. Appl. Math. 2 (1944) 164-168)."""
    settling: float = 1e-2
    """The same where a solve wandered along an optimum that is no one place."""


SETTINGS = Settings()
