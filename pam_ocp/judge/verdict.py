"""Verdict: whether a plan can be trusted, in one sentence with the figure that failed."""

from __future__ import annotations

from dataclasses import dataclass

from ..core.shown import shown

TOLERANCE = 1e-3
"""What a plan is judged by where nothing else is asked for, scaled by nominals."""


GROWTH = 1e3
"""Times by which errors grow along a motion that is called unstable."""


@shown
@dataclass(frozen=True)
class Verdict:
    """What the solver and an independent replay say of a plan, against one tolerance.

    ``print(verdict)`` is one sentence.

    Examples
    --------
    >>> plan.verdict.verified, plan.verdict.tolerance
    (True, 0.001)
    >>> print(str(plan.verdict).split(":")[0])
    verified
    """

    status: str
    """The solver's return status."""
    solved: bool
    """Whether the solver converged."""
    error: float
    """Largest deviation of the replay from the plan at its points, scaled by nominals."""
    state: str
    """The state that deviates most."""
    violation: float
    """Largest violation along the replay of bounds and path constraints (between the points too),
    of the stops' conditions, the closing of a cycle and budgets, scaled by nominals.
    """
    constraint: str
    """What is violated most ("" when nothing is)."""
    tolerance: float
    """Of the error and of the violation, scaled by nominals."""
    ended: str = ""
    """What broke off the search for a better plan: then none is verified."""
    local: float = float("nan")
    """What the replays of all intervals, each from its own planned start, deviate by in all, in
    units of nominal; known where the error exceeds the tolerance.
    """
    corrected: bool = False
    """Whether the equations of the mesh hold but for the defects that a tight integration leaves in
    them (iterated defect correction, where kinks are resolved slowly): then the motion is the
    plant's, on a mesh that would not resolve it, and is optimal as that mesh knows the plant.
    """
    begins: tuple[str, ...] = ()
    """What differs from rest at the start because the statement says so."""
    apart: float = 0.0
    """By how much an ordinary integration of the inputs parts from the tight one, scaled by
    nominals."""

    @property
    def verified(self) -> bool:
        """Whether the solver converged, and the replay agrees and keeps all limits, to the
        tolerance; and whether an ordinary integration confirms it.
        """
        # written so that a NaN fails
        kept = self.solved and not self.ended and not self._parts
        return kept and self.error <= self.tolerance and self.violation <= self.tolerance

    @property
    def _parts(self) -> bool:
        """Whether errors of an integrator grow beyond what plans are judged by."""
        return self.apart > max(self.tolerance, TOLERANCE)

    @property
    def growth(self) -> float:
        """How many times larger the error is than the deviations of the intervals that it grew
        from; large for an unstable motion.
        """
        return self.error / self.local if self.local > 0 else float("nan")

    @property
    def unstable(self) -> bool:
        """Whether the plan agrees interval by interval, and fails only as small errors grow."""
        return self.solved and self.local <= self.tolerance and self.growth > GROWTH

    def __bool__(self) -> bool:
        return self.verified

    def __str__(self) -> str:
        if not self.solved:
            return f"not verified: the solver did not converge ({self.status})"
        within = f"{self.tolerance:.0e}".replace("e-0", "e-")
        failed = []
        if not self.error <= self.tolerance:
            failed.append(
                f"its replay deviates by {self.error:.2g} (scaled by nominal values) in "
                f"{self.state}"
            )
        if not self.violation <= self.tolerance:
            failed.append(
                f"its replay violates {self.constraint} by {self.violation:.2g} "
                "(scaled by nominal values)"
            )
        if self._parts and not self.unstable:
            failed.append(
                f"an ordinary integration parts from its replay by {self.apart:.2g}: the motion is "
                "unstable, so run it with feedback (control.tvlqr)"
            )
            return f"not verified: {' and '.join(failed)}"
        if self.ended:
            failed.insert(0, f"{self.ended} before the search was done")
            return f"not verified: {' and '.join(failed)}"
        if failed:
            return f"not verified: {' and '.join(failed)}, more than {within}{self._growing()}"
        more = "; the mesh's defects were corrected" if self.corrected else ""
        if self.begins:
            more += f"; it does not begin at rest, as was said ({', '.join(self.begins)})"
        return (
            f"verified: its replay agrees to {self.error:.1e} (scaled by nominal values) and keeps "
            "all limits to "
            f"{self.violation:.1e}, within {within}{more}"
        )

    def _growing(self) -> str:
        if not self.unstable:
            return ""
        return (
            f"; the motion is unstable: its intervals agree to {self.local:.1e}, but errors grow "
            f"{self.growth:.0e} times along it, so run it with feedback (control.tvlqr)"
        )
