"""A plant as it is seen from below: by what declares variables in it, and by numerics.

Rooms below the plants (and the parts that a plant is made of) name these protocols instead.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol, TypeAlias, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from .errors import require_positive
from .variables import Causality, Variable

Way = Literal["filling", "venting"]
"""The part of an opening above zero, and that below."""
PathOf: TypeAlias = "Callable[[ca.SX], ca.SX] | Way"
"""What stands in a plant's equations, of an opening."""

Part = TypeVar("Part")


class Declares(Protocol):
    """What takes variables and equations: a plant, for a feed, a loss, a load or a sensor.

    Each method is that of the same name of :class:`pam_ocp.Plant`.
    """

    @property
    def variables(self) -> tuple[Variable, ...]: ...

    def state(self, name: str, *, start: float = 0.0, **attributes: Any) -> ca.SX: ...

    def input(self, name: str, *, start: float = 0.0, **attributes: Any) -> ca.SX: ...

    def parameter(self, name: str, value: float, **attributes: Any) -> ca.SX: ...

    def der(self, state: ca.SX, derivative: Any) -> None: ...

    def output(self, name: str, expression: Any, **attributes: Any) -> ca.SX: ...

    def constraint(self, name: str, expression: Any, **attributes: Any) -> ca.SX: ...

    def opening(
        self,
        name: str,
        commands: Sequence[ca.SX],
        forward: ca.SX,
        inverse: Callable[[ca.SX], Sequence[ca.SX]],
        paths: Sequence[tuple[ca.SX, PathOf]],
        behind: ca.SX | None = None,
        asked: Any = None,
        **attributes: Any,
    ) -> list[ca.SX]: ...

    def shared(self, name: str, component: Any, declare: Callable[[], Part]) -> Part: ...

    def gathered(self) -> tuple[ca.SX, Callable[[Any], None]]: ...
    def delayed(self, command: ca.SX, dead_time: Any, name: str | None = None) -> ca.SX: ...


@dataclass(frozen=True)
class Scope:
    """Declares the variables of one part of a plant, whose names begin with ``<prefix>.``.

    plant : what they are declared in. prefix : "" for none.
    attributes : what :meth:`of` was given; see :class:`pam_ocp.core.variables.Variable`.

    A quantity is said first, then what is of it: ``scope.of("N/m", 1e3, min=0.0).parameter(
    "stiffness", value, "stiffness of the spring")``.
    """

    plant: Declares
    prefix: str = ""
    attributes: Mapping[str, Any] = field(default_factory=dict)

    def of(self, unit: str = "1", nominal: float = 1.0, **attributes: Any) -> Scope:
        """For variables of this unit, of this usual size, and of these further attributes."""
        return replace(self, attributes={"unit": unit, "nominal": nominal, **attributes})

    def state(self, name: str, words: str) -> ca.SX:
        """A state; ``words`` describe it in one line."""
        return self.plant.state(self._of(name), description=words, **self.attributes)

    def input(self, name: str, words: str) -> ca.SX:
        """An input."""
        return self.plant.input(self._of(name), description=words, **self.attributes)

    def parameter(self, name: str, value: float, words: str) -> ca.SX:
        """A parameter and its value."""
        return self.plant.parameter(self._of(name), value, description=words, **self.attributes)

    def positive(self, name: str, value: Any, words: str, zero: bool = False) -> ca.SX:
        """A parameter of an argument's name, and its value: > 0 (>= 0 with ``zero``), or an
        InputError.
        """
        unit = self.attributes["unit"]
        return self.parameter(name, require_positive(name, value, unit, zero), words)

    def output(self, name: str, value: Any, words: str) -> ca.SX:
        """An output and its expression."""
        return self.plant.output(self._of(name), value, description=words, **self.attributes)

    def constraint(self, name: str, value: Any, words: str) -> ca.SX:
        """A path constraint min <= expression <= max."""
        return self.plant.constraint(self._of(name), value, description=words, **self.attributes)

    def _of(self, name: str) -> str:
        return f"{self.prefix}.{name}" if self.prefix else name


class HasInputs(Protocol):
    """Named variables, inputs among them."""

    @property
    def inputs(self) -> tuple[Variable, ...]: ...

    def variable(self, name: str) -> Variable: ...


class System(HasInputs, Protocol):
    """x' = f(x, u, p), y = g(x, u, p) with named variables: a plant, for numerics.

    Each member is that of the same name of :class:`pam_ocp.Plant`.
    """

    @property
    def states(self) -> tuple[Variable, ...]: ...

    @property
    def parameters(self) -> tuple[Variable, ...]: ...

    @property
    def x(self) -> ca.SX: ...

    @property
    def u(self) -> ca.SX: ...

    @property
    def p(self) -> ca.SX: ...

    @property
    def function(self) -> ca.Function: ...

    @property
    def jacobians(self) -> ca.Function: ...

    def expression(self, name: str) -> ca.SX: ...

    def vector(
        self, causality: Causality, values: Any = None, attribute: str = "start"
    ) -> NDArray[np.float64]: ...

    def cached(self, key: Hashable, build: Callable[[], Any]) -> Any: ...
