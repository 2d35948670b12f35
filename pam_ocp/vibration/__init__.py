"""Vibration: free and self-excited, its border and its limit cycles.

- :func:`free_vibration`, :func:`backbone`: let go beside a point of rest; frequency, decay, and
  frequency against amplitude.
- :func:`energy`: why a muscle at constant pressure cannot vibrate by itself (the theorem stands
  in :mod:`pam_ocp.vibration.energy`).
- :func:`stability_path`, :func:`hopf`, :func:`hopf_border`: eigenvalues along points of rest, and
  where vibration is born once an active element is in the loop.
- :func:`limit_cycle`, :func:`continue_cycle`: the sustained vibration itself, its Floquet
  multipliers, and how it changes with a parameter.

Every result is a frozen dataclass that prints and plots itself.
"""

from __future__ import annotations

from ..core.errors import VibrationError
from ..operating.along import StabilityPath, stability_path
from .cycle import LimitCycle, limit_cycle
from .cycle_branch import CycleBranch, continue_cycle
from .energy import Energy, energy
from .free import Backbone, FreeVibration, backbone, free_vibration
from .hopf import HopfBorder, HopfPoint, hopf, hopf_border

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
