"""Vibration: free and self-excited, its border and its limit cycles.

- :func:`free_vibration`, :func:`backbone`: let go beside an equilibrium; frequency, decay, and
  frequency against amplitude.
- :func:`energy`: why a muscle at constant pressure cannot vibrate by itself (the theorem stands
  in :mod:`pam_ocp.vibration.energy_balance`).
- :func:`stability_path`, :func:`hopf`, :func:`hopf_border`: eigenvalues along equilibria, and
  where vibration is born once an active element is in the loop.
- :func:`limit_cycle`, :func:`continue_cycle`: the sustained vibration itself, its Floquet
  multipliers, and how it changes with a parameter.

Every result is a frozen dataclass that prints and plots itself.
"""

from ..core.lazy import from_stub

__getattr__, __dir__, __all__ = from_stub(__name__, __file__)
