# What pam_ocp/__init__.py loads lazily, for type checkers and completion; a test compares the two.

from .control.analysis import (
    along_stroke as along_stroke,
)
from .control.analysis import (
    bode_cloud as bode_cloud,
)
from .control.analysis import (
    margins as margins,
)
from .control.analysis import (
    margins_over as margins_over,
)
from .control.analysis import (
    mode_map as mode_map,
)
from .control.controller_plants import (
    pid_controller as pid_controller,
)
from .control.controller_plants import (
    state_feedback_controller as state_feedback_controller,
)
from .control.describing import (
    DescribingFunction as DescribingFunction,
)
from .control.describing import (
    describing_function as describing_function,
)
from .control.describing import (
    muscle_characteristic as muscle_characteristic,
)
from .control.estimators.extended_kalman import (
    KalmanFilter as KalmanFilter,
)
from .control.estimators.moving_horizon import (
    MovingHorizonEstimator as MovingHorizonEstimator,
)
from .control.estimators.stationary import (
    WithEstimate as WithEstimate,
)
from .control.estimators.stationary import (
    kalman as kalman,
)
from .control.inverse import (
    InverseDynamics as InverseDynamics,
)
from .control.loop import (
    closed_loop as closed_loop,
)
from .control.linear_quadratic import (
    lqr as lqr,
)
from .control.mpc.mpc import (
    Mpc as Mpc,
)
from .control.offset_free import (
    OffsetFree as OffsetFree,
)
from .control.pid import (
    PID as PID,
)
from .control.pid import (
    PositionController as PositionController,
)
from .control.pid import (
    PressureLoop as PressureLoop,
)
from .control.schedule import (
    scheduled_lqr as scheduled_lqr,
)
from .control.along_motion import (
    OpenLoop as OpenLoop,
)
from .control.along_motion import (
    tvlqr as tvlqr,
)
from .core.errors import (
    ExportError as ExportError,
)
from .core.errors import (
    FitError as FitError,
)
from .core.errors import (
    InputError as InputError,
)
from .core.errors import (
    PamError as PamError,
)
from .core.errors import (
    PlanError as PlanError,
)
from .core.errors import (
    PlanWarning as PlanWarning,
)
from .core.errors import (
    SimulationError as SimulationError,
)
from .core.errors import (
    UnknownNameError as UnknownNameError,
)
from .core.errors import (
    VibrationError as VibrationError,
)
from .core.plausible import (
    UnitWarning as UnitWarning,
)
from .core.trajectory import (
    Comparison as Comparison,
)
from .core.trajectory import (
    Trajectory as Trajectory,
)
from .core.variables import (
    Variable as Variable,
)
from .export.check import (
    check_fmu as check_fmu,
)
from .export.motion import (
    export_motion as export_motion,
)
from .export.motion import (
    save_input_table as save_input_table,
)
from .export.package import (
    export_fmu as export_fmu,
)
from .export.ssp import (
    export_ssp as export_ssp,
)
from .figures.film import (
    animate_plan as animate_plan,
)
from .figures.plan import (
    plot_costates as plot_costates,
)
from .fitting.dynamic.dynamic import (
    fit_plant as fit_plant,
)
from .fitting.dynamic.free_run_fit import (
    FreeRun as FreeRun,
)
from .fitting.dynamic.free_run_fit import (
    FreeRunFit as FreeRunFit,
)
from .fitting.dynamic.free_run_fit import (
    fit_free_run as fit_free_run,
)
from .fitting.dynamic.free_run_fit import (
    free_run as free_run,
)
from .fitting.dynamic.plant_fit import (
    PlantFit as PlantFit,
)
from .fitting.dynamic.saved_plant import (
    load_plant_fit as load_plant_fit,
)
from .fitting.experiments.cells import (
    CellDesign as CellDesign,
)
from .fitting.experiments.experiments import (
    design_cells as design_cells,
)
from .fitting.experiments.experiments import (
    design_experiment as design_experiment,
)
from .fitting.experiments.experiments import (
    design_signal as design_signal,
)
from .fitting.experiments.signals import (
    SignalDesign as SignalDesign,
)
from .fitting.static.branches import (
    Hysteresis as Hysteresis,
)
from .fitting.static.branches import (
    LackOfFit as LackOfFit,
)
from .fitting.static.branches import (
    hysteresis as hysteresis,
)
from .fitting.static.branches import (
    lack_of_fit as lack_of_fit,
)
from .fitting.static.ranking import (
    LawComparison as LawComparison,
)
from .fitting.static.ranking import (
    compare_laws as compare_laws,
)
from .fitting.static.shared import (
    JointForceFit as JointForceFit,
)
from .fitting.static.shared import (
    fit_forces as fit_forces,
)
from .fitting.static.static import (
    ForceFit as ForceFit,
)
from .fitting.static.static import (
    fit_branches as fit_branches,
)
from .fitting.static.static import (
    fit_force as fit_force,
)
from .fitting.tables.force_table import (
    ForceTable as ForceTable,
)
from .fitting.tables.force_table import (
    read_table as read_table,
)
from .fitting.tables.records import (
    read_record as read_record,
)
from .fitting.tables.records import (
    read_records as read_records,
)
from .muscles.catalogue import (
    muscle as muscle,
)
from .muscles.catalogue import (
    muscle_names as muscle_names,
)
from .muscles.gas import (
    BraidVolume as BraidVolume,
)
from .muscles.gas import (
    ConsistentVolume as ConsistentVolume,
)
from .muscles.gas import (
    Gas as Gas,
)
from .muscles.gas import (
    PolynomialVolume as PolynomialVolume,
)
from .muscles.gas import (
    closed_stiffness as closed_stiffness,
)
from .muscles.gas import (
    conductance_from_flow as conductance_from_flow,
)
from .muscles.gas import (
    iso6358 as iso6358,
)
from .muscles.gas import (
    muscle_volume as muscle_volume,
)
from .muscles.law import (
    LAWS as LAWS,
)
from .muscles.law import (
    ForceLaw as ForceLaw,
)
from .muscles.law import (
    SixParameterLaw as SixParameterLaw,
)
from .muscles.law import (
    coefficient as coefficient,
)
from .muscles.laws.braid import (
    CorrectedLaw as CorrectedLaw,
)
from .muscles.laws.braid import (
    GeometricLaw as GeometricLaw,
)
from .muscles.laws.empirical import (
    FiveParameterLaw as FiveParameterLaw,
)
from .muscles.laws.empirical import (
    HildebrandtLaw as HildebrandtLaw,
)
from .muscles.laws.empirical import (
    LengthScaledLaw as LengthScaledLaw,
)
from .muscles.laws.empirical import (
    ThreeElementLaw as ThreeElementLaw,
)
from .muscles.laws.empirical import (
    TwoSlopeThreeElementLaw as TwoSlopeThreeElementLaw,
)
from .muscles.laws.thick_wall import (
    ThickWallLaw as ThickWallLaw,
)
from .muscles.laws.user_defined import (
    own_law as own_law,
)
from .muscles.laws.user_defined import (
    polynomial_law as polynomial_law,
)
from .muscles.laws.user_defined import (
    spline_law as spline_law,
)
from .muscles.pneumatic_muscle import (
    Muscle as Muscle,
)
from .muscles.muscle_file import (
    load_muscle as load_muscle,
)
from .muscles.muscle_file import (
    save_muscle as save_muscle,
)
from .muscles.validity import (
    ValidityWarning as ValidityWarning,
)
from .operating.allocation import (
    Allocation as Allocation,
)
from .operating.allocation import (
    AllocationError as AllocationError,
)
from .operating.allocation import (
    common_and_difference as common_and_difference,
)
from .operating.allocation import (
    pressures_of as pressures_of,
)
from .operating.along import (
    stability_path as stability_path,
)
from .operating.branch import (
    equilibrium_branch as equilibrium_branch,
)
from .operating.resting_point import (
    EquilibriumError as EquilibriumError,
)
from .operating.resting_point import (
    OperatingPoint as OperatingPoint,
)
from .operating.resting_point import (
    equilibrium as equilibrium,
)
from .operating.linear import (
    linearize as linearize,
)
from .operating.linear import (
    linearize_along as linearize_along,
)
from .operating.linear import (
    linearize_grid as linearize_grid,
)
from .operating.linear import (
    modes as modes,
)
from .operating.nlsys import (
    as_nlsys as as_nlsys,
)
from .operating.several import (
    equilibria as equilibria,
)
from .operating.several import (
    equilibrium_path as equilibrium_path,
)
from .planning.planner import (
    Planner as Planner,
)
from .planning.planner import (
    plan as plan,
)
from .planning.problem.problem import (
    TIME as TIME,
)
from .planning.problem.problem_file import (
    load_problem as load_problem,
)
from .planning.problem.profile import (
    Profile as Profile,
)
from .planning.problem.wording import (
    Avoid as Avoid,
)
from .planning.problem.wording import (
    Constraint as Constraint,
)
from .planning.problem.wording import (
    Phase as Phase,
)
from .planning.problem.wording import (
    Stop as Stop,
)
from .planning.result import (
    Plan as Plan,
)
from .planning.saved_plan import (
    load_plan as load_plan,
)
from .planning.studies.front import (
    Pareto as Pareto,
)
from .planning.studies.front import (
    pareto as pareto,
)
from .planning.studies.robust import (
    RobustPlan as RobustPlan,
)
from .planning.studies.robust import (
    robust_plan as robust_plan,
)
from .planning.studies.spread import (
    Spread as Spread,
)
from .planning.transcription.mesh import (
    Collocation as Collocation,
)
from .planning.transcription.mesh import (
    Shooting as Shooting,
)
from .planning.verdict import (
    Verdict as Verdict,
)
from .plants.elastic import (
    SeriesLoad as SeriesLoad,
)
from .plants.elastic import (
    SpringOverMuscle as SpringOverMuscle,
)
from .plants.feeds import (
    IdealPressure as IdealPressure,
)
from .plants.feeds import (
    Regulator as Regulator,
)
from .plants.hanging import (
    HangingLoad as HangingLoad,
)
from .plants.inversion import (
    Inversion as Inversion,
)
from .plants.joint import (
    AntagonisticJoint as AntagonisticJoint,
)
from .plants.loads import (
    Damper as Damper,
)
from .plants.loads import (
    DryFriction as DryFriction,
)
from .plants.loads import (
    ExternalForce as ExternalForce,
)
from .plants.loads import (
    Inertia as Inertia,
)
from .plants.loads import (
    Spring as Spring,
)
from .plants.loads import (
    Wall as Wall,
)
from .plants.damping import (
    ConstantDamping as ConstantDamping,
)
from .plants.damping import (
    CoulombFriction as CoulombFriction,
)
from .plants.damping import (
    DirectionalDamping as DirectionalDamping,
)
from .plants.damping import (
    StiffnessDamping as StiffnessDamping,
)
from .plants.memory import (
    BoucWen as BoucWen,
)
from .plants.memory import (
    Creep as Creep,
)
from .plants.memory import (
    MaxwellSlip as MaxwellSlip,
)
from .plants.plant import (
    Plant as Plant,
)
from .plants.regulated import (
    PositionFeedback as PositionFeedback,
)
from .plants.regulated import (
    RegulatedLoad as RegulatedLoad,
)
from .plants.slide import (
    AntagonisticSlide as AntagonisticSlide,
)
from .plants.valves import (
    OnOffValves as OnOffValves,
)
from .plants.valves import (
    SpoolValve as SpoolValve,
)
from .plants.valves import (
    Tube as Tube,
)
from .simulation.compare import (
    RecordComparison as RecordComparison,
)
from .simulation.compare import (
    compare_with_record as compare_with_record,
)
from .simulation.many import (
    ManySimulations as ManySimulations,
)
from .simulation.many import (
    draws as draws,
)
from .simulation.many import (
    simulate_many as simulate_many,
)
from .simulation.many import (
    sweep as sweep,
)
from .simulation.simulator import (
    simulate as simulate,
)
from .simulation.work import (
    StrokeWork as StrokeWork,
)
from .simulation.work import (
    stroke_work as stroke_work,
)
from .studies.loads import (
    LoadStudy as LoadStudy,
)
from .studies.loads import (
    load_study as load_study,
)
from .vibration.cycle import (
    limit_cycle as limit_cycle,
)
from .vibration.cycle_branch import (
    continue_cycle as continue_cycle,
)
from .vibration.energy_balance import (
    energy as energy,
)
from .vibration.free import (
    backbone as backbone,
)
from .vibration.free import (
    free_vibration as free_vibration,
)
from .vibration.hopf_bifurcation import (
    hopf as hopf,
)
from .vibration.hopf_bifurcation import (
    hopf_border as hopf_border,
)

__version__: str

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
