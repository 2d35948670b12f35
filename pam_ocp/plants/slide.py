"""Two muscles against each other: the antagonistic pair on a slide."""

from __future__ import annotations

from collections.abc import Sequence

from ..core.errors import InputError, require_finite, require_positive
from ..core.quantities import meant_within
from ..core.system import Scope
from ..muscles.pneumatic_muscle import Muscle
from .components import as_damping, as_muscle
from .damping import ConstantDamping, Damping, Loss
from .feeds import Feed
from .kinds import PLANTS
from .loads import Coordinate, Load, applied, as_loads
from .plant import Plant
from .regulator import COMMAND, feeds_of_pair
from .sketch import Line, Mark, Polygon, Sketch, Spindle, box


@PLANTS.register(units={"mass": "kg", "pre_contraction": "1", "stroke": "m"})
class AntagonisticSlide(Plant):
    """Two muscles pulling a slide in opposite directions: m x'' + c x' = F1 - F2 + loads.

    kappa1 = k0 + x/l0 and kappa2 = k0 - x/l0: muscle 1 pulls towards +x, muscle 2 towards -x.

    Parameters
    ----------
    muscle : muscle 1, and muscle 2 unless ``muscle2`` is given.
    mass : moving mass [kg].
    pre_contraction : contraction k0 of both muscles at x = 0.
    stroke : largest |x| [m]; by default as far as both muscles stay in their measured range.
    damping : ``ConstantDamping(value)`` (default 20 N s/m) or its value, or
        ``StiffnessDamping(ratio)``.
    feed : how each pressure comes about; default ``Regulator()``.
    losses : friction, hysteresis, creep of each muscle, as ``(CoulombFriction(), Creep())``.
    loads : what else acts on the slide, as ``(ExternalForce(), DryFriction(5.0))``.

    States x [m], v [m/s], those of feeds and losses; outputs of both muscles, and ``stiffness``.
    With equal muscles the plant is its own mirror image (x -> -x, muscle 1 <-> muscle 2).

    Examples
    --------
    >>> slide = pam.AntagonisticSlide(muscle, mass=2.0, pre_contraction=0.10)
    >>> rest = slide.equilibrium(x=0.0, stiffness=2e4)
    >>> abs(rest["muscle1.pressure"] - rest["muscle2.pressure"]) < 1.0
    True
    """

    def __init__(
        self,
        muscle: Muscle | str,
        mass: float = 2.0,
        pre_contraction: float = 0.10,
        *,
        muscle2: Muscle | str | None = None,
        stroke: float | None = None,
        damping: Damping | float | None = None,
        feed: Feed | None = None,
        losses: Loss | Sequence[Loss] = (),
        loads: Load | Sequence[Load] = (),
        name: str = "antagonistic_slide",
    ) -> None:
        super().__init__(name, "an antagonistic pair of pneumatic muscles on a slide")
        loads = as_loads(loads)
        mass = require_positive("mass", mass, "kg")
        pre_contraction = require_finite("pre_contraction", pre_contraction, "1")
        first = as_muscle(muscle)
        muscles = (first, first if muscle2 is None else as_muscle(muscle2, "muscle2"))
        farthest = min(reach(m, pre_contraction) for m in muscles)
        if stroke is None:
            stroke = farthest
        elif (stroke := require_positive("stroke", stroke, "m")) > farthest:
            raise InputError(
                f"stroke = {stroke:g} m: with pre_contraction = {pre_contraction:g} the muscles "
                f"allow at most {farthest:.4g} m before one leaves its range of contraction"
                + meant_within(stroke, "m", 0.0, farthest)
            )
        scope = Scope(self)
        x = scope.of("m", 0.01, min=-stroke, max=stroke).state(
            "x", "position of the slide, towards muscle 1"
        )
        v = scope.of("m/s", 1.0).state("v", "velocity of the slide")
        m = scope.of("kg", 1.0, min=1e-6, tunable=True).parameter("mass", mass, "moving mass")
        k0 = scope.of("1", 0.1, min=0.0, max=0.45, display_unit="%").parameter(
            "pre_contraction", pre_contraction, "contraction of both muscles at x = 0"
        )
        feeds = feeds_of_pair(self, feed, muscles)
        pair = [
            self.add_muscle(
                f"muscle{i}",
                part,
                shortening=sign * x,
                rate=sign * v,
                pre_contraction=k0,
                feed=feeds[i - 1],
                losses=losses,
            )
            for i, part, sign in ((1, muscles[0], 1), (2, muscles[1], -1))
        ]
        stiffness = pair[0].stiffness + pair[1].stiffness
        c = as_damping(damping, ConstantDamping()).coefficient(self, m, stiffness)
        self.der(x, v)
        outside, added = applied(self, loads, Coordinate(x, v))
        moving = m + pair[0].moving_mass + pair[1].moving_mass + added
        self.der(v, (pair[0].force - pair[1].force - c * v + outside) / moving)
        scope.of("N/m", 1e4).output(
            "stiffness", stiffness, "stiffness of the slide at constant pressures"
        )
        if muscles[0] == muscles[1] and not loads:  # a load may act to one side
            self.mirror({"x": (-1.0, "x"), "v": (-1.0, "v"), **mirrored_pair(self)})

    def sketch(self) -> Sketch:
        """Muscle 2, the slide, muscle 1 in a row between two walls."""
        x, k0 = self.expression("x"), self.expression("pre_contraction")
        lengths = [self.expression(f"muscle{i}.rest_length") for i in (1, 2)]
        half, wall = 0.12 * lengths[0], 0.08 * lengths[0]
        right, left = half + lengths[0] * (1 - k0), -half - lengths[1] * (1 - k0)
        return Sketch(
            (
                Polygon(box((right, -2 * half), (right + wall, 1.6 * half)), "ground"),
                Polygon(box((left - wall, -2 * half), (left, 1.6 * half)), "ground"),
                Line([(left, -1.15 * half), (right, -1.15 * half)], "rail"),
                Spindle("muscle1", (x + half, 0.0), (right, 0.0)),
                Spindle("muscle2", (left, 0.0), (x - half, 0.0)),
                Polygon(box((x - half, -half), (x + half, half))),
                Line([(x, -1.35 * half), (x, -half)], "needle"),
            ),
            (left - 1.5 * wall, right + 1.5 * wall),
            (-3.6 * half, 2.4 * half),
            (Mark("x", [(x, -1.35 * half), (x, -2.2 * half)], "below"),),
        )


def reach(muscle: Muscle, pre_contraction: float) -> float:
    """How far [m] a muscle may shorten or lengthen before it leaves its range of contraction."""
    low, high = muscle.contraction_range
    if not low < pre_contraction < high:
        raise InputError(
            f"pre_contraction = {pre_contraction:g} is outside the muscle's range of contraction "
            f"{low:g} .. {high:g}: a muscle would be slack or overstretched in the middle"
            + meant_within(pre_contraction, "1", low, high)
        )
    return min(pre_contraction - low, high - pre_contraction) * float(muscle.rest_length)


def mirrored_pair(plant: Plant) -> dict[str, tuple[float, str]]:
    """Each state and input of muscle1 mapped to that of muscle2, and back; a command that both
    share to its negative.
    """
    swapped = {}
    for variable in (*plant.states, *plant.inputs):
        if variable.name.partition(".")[0] == COMMAND:
            swapped[variable.name] = (-1.0, variable.name)
        for one, two in (("muscle1.", "muscle2."), ("muscle2.", "muscle1.")):
            if variable.name.startswith(one):
                swapped[variable.name] = (1.0, two + variable.name.removeprefix(one))
    return swapped
