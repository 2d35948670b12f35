"""What can go wrong, as exception classes of our own. All others import them from errors.py.

They stand apart from it because units and quantities, which it reads texts with, raise them, too.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from typing import Any

_LONG_TEXT = re.compile(r"(?<!\w)('[^'\n]{60})[^'\n]{140,}'(?!\w)")
"""A value between quotes that is too long for a sentence."""


class PamError(Exception):
    """Base of every error that pam_ocp raises on purpose.

    Examples
    --------
    >>> try:
    ...     pam.HangingLoad(muscle, mass=-1.0)
    ... except pam.PamError as error:
    ...     print(type(error).__name__)
    ...
    InputError
    """

    def __init__(self, *said: object) -> None:
        super().__init__(*(_LONG_TEXT.sub(r"\1...'", s) if isinstance(s, str) else s for s in said))


class InputError(PamError, ValueError):
    """An argument has a value that it must not have.

    Examples
    --------
    >>> pam.HangingLoad(muscle, mass=-1.0)
    Traceback (most recent call last):
    pam_ocp.core.exceptions.InputError: mass = -1 kg must be > 0
    """


class WriteError(InputError, OSError):
    """A file cannot be written where it was asked for; what stood there before still does.

    ``errno`` is the system's number, where the system refused.
    """

    def __new__(cls, *said: Any) -> WriteError:
        """Of its two bases, the one whose objects can be made so: what rebuilds errors in another
        process (tblib, for distributed) calls this without __init__.
        """
        error = OSError.__new__(cls)
        error.args = said
        return error

    def __init__(self, message: str, errno: int | None = None) -> None:
        super().__init__(message)
        self.errno = errno

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (*self.args, self.errno)


_WORDS = {
    "work": "energy mechanical_energy",
    "effort": "exertion control_effort",
    "time": "duration fastest quickest minimum_time min_time",
    "air": "consumption air_consumption gas air_mass",
    "rate": "jerk smoothness smooth slew slew_rate",
    "minimise": "objective cost goal criterion",
    "stops": "waypoints targets points path positions",
    "bounds": "limits box constraints_on",
    "cyclic": "periodic repeat closed",
    "x": "position displacement pos stroke travel",
    "q": "angle theta phi position",
    "v": "velocity speed",
    "mass": "weight load payload m",
    "feed": "valve regulator supply pressure_source",
    "losses": "friction hysteresis creep",
    "sample_time": "dt ts step sampling period",
    "duration": "t_end tend tf",
    "muscle.pressure muscle1.pressure": "p p1 pressure pressure1",
    "muscle2.pressure": "p2 pressure2",
    "muscle.command muscle1.command": "u u1 p p1 pressure command",
    "muscle2.command": "u2 p2 command2",
    "muscle.force muscle1.force": "f f1 force tension",
    "lb": "pound pounds lbs",
    "in": "inch inches",
    "N": "newton newtons",
    "Pa": "pascal pascals",
    "deg": "degree degrees",
    "mm": "millimeter millimetre millimeters millimetres",
    "m": "meter metre meters metres",
    "s": "second seconds sec",
    "%": "percent",
}
"""Words of the field for names that are spelled quite otherwise."""


MOST_LETTERS = 100
"""Of a name that are compared with known ones."""
NEARLY = 0.85
"""Likeness of a name to what was written, as part of that of the likest one, to be named, too."""
_LONG = 4
"""Letters of a word that is looked for as the beginning or the end of a name."""


def nearest(name: object, known: Iterable[str], cutoff: float = 0.4) -> list[str]:
    """The known names that were probably meant, three at most: in other letters, by the field's
    words, as a part of the name, else by their spelling.
    """
    known, word = [str(n) for n in known], str(name)[:MOST_LETTERS].lower()
    same = [n for n in known if n.lower() == word]
    meant = [n for names, words in _WORDS.items() if word in words.split() for n in names.split()]
    found = same or [n for n in dict.fromkeys(meant) if n in known]
    if not found and len(word) >= _LONG:
        found = [n for n in known if n.lower().startswith(word)]
        found = found or [n for n in known if n.lower().endswith(word)]
    spelled = str(name)[:MOST_LETTERS]
    if found:
        return found[:3]
    close = difflib.get_close_matches(spelled, known, n=3, cutoff=cutoff)
    likeness = {n: difflib.SequenceMatcher(None, n, spelled).ratio() for n in close}
    return [n for n in close if likeness[n] > NEARLY * likeness[close[0]]]


def _copied(kind: type[Exception], said: tuple[Any, ...], state: dict[str, Any]) -> Exception:
    """An error of a class whose arguments are not its message."""
    error = kind.__new__(kind, *said)
    error.__dict__.update(state)
    return error


class UnknownNameError(InputError):
    """A name that is not known here; the message lists the nearest ones.

    Examples
    --------
    >>> pam.muscle("DMSP-20-3O0")
    Traceback (most recent call last):
    pam_ocp.core.exceptions.UnknownNameError: unknown muscle 'DMSP-20-3O0': did you ...
    """

    def __init__(self, kind: str, name: object, known: Iterable[str]) -> None:
        known = list(known)
        near = nearest(name, known)
        if near:
            hint = f"did you mean {' or '.join(repr(n) for n in near)}?"
        else:
            some = known[:30]
            more = f", ... ({len(known)} in all)" if len(known) > len(some) else ""
            hint = f"known: {', '.join(some) or 'none'}{more}"
        super().__init__(f"unknown {kind} {name!r}: {hint}")
        self.name = name
        self.nearest = near

    def __reduce__(self) -> tuple[Any, ...]:
        """What crosses to another process: the message, which says all."""
        return _copied, (type(self), self.args, self.__dict__)


class SimulationError(PamError):
    """The integrator could not go on.

    ``time`` is how far it came, ``trajectory`` what was computed until then (or None).

    Examples
    --------
    >>> try:
    ...     pam.simulate(plant, {"muscle.command": 3e5}, duration=1.0, rtol=1e-14, max_steps=5)
    ... except pam.SimulationError as error:
    ...     print(error.time < 1.0)
    ...
    True
    """

    def __init__(self, message: str, time: float | None = None, trajectory: Any = None) -> None:
        super().__init__(message)
        self.time = time
        self.trajectory = trajectory


class FitError(PamError):
    """The data do not allow this fit, or the solver did not find it.

    Examples
    --------
    >>> p, x = [2e5, 3e5], [0.02, 0.03]
    >>> pam.fitting.fit_holds(plant, {"muscle_pressure": p, "x": x}, ["mass", "gravity"])
    Traceback (most recent call last):
    pam_ocp.core.exceptions.FitError: the holds do not tell all of mass, gravity: ...
    """


class OutOfTime(PamError, TimeoutError):
    """A ``time_limit`` was over before there was a result."""


class PlanError(PamError):
    """A plan that was not found; ``plan`` holds what the solver left, sealed.

    Examples
    --------
    >>> try:
    ...     pam.plan(slide, [{"x": -0.01}, {"x": 0.01}], duration=0.02, starts=1)
    ... except pam.PlanError as error:
    ...     print(error.plan.solved, len(error.plan.conflicts) > 0)
    ...
    False True
    """

    def __init__(self, message: str, plan: Any = None) -> None:
        super().__init__(message)
        self.plan = plan


class PlanWarning(UserWarning):
    """A plan was found, but not verified: its verdict says which figure failed.

    Examples
    --------
    >>> issubclass(pam.PlanWarning, UserWarning)
    True
    """


class VibrationError(PamError):
    """A border, a limit cycle or an oscillation that was asked for and not found; says why.

    Examples
    --------
    >>> slow = pam.HangingLoad(muscle, 10.0, damping=1e4, feed=pam.feeds.IdealPressure())
    >>> pam.vibration.free_vibration(slow, {"muscle.pressure": 3e5}, 5e-3)
    Traceback (most recent call last):
    pam_ocp.core.exceptions.VibrationError: 'hanging_load' does not oscillate about ...
    """


class ExportError(PamError):
    """An FMU could not be built.

    Examples
    --------
    >>> issubclass(pam.ExportError, pam.PamError)
    True
    """
