"""Export of a plant as an FMU, and its check."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.lazy import lazily

if TYPE_CHECKING:
    from .check import FmuCheck as FmuCheck
    from .check import check_fmu as check_fmu
    from .compile import PLATFORMS as PLATFORMS
    from .motion import export_motion as export_motion
    from .motion import save_input_table as save_input_table
    from .package import export_fmu as export_fmu
    from .ssp import export_ssp as export_ssp

__all__ = [
    "PLATFORMS",
    "FmuCheck",
    "check_fmu",
    "export_fmu",
    "export_motion",
    "export_ssp",
    "save_input_table",
]

_HOMES = {
    "FmuCheck": "check",
    "PLATFORMS": "compile",
    "check_fmu": "check",
    "export_fmu": "package",
    "export_motion": "motion",
    "export_ssp": "ssp",
    "save_input_table": "motion",
}

__getattr__, __dir__ = lazily(__name__, __name__, _HOMES)
