"""pam_ocp: pneumatic artificial muscles, from a measured table to a verified optimal motion and an
FMU.

Three nouns (Muscle, Plant, Trajectory) and five verbs (simulate, fit, plan, linearize, export)
around one symbolic CasADi model. SI units inside; pressures are gauge; contraction is a fraction.
"""

from __future__ import annotations

import sys
import warnings
from typing import Any

from .core.lazy import MovedModules, from_stub

__version__ = "0.2.0"

_loaded, __dir__, __all__ = from_stub(__name__, __file__)

_MOVED: dict[str, str] = {
    "Allocation": "operating",
    "AllocationError": "operating",
    "BoucWen": "losses",
    "BraidVolume": "gas",
    "CellDesign": "experiments",
    "Comparison": "simulation",
    "ConsistentVolume": "gas",
    "ConstantDamping": "losses",
    "CorrectedLaw": "laws",
    "CoulombFriction": "losses",
    "Creep": "losses",
    "Damper": "loads",
    "DescribingFunction": "control",
    "DirectionalDamping": "losses",
    "DryFriction": "loads",
    "EquilibriumError": "operating",
    "ExternalForce": "loads",
    "FiveParameterLaw": "laws",
    "ForceFit": "fitting",
    "ForceLaw": "laws",
    "ForceTable": "fitting",
    "FreeRun": "fitting",
    "FreeRunFit": "fitting",
    "Gas": "gas",
    "GeometricLaw": "laws",
    "HildebrandtLaw": "laws",
    "Hysteresis": "fitting",
    "IdealPressure": "feeds",
    "Inertia": "loads",
    "InverseDynamics": "control",
    "Inversion": "plants",
    "JointForceFit": "fitting",
    "LAWS": "laws",
    "LackOfFit": "fitting",
    "LawComparison": "fitting",
    "LengthScaledLaw": "laws",
    "LoadStudy": "studies",
    "ManySimulations": "simulation",
    "MaxwellSlip": "losses",
    "MovingHorizonEstimator": "control",
    "OffsetFree": "control",
    "OnOffValves": "feeds",
    "OpenLoop": "control",
    "OperatingPoint": "operating",
    "PID": "control",
    "Pareto": "planning",
    "Plan": "planning",
    "PlantFit": "fitting",
    "PolynomialVolume": "gas",
    "PositionController": "control",
    "PositionFeedback": "plants",
    "PressureLoop": "control",
    "RecordComparison": "simulation",
    "Regulator": "feeds",
    "RobustPlan": "planning",
    "Shooting": "planning",
    "SignalDesign": "experiments",
    "SixParameterLaw": "laws",
    "SpoolValve": "feeds",
    "Spread": "planning",
    "Spring": "loads",
    "StiffnessDamping": "losses",
    "StrokeWork": "simulation",
    "TIME": "planning",
    "ThickWallLaw": "laws",
    "ThreeElementLaw": "laws",
    "Tube": "feeds",
    "TwoSlopeThreeElementLaw": "laws",
    "ValidityWarning": "muscles",
    "Verdict": "planning",
    "VibrationError": "vibration",
    "Wall": "loads",
    "WithEstimate": "control",
    "along_stroke": "control",
    "animate_plan": "figures",
    "as_nlsys": "operating",
    "backbone": "vibration",
    "bode_cloud": "control",
    "closed_stiffness": "gas",
    "coefficient": "laws",
    "common_and_difference": "operating",
    "compare_with_record": "simulation",
    "conductance_from_flow": "gas",
    "continue_cycle": "vibration",
    "describing_function": "control",
    "design_cells": "experiments",
    "design_experiment": "experiments",
    "design_signal": "experiments",
    "draws": "simulation",
    "energy": "vibration",
    "equilibria": "operating",
    "equilibrium_branch": "operating",
    "equilibrium_path": "operating",
    "export_motion": "export",
    "fit_branches": "fitting",
    "free_run": "fitting",
    "free_vibration": "vibration",
    "hopf": "vibration",
    "hopf_border": "vibration",
    "hysteresis": "fitting",
    "iso6358": "gas",
    "kalman": "control",
    "lack_of_fit": "fitting",
    "limit_cycle": "vibration",
    "linearize_along": "operating",
    "linearize_grid": "operating",
    "load_plant_fit": "fitting",
    "load_problem": "planning",
    "margins": "control",
    "margins_over": "control",
    "mode_map": "control",
    "modes": "operating",
    "muscle_characteristic": "control",
    "muscle_names": "muscles",
    "muscle_volume": "gas",
    "own_law": "laws",
    "pid_controller": "control",
    "plot_costates": "figures",
    "polynomial_law": "laws",
    "pressures_of": "operating",
    "save_input_table": "export",
    "scheduled_lqr": "control",
    "spline_law": "laws",
    "stability_path": "vibration",
    "state_feedback_controller": "control",
    "stroke_work": "simulation",
    "sweep": "simulation",
    "tvlqr": "control",
}
"""{name that was here before: its subpackage}."""

sys.meta_path.append(
    MovedModules(
        __name__,
        {
            "muscles.laws.thick_wall": "muscles.laws.braid",
            "muscles.muscle": "muscles.pneumatic_muscle",
            "planning.problem.profile": "judge.statement",
            "planning.problem.wording": "judge.statement",
            "plants.elastic": "plants.hanging",
        },
    )
)

_SINCE_0_3 = frozenset(
    {
        "EquilibriumError",
        "ForceTable",
        "OperatingPoint",
        "Plan",
        "PositionFeedback",
        "Shooting",
        "TIME",
        "animate_plan",
        "equilibria",
        "export_motion",
        "fit_branches",
        "load_problem",
    }
)
"""Those that version 0.2 still had here; the others moved before."""


def __getattr__(name: str) -> Any:
    if name not in _MOVED:
        return _loaded(name)
    room = _MOVED[name]
    since = "0.3" if name in _SINCE_0_3 else "0.2"
    warnings.warn(
        f"pam_ocp.{name} is pam_ocp.{room}.{name} since version {since}",
        DeprecationWarning,
        stacklevel=2,
    )
    return getattr(_loaded(room), name)
