"""Vibration: free and self-excited, its border and its limit cycles.

- :func:`free_vibration`, :func:`backbone`: let go beside a point of rest; frequency, decay, and
  frequency against amplitude.
- :func:`energy`: why a muscle at constant pressure cannot vibrate by itself (the theorem stands
  in :mod:`pam_ocp.vibration.energy_balance`).
- :func:`stability_path`, :func:`hopf`, :func:`hopf_border`: eigenvalues along points of rest, and
  where vibration is born once an active element is in the loop.
- :func:`limit_cycle`, :func:`continue_cycle`: the sustained vibration itself, its Floquet
  multipliers, and how it changes with a parameter.

Every result is a frozen dataclass that prints and plots itself.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.lazy import lazily

if TYPE_CHECKING:
    from ..core.errors import VibrationError as VibrationError
    from ..operating.along import StabilityPath as StabilityPath
    from ..operating.along import stability_path as stability_path
    from .cycle import LimitCycle as LimitCycle
    from .cycle import limit_cycle as limit_cycle
    from .cycle_branch import CycleBranch as CycleBranch
    from .cycle_branch import continue_cycle as continue_cycle
    from .energy_balance import Energy as Energy
    from .energy_balance import energy as energy
    from .free import Backbone as Backbone
    from .free import FreeVibration as FreeVibration
    from .free import backbone as backbone
    from .free import free_vibration as free_vibration
    from .hopf_bifurcation import HopfBorder as HopfBorder
    from .hopf_bifurcation import HopfPoint as HopfPoint
    from .hopf_bifurcation import hopf as hopf
    from .hopf_bifurcation import hopf_border as hopf_border

__all__ = [
    "Backbone",
    "CycleBranch",
    "Energy",
    "FreeVibration",
    "HopfBorder",
    "HopfPoint",
    "LimitCycle",
    "StabilityPath",
    "VibrationError",
    "backbone",
    "continue_cycle",
    "energy",
    "free_vibration",
    "hopf",
    "hopf_border",
    "limit_cycle",
    "stability_path",
]

_HOMES = {
    "Backbone": "vibration.free",
    "CycleBranch": "vibration.cycle_branch",
    "Energy": "vibration.energy_balance",
    "FreeVibration": "vibration.free",
    "HopfBorder": "vibration.hopf_bifurcation",
    "HopfPoint": "vibration.hopf_bifurcation",
    "LimitCycle": "vibration.cycle",
    "StabilityPath": "operating.along",
    "VibrationError": "core.errors",
    "backbone": "vibration.free",
    "continue_cycle": "vibration.cycle_branch",
    "energy": "vibration.energy_balance",
    "free_vibration": "vibration.free",
    "hopf": "vibration.hopf_bifurcation",
    "hopf_border": "vibration.hopf_bifurcation",
    "limit_cycle": "vibration.cycle",
    "stability_path": "operating.along",
}

__getattr__, __dir__ = lazily(__name__, "pam_ocp", _HOMES)
