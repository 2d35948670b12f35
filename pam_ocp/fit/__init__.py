"""Fit: from measurements to parameters."""

from .bootstrap import Bootstrap
from .compare import ComparedLaw, LawComparison, compare_laws
from .dynamic import fit_plant
from .force_fit import ForceFit
from .plant_fit import PlantFit
from .records import read_record, read_records
from .static import fit_force
from .statistics import Coefficient, Prediction, SolverStatistics
from .tables import ForceTable, read_table

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
