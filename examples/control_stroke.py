"""How well a load can be moved and seen along its stroke, and how it swings over pressure and
place.

Run:  python examples/control_stroke.py [folder for the results]
"""

import sys
from pathlib import Path

import numpy as np

import pam_ocp as pam
from pam_ocp.control.analysis import along_stroke, mode_map
from pam_ocp.figures.control import plot_mode_map, plot_stroke

BAR = 1e5


def main(folder: Path) -> None:
    muscle = pam.muscle("DMSP-20-400N")
    strokes = {}
    for mass in (10.0, 20.0, 40.0):
        plant = pam.HangingLoad(muscle, mass, damping=pam.losses.ConstantDamping(100.0))
        strokes[f"{mass:g} kg"] = along_stroke(plant, "x", np.linspace(0.002, 0.095, 60))
    plot_stroke(strokes, "A load on one muscle, along its stroke").savefig(
        folder / "control_stroke.png", dpi=120
    )

    # the mass stays 20 kg; a constant force (here as another gravity) holds it at every place
    plant = pam.HangingLoad(muscle, 20.0, damping=pam.losses.ConstantDamping(100.0))
    found = mode_map(
        plant,
        {"muscle.command": np.linspace(1 * BAR, 6 * BAR, 21), "x": np.linspace(0, 0.1, 31)},
        free=["gravity"],
        within={"muscle.force": (10.0, np.inf)},
    )
    inside = found.frequency[np.isfinite(found.frequency)]
    print(f"natural frequency {inside.min():.2f} .. {inside.max():.2f} Hz")
    plot_mode_map(found, "20 kg on a DMSP-20-400N, damping 100 N s/m").savefig(
        folder / "control_stroke_modes.png", dpi=120
    )


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "control_stroke")
    target.mkdir(parents=True, exist_ok=True)
    main(target)
