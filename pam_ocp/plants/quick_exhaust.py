"""A quick exhaust at the muscle: it vents there what would have to go back through the tube."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca

from ..core.errors import InputError, require_finite, require_positive
from ..muscles.dead_zone import smooth_step
from ..muscles.gas import conductance_from_flow
from .airflow import Place, Stream, through
from .kinds import QUICK_EXHAUSTS

__all__ = ["QuickExhaust"]


@QUICK_EXHAUSTS.register(units={"conductance": "m3/(s.Pa)", "threshold": "Pa", "band": "Pa"})
@dataclass(frozen=True)
class QuickExhaust:
    """A quick-exhaust valve at the muscle: opens to ambient when the tube's pressure falls below.

    The opening goes smoothly from 0 to 1 while the muscle's pressure exceeds that at the valve's
    end of the tube by ``threshold`` to ``threshold`` + ``band``.

    conductance, critical_ratio : C [m3/(s.Pa)] and b of ISO 6358, open.
    threshold, band : [Pa]. Their defaults are our choice.

    The lip that shuts the tube while it vents is left out: a little air goes back through the tube.

    Examples
    --------
    >>> vent = pam.feeds.QuickExhaust()
    >>> feed = pam.feeds.SpoolValve(tube=pam.feeds.Tube(), quick_exhaust=vent)
    >>> len(pam.HangingLoad(muscle, feed=feed).states)
    4
    """

    conductance: float = conductance_from_flow(700.0)
    critical_ratio: float = 0.3
    threshold: float = 1e4
    band: float = 2e4

    def __post_init__(self) -> None:
        require_positive("QuickExhaust.conductance", self.conductance, "m3/(s.Pa)")
        require_positive("QuickExhaust.threshold", self.threshold, "Pa", zero=True)
        require_positive("QuickExhaust.band", self.band, "Pa")
        if not 0 <= require_finite("QuickExhaust.critical_ratio", self.critical_ratio) < 1:
            raise InputError(
                f"QuickExhaust.critical_ratio = {self.critical_ratio:g} must lie in 0 .. 1"
            )

    def vent(
        self, declare: Callable[..., Any], muscle: Place, port: Place, outside: Place
    ) -> Stream:
        """Connect it between a muscle and ambient, moved by the pressure at ``port``."""
        conductance = declare(
            "quick_conductance",
            self.conductance,
            unit="m3/(s.Pa)",
            min=0.0,
            nominal=1e-8,
            description="sonic conductance of the quick exhaust",
        )
        threshold, band = (
            declare(
                f"quick_{key}",
                value,
                unit="Pa",
                min=low,
                nominal=1e4,
                description=f"{key} of the quick exhaust",
            )
            for key, value, low in (("threshold", self.threshold, 0.0), ("band", self.band, 1.0))
        )
        excess = muscle.air.absolute - port.air.absolute - threshold
        opening = smooth_step(ca.SX(excess / band))
        return through(muscle, outside, conductance, self.critical_ratio, opening)
