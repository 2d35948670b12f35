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
from typing import TypeAlias

import casadi as ca

from ...core.expressions import scalar_expression
from ...core.registry import Registry
from ...core.variables import Variable
from ...plants.plant import Plant
from .symbols import Symbols

__all__ = ["COSTS", "RunningCost", "running_cost"]

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
