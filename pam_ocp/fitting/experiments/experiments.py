"""The next measurement, static or dynamic."""

from __future__ import annotations

from typing import Any, overload

from ...core.errors import InputError
from ...core.stop import verb
from ...muscles.law import ForceLaw
from ...plants.plant import Plant
from ..dynamic.coverage import Coverage
from ..dynamic.plant_fit import PlantFit
from ..static.force_fit import ForceFit
from .cells import CellDesign, design_cells
from .signals import SignalDesign, design_signal
from .visits import GapSignal

__all__ = ["CellDesign", "SignalDesign", "design_cells", "design_experiment", "design_signal"]


@overload
def design_experiment(known: ForceFit | ForceLaw, *args: Any, **options: Any) -> CellDesign: ...
@overload
def design_experiment(known: Plant | PlantFit, *args: Any, **options: Any) -> SignalDesign: ...
@overload
def design_experiment(known: Coverage, *args: Any, **options: Any) -> GapSignal: ...
@verb
def design_experiment(
    known: Any, *args: Any, **options: Any
) -> CellDesign | SignalDesign | GapSignal:
    """What to measure next so that intervals shrink most, within the bench's limits.

    For a ForceFit or a force law: pressures and lengths, see :func:`design_cells` for the
    arguments. For a PlantFit, a Plant or a Coverage: the pressure signal, see
    :func:`design_signal`.

    Raises InputError for anything else.

    Examples
    --------
    >>> design = pam.experiments.design_experiment(fit, 4)  # of a plant: a signal to play
    >>> type(design).__name__
    'CellDesign'
    """
    if isinstance(known, (ForceFit, ForceLaw)):
        return design_cells(known, *args, **options)
    if isinstance(known, (Plant, PlantFit, Coverage)):
        return design_signal(known, *args, **options)
    raise InputError(
        f"known is a {type(known).__name__}; give a ForceFit, a force law, a Plant or a PlantFit"
    )
