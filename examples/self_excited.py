"""Self-excited vibration over load and pressure: where it begins and how large it becomes.

A position servo on a valve, and a pressure loop whose spool and electronics are too slow for its
gain. docs/self_excited.md says which parts of a plant can feed a vibration and which cannot.

Run:  python examples/self_excited.py [folder for the pictures]
"""

import sys
from pathlib import Path

import numpy as np

import pam_ocp as pam
from pam_ocp import vibration

LEAK = 2e-10


def position_servo(folder: Path) -> None:
    """The valve opens in proportion to the error of position; the muscle integrates the flow."""
    valve = pam.feeds.ServoValve(pressure_gain=0.0, position_gain=6.0, conductance=2e-8, leak=LEAK)
    plant = pam.HangingLoad("DMSP-20-400N", 20.0, feed=valve)
    axes = {"mass": np.linspace(5.0, 45.0, 9), "x": np.linspace(0.02, 0.08, 7)}
    border = vibration.hopf_map(plant, "muscle.position_gain", (0.1, 100.0), axes)
    print(border)
    border.plot().savefig(folder / "servo_border.png", dpi=120)
    coarse = {name: values[::2] for name, values in axes.items()}
    size = vibration.amplitude_map(plant, coarse)
    print(size)
    size.plot().savefig(folder / "servo_amplitude.png", dpi=120)


def pressure_loop(folder: Path) -> None:
    """A pressure regulator as it is built: the load hardly moves, the pressure hunts."""
    valve = pam.feeds.ServoValve(
        command_lag=0.004,
        spool=pam.feeds.FirstOrderSpool(0.006),
        conductance=5e-8,
        leak=LEAK,
        overlap=0.0,
    )
    plant = pam.HangingLoad("DMSP-20-400N", 20.0, feed=valve)
    axes = {"mass": np.linspace(5.0, 45.0, 9), "x": np.linspace(0.02, 0.08, 7)}
    border = vibration.hopf_map(plant, "muscle.pressure_gain", (1e-6, 1e-3), axes)
    print(border)
    border.plot().savefig(folder / "pressure_loop_border.png", dpi=120)


def main(folder: Path) -> None:
    position_servo(folder)
    pressure_loop(folder)


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "self_excited")
    target.mkdir(parents=True, exist_ok=True)
    main(target)
