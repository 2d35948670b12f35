"""What slide and joint share: the range of a pre-contracted pair, and its mirror symmetry."""

from __future__ import annotations

from ..core.errors import InputError
from ..core.plausible import meant_within
from ..muscles.pneumatic_muscle import Muscle
from .pair_regulator import COMMAND
from .plant import Plant

__all__ = ["mirrored_pair", "reach"]


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
