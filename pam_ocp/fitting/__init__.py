"""Fit: from measurements to parameters."""

from .dynamic.dynamic import fit_plant
from .dynamic.plant_fit import PlantFit
from .static.bootstrap import Bootstrap
from .static.force_fit import ForceFit
from .static.ranking import ComparedLaw, LawComparison, compare_laws
from .static.static import fit_force
from .statistics import Coefficient, Prediction, SolverStatistics
from .tables.force_table import ForceTable, read_table
from .tables.records import read_record, read_records

__all__ = [
    "Bootstrap",
    "Coefficient",
    "ComparedLaw",
    "ForceFit",
    "ForceTable",
    "LawComparison",
    "PlantFit",
    "Prediction",
    "SolverStatistics",
    "compare_laws",
    "fit_force",
    "fit_plant",
    "read_record",
    "read_records",
    "read_table",
]
