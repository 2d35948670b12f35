"""Running costs by name: what a plan may minimise, or keep within a budget, over its motion.

A running cost is a function that gives an integrand; it registers in the file that defines it::

    @running_cost("tension", unit="N2.s")
    def tension(plant: Plant, symbols: Symbols) -> ca.SX:
        '''Integral of the squared force of the first muscle.'''
        return plant.expression("muscle1.force") ** 2
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import casadi as ca

from ..core.errors import InputError
from ..core.expressions import scalar_expression
from ..core.registry import Registry
from ..core.variables import Variable
from ..plants.plant import Plant

POWER = 10.0
"""A typical power of a muscle [W]."""


class Symbols(Protocol):
    """What states max(expression, 0) for whoever counts a cost: a planner smoothly, by further
    unknowns, a judge as it stands.
    """

    def positive(self, variable: Variable, expression: ca.SX) -> ca.SX:
        """max(expression, 0)."""


Integrand: TypeAlias = "Callable[[Plant, Symbols], ca.SX]"


@dataclass(frozen=True)
class RunningCost:
    """A term of an objective, or of the budgets: the integral of ``integrand`` over the motion.

    integrand : (plant, symbols) -> expression in the plant's symbols [SI].
    total : the variable that the integral would be: its unit, and the nominal in which it counts
        beside other terms.
    from_supply : it counts air of the supply, so that pressures at the first stop are no gift.
    slower_is_less : a slower motion always takes less, so the term alone wants a fixed duration.
    economical : its optimum is flat and depends on the mesh: meshes grow until it settles.
    """

    integrand: Integrand
    total: Variable
    title: str
    from_supply: bool = False
    slower_is_less: bool = False
    economical: bool = False

    def expression(self, plant: Plant, symbols: Symbols) -> ca.SX:
        """The integrand for this plant; InputError where it is no scalar."""
        return scalar_expression(self.total.name, self.integrand(plant, symbols))


COSTS: Registry[RunningCost] = Registry("running cost", __package__)
"""What may be minimised by name, besides "rate" and the forms "integral(NAME)" and its like."""


def running_cost(
    name: str,
    *,
    unit: str,
    nominal: float = 1.0,
    from_supply: bool = False,
    slower_is_less: bool = False,
    economical: bool = False,
) -> Callable[[Integrand], Integrand]:
    """Decorator that registers a function (plant, symbols) -> integrand [SI] as a running cost.

    unit, nominal : of the integral. The others: see :class:`RunningCost`.
    """

    def entered(integrand: Integrand) -> Integrand:
        title = " ".join((integrand.__doc__ or "").partition("\n\n")[0].split()).rstrip(".")
        total = Variable(name, "output", unit=unit, nominal=nominal)
        cost = RunningCost(integrand, total, title, from_supply, slower_is_less, economical)
        COSTS.register(name, home=integrand)(cost)
        return integrand

    return entered


@running_cost("time", unit="s")
def _time(plant: Plant, symbols: Symbols) -> ca.SX:
    """Duration of the whole motion."""
    return ca.SX(1)


@running_cost("effort", unit="s", slower_is_less=True)
def _effort(plant: Plant, symbols: Symbols) -> ca.SX:
    """Integral of the squared inputs, scaled by nominals."""
    return ca.sumsqr(plant.u / plant.vector("input", attribute="nominal"))


@running_cost("air", unit="kg", nominal=1e-3, from_supply=True, economical=True)
def _air(plant: Plant, symbols: Symbols) -> ca.SX:
    """Air drawn from the supply, of muscles fed by valves."""
    return _total(plant, "supply_flow", "air")


@running_cost("exergy", unit="J", nominal=10.0, from_supply=True, economical=True)
def _exergy(plant: Plant, symbols: Symbols) -> ca.SX:
    """Work that the air drawn from the supply could do."""
    return _total(plant, "exergy_flow", "exergy")


def _total(plant: Plant, kind: str, term: str) -> ca.SX:
    """Sum of the outputs ``<muscle>.<kind>``."""
    found = [v.name for v in plant.outputs if v.name.endswith(f".{kind}")]
    if not found:
        raise InputError(
            f"{term!r} needs the outputs '<muscle>.{kind}', which plant {plant.name!r} has not; "
            "feed its muscles by valves (feed=SpoolValve(...)), or give an expression as integrand"
        )
    return ca.sum1(ca.vertcat(*(plant.expression(name) for name in found)))


@running_cost("work", unit="J", economical=True)
def _work(plant: Plant, symbols: Symbols) -> ca.SX:
    """Mechanical work of the muscles, each counted where its power is positive."""
    muscles = muscles_of(plant)
    if not muscles:
        raise InputError(f"'work': plant {plant.name!r} has no muscle with force and contraction")
    total = ca.SX(0)
    for name in muscles:
        variable = Variable(f"{name}.power", "output", unit="W", nominal=POWER)
        total += symbols.positive(variable, mechanical_power(plant, name))
    return total


def muscles_of(plant: Plant) -> list[str]:
    """Names of what has a force and a contraction."""
    outputs = {v.name for v in plant.outputs}
    names = [v.name.removesuffix(".force") for v in plant.outputs if v.name.endswith(".force")]
    return [n for n in names if f"{n}.contraction" in outputs]


def mechanical_power(plant: Plant, muscle: str) -> ca.SX:
    """Mechanical power out of a muscle [W]: its output, or force times speed of shortening."""
    if any(v.name == f"{muscle}.power" for v in plant.outputs):
        return plant.expression(f"{muscle}.power")
    xdot = plant.function(plant.x, plant.u, plant.p)[0]
    rate = ca.jtimes(plant.expression(f"{muscle}.contraction"), plant.x, xdot)
    return ca.SX(
        plant.expression(f"{muscle}.force") * rate * plant.expression(f"{muscle}.rest_length")
    )
