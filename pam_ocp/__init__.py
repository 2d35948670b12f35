"""pam_ocp: pneumatic artificial muscles, from a measured table to a verified optimal motion and an FMU.

Three nouns (Muscle, Plant, Trajectory) and five verbs (simulate, fit, plan, linearize, export)
around one symbolic CasADi model. SI units inside; pressures are gauge; contraction is a fraction.
"""

from __future__ import annotations

from .equilibrium import EquilibriumError, OperatingPoint, equilibrium
from .errors import (
    ExportError,
    FitError,
    InputError,
    PamError,
    PlanError,
    SimulationError,
    UnknownNameError,
)
from .fit.static import ForceFit, fit_force
from .fit.tables import ForceTable, read_table
from .fmu import check_fmu, export_fmu
from .linear import linearize, modes
from .load_study import LoadStudy, load_study
from .many import ManySimulations, draws, simulate_many, sweep
from .muscle.catalogue import muscle, muscle_names
from .muscle.force import LAWS, ForceLaw, SixParameterLaw
from .muscle.losses import ConstantDamping, StiffnessDamping
from .muscle.muscle import Muscle
from .muscle.muscle_file import load_muscle, save_muscle
from .plan.mesh import Collocation
from .plan.solve import Plan, plan
from .plant.actuator import IdealPressure, Regulator
from .plant.allocation import Allocation, AllocationError, common_and_difference, pressures_of
from .plant.antagonist import AntagonisticSlide
from .plant.elastic import SeriesLoad, SpringOverMuscle
from .plant.joint import AntagonisticJoint
from .plant.loads import Damper, DryFriction, ExternalForce, Inertia, Spring, Wall
from .plant.plant import Plant
from .plant.single import HangingLoad
from .simulate import simulate
from .trajectory import Comparison, Trajectory
from .validation import RecordComparison, compare_with_record
from .variables import Variable

__version__ = "0.1.0"

__all__ = [
    "LAWS",
    "Allocation",
    "AllocationError",
    "AntagonisticJoint",
    "AntagonisticSlide",
    "Collocation",
    "Comparison",
    "ConstantDamping",
    "Damper",
    "DryFriction",
    "EquilibriumError",
    "ExportError",
    "ExternalForce",
    "FitError",
    "ForceFit",
    "ForceLaw",
    "ForceTable",
    "HangingLoad",
    "IdealPressure",
    "Inertia",
    "InputError",
    "LoadStudy",
    "ManySimulations",
    "Muscle",
    "OperatingPoint",
    "PamError",
    "Plan",
    "PlanError",
    "Plant",
    "RecordComparison",
    "Regulator",
    "SeriesLoad",
    "SimulationError",
    "SixParameterLaw",
    "Spring",
    "SpringOverMuscle",
    "StiffnessDamping",
    "Trajectory",
    "UnknownNameError",
    "Variable",
    "Wall",
    "check_fmu",
    "common_and_difference",
    "compare_with_record",
    "draws",
    "equilibrium",
    "export_fmu",
    "fit_force",
    "linearize",
    "load_muscle",
    "load_study",
    "modes",
    "muscle",
    "muscle_names",
    "plan",
    "pressures_of",
    "read_table",
    "save_muscle",
    "simulate",
    "simulate_many",
    "sweep",
]
