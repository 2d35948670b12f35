"""Variable: one named quantity of a plant, with all that a reader or a tool wants to know of it."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, get_args

from . import units
from .errors import InputError, require_number, with_article
from .quantities import doubt, meant_within
from .shown import shown
from .units import DIGITS, significant

Causality = Literal["state", "input", "parameter", "output", "constraint"]
Memory = Literal["", "held", "settling"]

ROUNDING = 1e-6
"""A value of a state so little outside its range, scaled by nominals, is the end of the range."""

ZERO = 1e-9
"""So small a part of its nominal is the rounding of a zero, where people read it."""

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(\.[A-Za-z_][A-Za-z0-9_]*)*$")
_CODE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")


def require_causality(value: Any, where: str = "") -> None:
    """InputError where a value is no causality."""
    if value not in get_args(Causality):
        known = ", ".join(get_args(Causality))
        raise InputError(f"{where}causality = {value!r}: choose one of {known}")


@shown
@dataclass(frozen=True)
class Variable:
    """A named quantity.

    Parameters
    ----------
    name : letters, digits and underscores; parts joined by dots (``muscle1.pressure``).
    causality : "state", "input", "parameter", "output" or "constraint".
    unit : SI unit in Modelica's spelling (``"N.s/m"``); ``"1"`` for a pure number.
    start : initial value of a state, default of an input, value of a parameter [unit].
    min, max : allowed range [unit].
    nominal : a typical size, > 0 [unit]; scales solvers and tolerances.
    description : one line for people.
    tunable : for parameters: may change while a simulation runs.
    disturbance : for inputs: not for a controller to choose; plans and equilibria hold it at start.
    memory : for states: "held" keeps at rest whatever value in min .. max the past has left
        (hysteresis: rest is a continuum, and a point on it has to be chosen); "settling" forgets
        slowly and rests where its own equation says (creep).
    widest : for parameters that round off a kink: the width at which planning a motion begins, to
        be narrowed to the parameter's value; 0 for all others.
    relaxed : for parameters that make a motion hard to plan: the value from which they are led to
        their own together with the widths, and where that leads to nothing, not; without widths
        only where the plant's own program is not solved. 0 for all others.
    display_unit : the unit people read; by default bar for Pa, mm for m, deg for rad.
    codes : what 0, 1, 2, ... mean, a word each with spaces between, where no other values occur.

    Examples
    --------
    >>> x = plant.variable("x")
    >>> x.unit, x.shown(0.04)
    ('m', '40 mm')
    """

    name: str
    causality: Causality
    unit: str = "1"
    start: float | None = None
    min: float = -math.inf
    max: float = math.inf
    nominal: float = 1.0
    description: str = ""
    tunable: bool = False
    display_unit: str = ""
    disturbance: bool = False
    memory: Memory = ""
    widest: float = 0.0
    relaxed: float = 0.0
    codes: str = ""

    @property
    def kind(self) -> str:
        """Its causality as a sentence names it: "an input", "a state"."""
        return with_article(self.causality)

    def __post_init__(self) -> None:
        require_causality(self.causality, f"{self.name}: ")
        if not (isinstance(self.name, str) and _NAME.match(self.name)):
            raise InputError(
                f"name {self.name!r} of a variable: use letters, digits and underscores, "
                "starting with a letter, parts joined by dots"
            )
        measured = units.unit(self.unit)
        if not self.display_unit:
            object.__setattr__(self, "display_unit", units.display_unit(self.unit))
        elif not units.unit(self.display_unit).compatible(measured):
            raise InputError(
                f"{self.name}: display_unit {self.display_unit!r} does not measure the same "
                f"quantity as unit {self.unit!r}"
            )
        for argument in ("nominal", "min", "max", "widest", "relaxed"):
            number = self.number(getattr(self, argument), argument)
            object.__setattr__(self, argument, number)
        for argument in ("widest", "relaxed"):
            value = getattr(self, argument)
            if value and not (0 < value < math.inf and self.causality == "parameter"):
                raise InputError(
                    f"{self.name}: {argument} = {value:g}: give a finite number > 0, of a parameter"
                )
        if not (math.isfinite(self.nominal) and self.nominal > 0):
            raise InputError(f"{self.name}: nominal = {self.nominal} must be finite and > 0")
        if math.isnan(self.min) or math.isnan(self.max) or self.min > self.max:
            raise InputError(
                f"{self.name}: min = {self.min:g} must not lie above max = {self.max:g}"
            )
        if self.memory not in ("", "held", "settling"):
            raise InputError(f"{self.name}: memory = {self.memory!r}; choose 'held' or 'settling'")
        if self.memory and self.causality != "state":
            raise InputError(f"{self.name}: only states have memory, this is {self.kind}")
        if self.memory == "held" and not (math.isfinite(self.min) and math.isfinite(self.max)):
            raise InputError(f"{self.name}: a held memory needs a finite min and max")
        if self.codes != "":
            self._check_codes()
        doubted = math.isfinite(self.max) and self.doubt(self.max, "max")
        if not doubted and self.start is not None:
            object.__setattr__(self, "start", self.check(self.start, "start"))
        if self.codes and self.start is not None and self.start % 1:
            raise InputError(
                f"{self.name}: start = {self.start:g}: give one of the codes 0, 1, ..."
            )

    def _check_codes(self) -> None:
        """What is set by codes is one of them."""
        words = self.codes.split() if isinstance(self.codes, str) else []
        if not all(map(_CODE.match, words)) or not 2 <= len({*words}) == len(words):
            raise InputError(
                f"{self.name}: codes = {self.codes!r}: give at least two different words of "
                "letters, digits and underscores, such as 'off slow fast'"
            )
        if self.unit != "1":
            raise InputError(f"{self.name}: codes have no unit, this is in {self.unit}")
        if self.causality != "output":
            object.__setattr__(self, "min", max(self.min, 0.0))
            object.__setattr__(self, "max", min(self.max, len(words) - 1.0))

    def number(self, value: Any, argument: str = "value") -> float:
        """``value`` as a float [unit]; a text such as "20 mm" or "3 bar" is one too.

        InputError when it is no number. Infinite and NaN pass here.
        """
        return require_number(f"{self.name}: {argument}", value, self.unit)

    def check(self, value: Any, argument: str = "value") -> float:
        """``value`` as a float; InputError when it is no finite number in [min, max].

        A state may lie outside by the rounding of an integrator or a solver, ROUNDING nominals:
        then it is the end of its range. Warns (UnitWarning) when the value is so far from any usual
        one that another unit was meant.
        """
        number = self.number(value, argument)
        if not math.isfinite(number):
            raise InputError(f"{self.name}: {argument} = {number} must be finite")
        if self.causality == "state":
            nearest = min(max(number, self.min), self.max)
            if abs(number - nearest) <= ROUNDING * self.nominal:
                number = nearest
        if not self.min <= number <= self.max:
            raise InputError(
                f"{self.name}: {argument} = {self.exactly(number)} is outside "
                f"{self.exactly(self.min)} .. {self.exactly(self.max)}"
                + meant_within(number, self.unit, self.min, self.max)
            )
        self.doubt(number, argument)
        return number

    def doubt(self, value: Any, argument: str = "value") -> bool:
        """Warn (UnitWarning), and say so, when numbers [unit] are far from any usual ones."""
        constant = self.unit == "s" and self.causality == "parameter"
        return doubt(
            f"{self.name}: {argument}",
            value,
            self.unit,
            nominal=self.nominal,
            time_constant=constant,
            within=(self.min, self.max),
        )

    def with_start(self, value: Any) -> Variable:
        """The same variable with another start value, checked against min and max."""
        return replace(self, start=self.number(value, "start"))

    @property
    def display_factor(self) -> float:
        """SI value per display unit: value_SI = display_factor * value_displayed."""
        return units.unit(self.display_unit).factor / units.unit(self.unit).factor

    def displayed(self, value: float) -> float:
        """``value`` [unit] in the display unit; 0 for what rounding has left of a zero, except in
        parameters, which are as they were given.
        """
        if self.causality != "parameter" and abs(value) < ZERO * self.nominal:
            return 0.0
        return value / self.display_factor + 0.0

    def shown(self, value: float, digits: int = DIGITS) -> str:
        """``value`` [unit] as text in the display unit: ``shown(2e5) == "2 bar"``.

        digits : significant ones.
        """
        text = significant(self.displayed(value), digits)
        return text if self.display_unit == "1" else f"{text} {self.display_unit}"

    def exactly(self, value: float) -> str:
        """As :meth:`shown`, with the digits that tell a value from a bound next to it."""
        return self.shown(value, DIGITS + 2)

    def _brief(self) -> str:
        start = "" if self.start is None else f" = {self.shown(self.start)}"
        return f"{self.causality} {self.label}{start}"

    @property
    def label(self) -> str:
        """Name and display unit, for an axis or a column head."""
        return self.name if self.display_unit == "1" else f"{self.name} [{self.display_unit}]"


_TEXTS = ("name", "causality", "unit", "description", "display_unit", "memory", "codes")
_FLAGS = ("tunable", "disturbance")


def data_of_variable(variable: Variable) -> dict[str, Any]:
    """A variable as JSON takes it, which has no infinity: null in its place."""
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in asdict(variable).items()
    }


def variable_of(said: Mapping[str, Any]) -> Variable:
    """The Variable that :func:`data_of_variable` or ``dataclasses.asdict`` took apart, as a file
    tells it.

    Raises InputError for a value of a wrong kind, TypeError for a key that no variable has.
    """
    said = {k: v for k, v in said.items() if v is not None or k not in ("min", "max")}
    for key, value in said.items():
        wanted: Any = str if key in _TEXTS else bool if key in _FLAGS else (int, float)
        if value is None and key == "start":
            continue
        if not isinstance(value, wanted) or (isinstance(value, bool) and key not in _FLAGS):
            raise InputError(f"{key} of a variable is {value!r}: the file is damaged")
    if said.get("causality") not in get_args(Causality):
        raise InputError(f"causality = {said.get('causality')!r}: the file is damaged")
    return Variable(**said)
