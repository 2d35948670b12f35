"""as_nlsys: a plant as one of python-control's own systems."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from ..core.errors import require_positive, require_tolerance
from ..core.stop import verb
from ..plants.inversion import Inversion
from ..plants.plant import Plant, Values
from .linear import chosen_signals, point_of
from .resting_point import OperatingPoint

if TYPE_CHECKING:
    from .plant_system import PlantSystem

__all__ = ["as_nlsys"]


@verb
def as_nlsys(
    plant: Plant,
    at: OperatingPoint | Values | None = None,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    dt: float | None = None,
    rtol: float = 1e-9,
) -> PlantSystem:
    """The plant as python-control's NonlinearIOSystem, on CasADi functions without conversions.

    at : an OperatingPoint, or values by name (also of parameters); by default the start values.
        Inputs left out of ``inputs`` are held at its values.
    inputs, outputs : names to keep; by default all inputs, and all states and outputs. Of a plant
        fed by valves the inputs are the openings (``muscle_opening``), which have a slope through
        zero, unless commands are named; ``pam.plants.Inversion(plant).commands(...)`` gives the
        commands.
        ``inputs=[]`` gives an autonomous system, as ``phase_plane_plot`` wants it.

    Signals and parameters keep the plant's names with ``_`` for ``.`` (python-control reads a dot
    as system.signal); SI units in ``system.units``. Parameters change by python-control's
    ``params`` (``{"mass": 3.0}``); names that are not the plant's are passed over, as
    python-control's interconnections hand all parameters to every system. ``system.x0`` and
    ``system.u0`` hold the point ``at``; ``control.linearize`` of the system uses exact Jacobians.

    dt : sampling time [s] for a discrete-time system: its update is the plant's motion over one
        sample under held inputs, integrated at the relative tolerance ``rtol``. python-control then
        calls one compiled function for each sample, also in a loop with sampled controllers.
        Default: continuous time.

    Which call for which purpose: ``system.response(t, u)`` is the quickest for the plant alone (the
    plant's own integrator, nothing called in between); ``control.input_output_response`` of a
    system with ``dt`` for held inputs and sampled loops; that of a continuous one for everything
    else. There python-control integrates by default to rtol 1e-3: give ``solve_ivp_kwargs={"rtol":
    1e-9, "atol": 1e-9 * nominal}`` where figures matter. It joins samples of inputs by straight
    lines, as ``response`` does (held when the system has a ``dt``). One system may be used by
    several threads at once as long as ``params`` stay the same; copies are independent.

    Raises InputError or UnknownNameError for names that are not the plant's.

    Examples
    --------
    >>> import control
    >>> system = pam.operating.as_nlsys(plant, point)
    >>> t = np.linspace(0, 1, 11)
    >>> held = np.full(11, system.u0[0])
    >>> run = control.input_output_response(system, t, held, system.x0)
    >>> bool(np.ptp(run.outputs[0]) < 1e-5)  # it stays at rest
    True
    """
    from .plant_system import PlantSystem

    plant, x, u = point_of(plant, at)
    inversion = Inversion(plant)
    if inversion and (inputs is None or any(inversion.opening_of(n) for n in inputs)):
        u = inversion.rows(u[None, :], x=x[None, :])[0]
        plant, x = inversion.inner, inversion.inside(x)
    return PlantSystem(
        plant,
        x,
        u,
        chosen_signals("inputs", plant, inputs, ("input",)),
        chosen_signals("outputs", plant, outputs, ("state", "output")),
        None if dt is None else require_positive("dt", dt, "s"),
        require_tolerance("rtol", rtol),
    )
