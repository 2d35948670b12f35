"""PAM-2DIR, (a) and (b): the plants and what is asked of them. Nothing else is imported, so that
what a whole process takes is the library's.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pam_ocp as pam

BAR = 1e5
COMMANDS = ("muscle1.command", "muscle2.command")
STOPS = [{"x": -0.015}, {"x": 0.015}]
WISHES: dict[str, dict[str, Any]] = {
    "a": {"cyclic": "mirrored"},
    "b": {"cyclic": "mirrored", "duration": 0.15, "minimise": {"effort": 1e-2}},
}


def plant(case: str) -> pam.Plant:
    """Of case "a" or "b"."""
    return slide() if case == "a" else commanded()


def driven(muscle: pam.Muscle, feed: Any) -> pam.Plant:
    """The slide between two such muscles."""
    damping = pam.losses.ConstantDamping(20.0)
    return pam.AntagonisticSlide(muscle, 2.0, 0.10, stroke=0.016, damping=damping, feed=feed)


def slide() -> pam.Plant:
    feed = pam.feeds.Regulator(0.05, max_pressure=6 * BAR, max_rate=40 * BAR)
    return driven(pam.muscle("DMSP-20-200N"), feed)


class RateOfCommand:
    """The feed of case (b): its input is the rate of the commanded pressure."""

    def connect(self, plant: pam.Plant, name: str, muscle: Any, contraction: Any, rate: Any) -> Any:
        bounds = {"unit": "Pa", "min": 0.0, "max": 6 * BAR, "start": 3 * BAR, "nominal": BAR}
        pressure = plant.state(f"{name}.pressure", **bounds)
        command = plant.state(f"{name}.command", **bounds)
        limit = 2000 * BAR
        w = plant.input(f"{name}.command_rate", unit="Pa/s", min=-limit, max=limit, nominal=BAR)
        change = (command - pressure) / 0.05
        plant.der(pressure, change)
        plant.der(command, w)
        plant.constraint(
            f"{name}.pressure_rate",
            change,
            unit="Pa/s",
            min=-40 * BAR,
            max=40 * BAR,
            nominal=10 * BAR,
        )
        return pressure


def commanded() -> pam.Plant:
    return driven(replace(pam.muscle("DMSP-20-200N"), slack_width=1e-2), RateOfCommand())
