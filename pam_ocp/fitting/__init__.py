"""Fit: from measurements to parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.lazy import lazily

if TYPE_CHECKING:
    from .dynamic.dynamic import fit_plant as fit_plant
    from .dynamic.plant_fit import PlantFit as PlantFit
    from .static.bootstrap import Bootstrap as Bootstrap
    from .static.force_fit import ForceFit as ForceFit
    from .static.ranking import ComparedLaw as ComparedLaw
    from .static.ranking import LawComparison as LawComparison
    from .static.ranking import compare_laws as compare_laws
    from .static.static import fit_force as fit_force
    from .statistics import Coefficient as Coefficient
    from .statistics import Prediction as Prediction
    from .statistics import SolverStatistics as SolverStatistics
    from .tables.force_table import ForceTable as ForceTable
    from .tables.force_table import read_table as read_table
    from .tables.records import read_record as read_record
    from .tables.records import read_records as read_records

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

_HOMES = {
    "Bootstrap": "static.bootstrap",
    "Coefficient": "statistics",
    "ComparedLaw": "static.ranking",
    "ForceFit": "static.force_fit",
    "ForceTable": "tables.force_table",
    "LawComparison": "static.ranking",
    "PlantFit": "dynamic.plant_fit",
    "Prediction": "statistics",
    "SolverStatistics": "statistics",
    "compare_laws": "static.ranking",
    "fit_force": "static.static",
    "fit_plant": "dynamic.dynamic",
    "read_record": "tables.records",
    "read_records": "tables.records",
    "read_table": "tables.force_table",
}

__getattr__, __dir__ = lazily(__name__, __name__, _HOMES)
