"""The door: how a noun's courtesy methods (``.plot()``, ``Plant.equilibrium()``) reach rooms above.

Rooms import downwards only (docs/architecture.md). A method that is there for the user's
convenience, and whose work is done higher up, forwards to a name of this module::

    def plot(self) -> Figure:
        return courtesy.plot_plan(self)

The module that does the work is loaded at the first call. No other module may import upwards, and
nothing but a method may use a name from here; tests/package/test_architecture.py keeps both.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from .core.lazy import lazily

if TYPE_CHECKING:
    from .control.blocks.running import block as block
    from .control.loop import ClosedLoop as ClosedLoop
    from .control.loop import closed_loop as closed_loop
    from .export.machine import MachinePlant as MachinePlant
    from .export.machine import machine_plant as machine_plant
    from .export.ssv import save_ssv as save_ssv
    from .export.ssv import write_muscle_ssv as write_muscle_ssv
    from .figures.control import plot_closed_loop as plot_closed_loop
    from .figures.control import plot_durations as plot_durations
    from .figures.film import animate_limb as animate_limb
    from .figures.film import plot_limb as plot_limb
    from .figures.fit_book import write_fit_book as write_fit_book
    from .figures.plan import plot_pareto as plot_pareto
    from .figures.plan import plot_plan as plot_plan
    from .figures.plan import plot_robust as plot_robust
    from .figures.sheets import html_of as html_of
    from .figures.tables import frame_of as frame_of
    from .figures.tables import plot_table as plot_table
    from .figures.tables import report_of as report_of
    from .figures.tables import save_result as save_result
    from .figures.trajectory import plot_fit as plot_fit
    from .figures.trajectory import plot_fit_surface as plot_fit_surface
    from .figures.trajectory import plot_muscle as plot_muscle
    from .figures.trajectory import plot_record as plot_record
    from .figures.trajectory import plot_records as plot_records
    from .figures.trajectory import plot_surface as plot_surface
    from .figures.trajectory import plot_trajectory as plot_trajectory
    from .figures.vibration import plot_amplitude_map as plot_amplitude_map
    from .figures.vibration import plot_backbone as plot_backbone
    from .figures.vibration import plot_border as plot_border
    from .figures.vibration import plot_branch as plot_branch
    from .figures.vibration import plot_energy as plot_energy
    from .figures.vibration import plot_envelope as plot_envelope
    from .figures.vibration import plot_hopf_map as plot_hopf_map
    from .figures.vibration import plot_multipliers as plot_multipliers
    from .figures.vibration import plot_phase as plot_phase
    from .figures.vibration import plot_stability as plot_stability
    from .figures.workbook import write_motion_book as write_motion_book
    from .figures.workbook import write_plan_book as write_plan_book
    from .figures.workbook import write_plant_fit_book as write_plant_fit_book
    from .fitting.dynamic.estimation import validate as validate
    from .operating.linear import linearize as linearize
    from .operating.moments import StaticOptimisation as StaticOptimisation
    from .operating.moments import static_optimisation as static_optimisation
    from .operating.resting_point import OperatingPoint as OperatingPoint
    from .operating.resting_point import equilibrium as equilibrium
    from .planning.active import arcs_along as arcs_along
    from .planning.saved_plan import save_plan as save_plan
    from .rig.homing import Homing as Homing
    from .rig.homing import home as home
    from .rig.learning import Identified as Identified
    from .rig.learning import Learned as Learned
    from .rig.learning import identify as identify
    from .rig.learning import learn as learn
    from .rig.real_time import RealTimeRun as RealTimeRun
    from .rig.real_time import run_in_c as run_in_c
    from .rig.side import RigSide as RigSide
    from .rig.side import run_on as run_on
    from .rig.tuning import Tuned as Tuned
    from .rig.tuning import tune as tune

_HOMES: dict[str, str] = {
    "block": "control.blocks.running",
    "closed_loop": "control.loop",
    "equilibrium": "operating.resting_point",
    "plot_fit_surface": "figures.trajectory",
    "plot_surface": "figures.trajectory",
    "frame_of": "figures.tables",
    "plot_table": "figures.tables",
    "report_of": "figures.tables",
    "save_result": "figures.tables",
    "home": "rig.homing",
    "html_of": "figures.sheets",
    "identify": "rig.learning",
    "learn": "rig.learning",
    "run_in_c": "rig.real_time",
    "run_on": "rig.side",
    "RigSide": "rig.side",
    "tune": "rig.tuning",
    "machine_plant": "export.machine",
    "linearize": "operating.linear",
    "plot_amplitude_map": "figures.vibration",
    "plot_backbone": "figures.vibration",
    "plot_border": "figures.vibration",
    "plot_branch": "figures.vibration",
    "plot_closed_loop": "figures.control",
    "plot_durations": "figures.control",
    "plot_energy": "figures.vibration",
    "plot_envelope": "figures.vibration",
    "plot_fit": "figures.trajectory",
    "plot_hopf_map": "figures.vibration",
    "plot_multipliers": "figures.vibration",
    "plot_muscle": "figures.trajectory",
    "plot_pareto": "figures.plan",
    "plot_phase": "figures.vibration",
    "plot_plan": "figures.plan",
    "plot_record": "figures.trajectory",
    "plot_records": "figures.trajectory",
    "plot_robust": "figures.plan",
    "plot_stability": "figures.vibration",
    "plot_trajectory": "figures.trajectory",
    "static_optimisation": "operating.moments",
    "plot_limb": "figures.film",
    "animate_limb": "figures.film",
    "arcs_along": "planning.active",
    "save_plan": "planning.saved_plan",
    "save_ssv": "export.ssv",
    "validate": "fitting.dynamic.estimation",
    "write_fit_book": "figures.fit_book",
    "write_motion_book": "figures.workbook",
    "write_plan_book": "figures.workbook",
    "write_plant_fit_book": "figures.workbook",
    "write_muscle_ssv": "export.ssv",
}
"""Module in which each name stands; types for annotations are not among them."""

__getattr__, __dir__ = lazily(__name__, __package__, _HOMES)
