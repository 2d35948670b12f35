"""pam_ocp: pneumatic artificial muscles, from a measured table to a verified optimal motion and an FMU.

Three nouns (Muscle, Plant, Trajectory) and five verbs (simulate, fit, plan, linearize, export)
around one symbolic CasADi model. SI units inside; pressures are gauge; contraction is a fraction.
"""

from __future__ import annotations

from .animate import animate_plan
from .design.analysis import along_stroke, bode_cloud, margins, margins_over, mode_map
from .design.branch import equilibrium_branch
from .design.closed_loop import closed_loop
from .design.describing import DescribingFunction, describing_function, muscle_characteristic
from .design.inverse import InverseDynamics
from .design.kalman import WithEstimate, kalman
from .design.lqr import lqr
from .design.offset_free import OffsetFree
from .design.pid import PID, PositionController, PressureLoop
from .design.rest import equilibria, equilibrium_path
from .design.schedule import scheduled_lqr
from .design.tvlqr import OpenLoop, tvlqr
from .equilibrium import EquilibriumError, OperatingPoint, equilibrium
from .errors import (
    ExportError,
    FitError,
    InputError,
    PamError,
    PlanError,
    PlanWarning,
    SimulationError,
    UnknownNameError,
)
from .fit.branches import Hysteresis, LackOfFit, fit_branches, hysteresis, lack_of_fit
from .fit.compare import LawComparison, compare_laws
from .fit.design import CellDesign
from .fit.dynamic import fit_plant
from .fit.experiment_design import design_cells, design_experiment, design_signal
from .fit.free_run import FreeRun, FreeRunFit, fit_free_run, free_run
from .fit.plant_fit import PlantFit
from .fit.records import read_record, read_records
from .fit.saved_plant import load_plant_fit
from .fit.shared import JointForceFit, fit_forces
from .fit.signal_design import SignalDesign
from .fit.static import ForceFit, fit_force
from .fit.tables import ForceTable, read_table
from .fmu import (
    check_fmu,
    export_fmu,
    export_motion,
    export_ssp,
    pid_controller,
    save_input_table,
    state_feedback_controller,
)
from .linear import linearize, linearize_along, linearize_grid, modes
from .load_study import LoadStudy, load_study
from .many import ManySimulations, draws, simulate_many, sweep
from .muscle.braid import CorrectedLaw, GeometricLaw
from .muscle.catalogue import muscle, muscle_names
from .muscle.empirical import (
    FiveParameterLaw,
    HildebrandtLaw,
    LengthScaledLaw,
    ThreeElementLaw,
    TwoSlopeThreeElementLaw,
)
from .muscle.force import LAWS, ForceLaw, SixParameterLaw, coefficient
from .muscle.free import own_law, polynomial_law, spline_law
from .muscle.gas import (
    BraidVolume,
    ConsistentVolume,
    Gas,
    PolynomialVolume,
    closed_stiffness,
    conductance_from_flow,
    iso6358,
    muscle_volume,
)
from .muscle.hysteresis import BoucWen, Creep, MaxwellSlip
from .muscle.losses import ConstantDamping, CoulombFriction, DirectionalDamping, StiffnessDamping
from .muscle.muscle import Muscle
from .muscle.muscle_file import load_muscle, save_muscle
from .muscle.validity import ValidityWarning
from .muscle.valves import OnOffValves, SpoolValve, Tube
from .muscle.wall import ThickWallLaw
from .nlsys import as_nlsys
from .plan.estimate import KalmanFilter
from .plan.mesh import Collocation, Shooting
from .plan.moving_horizon import MovingHorizonEstimator
from .plan.mpc import Mpc
from .plan.pareto import Pareto, pareto
from .plan.problem import TIME
from .plan.problem_file import load_problem
from .plan.profile import Profile
from .plan.result import Plan
from .plan.robust import RobustPlan, robust_plan
from .plan.saved import load_plan
from .plan.solve import Planner, plan
from .plan.spread import Spread
from .plan.verdict import Verdict
from .plan.wording import Avoid, Constraint, Phase, Stop
from .plant.actuator import IdealPressure, Regulator
from .plant.allocation import Allocation, AllocationError, common_and_difference, pressures_of
from .plant.antagonist import AntagonisticSlide
from .plant.elastic import SeriesLoad, SpringOverMuscle
from .plant.joint import AntagonisticJoint
from .plant.loads import Damper, DryFriction, ExternalForce, Inertia, Spring, Wall
from .plant.opening import Inversion
from .plant.plant import Plant
from .plant.regulated import PositionFeedback, RegulatedLoad
from .plant.single import HangingLoad
from .plausible import UnitWarning
from .plot_plan import plot_costates
from .simulate import simulate
from .trajectory import Comparison, Trajectory
from .validation import RecordComparison, compare_with_record
from .variables import Variable
from .vibration import (
    VibrationError,
    backbone,
    continue_cycle,
    energy,
    free_vibration,
    hopf,
    hopf_border,
    limit_cycle,
    stability_path,
)
from .work import StrokeWork, stroke_work

__version__ = "0.1.0"

__all__ = [
    "LAWS",
    "PID",
    "TIME",
    "Allocation",
    "AllocationError",
    "AntagonisticJoint",
    "AntagonisticSlide",
    "Avoid",
    "BoucWen",
    "BraidVolume",
    "CellDesign",
    "Collocation",
    "Comparison",
    "ConsistentVolume",
    "ConstantDamping",
    "Constraint",
    "CorrectedLaw",
    "CoulombFriction",
    "Creep",
    "Damper",
    "DescribingFunction",
    "DirectionalDamping",
    "DryFriction",
    "EquilibriumError",
    "ExportError",
    "ExternalForce",
    "FitError",
    "FiveParameterLaw",
    "ForceFit",
    "ForceLaw",
    "ForceTable",
    "FreeRun",
    "FreeRunFit",
    "Gas",
    "GeometricLaw",
    "HangingLoad",
    "HildebrandtLaw",
    "Hysteresis",
    "IdealPressure",
    "Inertia",
    "InputError",
    "InverseDynamics",
    "Inversion",
    "JointForceFit",
    "KalmanFilter",
    "LackOfFit",
    "LawComparison",
    "LengthScaledLaw",
    "LoadStudy",
    "ManySimulations",
    "MaxwellSlip",
    "MovingHorizonEstimator",
    "Mpc",
    "Muscle",
    "OffsetFree",
    "OnOffValves",
    "OpenLoop",
    "OperatingPoint",
    "PamError",
    "Pareto",
    "Phase",
    "Plan",
    "PlanError",
    "PlanWarning",
    "Planner",
    "Plant",
    "PlantFit",
    "PolynomialVolume",
    "PositionController",
    "PositionFeedback",
    "PressureLoop",
    "Profile",
    "RecordComparison",
    "RegulatedLoad",
    "Regulator",
    "RobustPlan",
    "SeriesLoad",
    "Shooting",
    "SignalDesign",
    "SimulationError",
    "SixParameterLaw",
    "SpoolValve",
    "Spread",
    "Spring",
    "SpringOverMuscle",
    "StiffnessDamping",
    "Stop",
    "StrokeWork",
    "ThickWallLaw",
    "ThreeElementLaw",
    "Trajectory",
    "Tube",
    "TwoSlopeThreeElementLaw",
    "UnitWarning",
    "UnknownNameError",
    "ValidityWarning",
    "Variable",
    "Verdict",
    "VibrationError",
    "Wall",
    "WithEstimate",
    "along_stroke",
    "animate_plan",
    "as_nlsys",
    "backbone",
    "bode_cloud",
    "check_fmu",
    "closed_loop",
    "closed_stiffness",
    "coefficient",
    "common_and_difference",
    "compare_laws",
    "compare_with_record",
    "conductance_from_flow",
    "continue_cycle",
    "describing_function",
    "design_cells",
    "design_experiment",
    "design_signal",
    "draws",
    "energy",
    "equilibria",
    "equilibrium",
    "equilibrium_branch",
    "equilibrium_path",
    "export_fmu",
    "export_motion",
    "export_ssp",
    "fit_branches",
    "fit_force",
    "fit_forces",
    "fit_free_run",
    "fit_plant",
    "free_run",
    "free_vibration",
    "hopf",
    "hopf_border",
    "hysteresis",
    "iso6358",
    "kalman",
    "lack_of_fit",
    "limit_cycle",
    "linearize",
    "linearize_along",
    "linearize_grid",
    "load_muscle",
    "load_plan",
    "load_plant_fit",
    "load_problem",
    "load_study",
    "lqr",
    "margins",
    "margins_over",
    "mode_map",
    "modes",
    "muscle",
    "muscle_characteristic",
    "muscle_names",
    "muscle_volume",
    "own_law",
    "pareto",
    "pid_controller",
    "plan",
    "plot_costates",
    "polynomial_law",
    "pressures_of",
    "read_record",
    "read_records",
    "read_table",
    "robust_plan",
    "save_input_table",
    "save_muscle",
    "scheduled_lqr",
    "simulate",
    "simulate_many",
    "spline_law",
    "stability_path",
    "state_feedback_controller",
    "stroke_work",
    "sweep",
    "tvlqr",
]
