"""Export of a plant as an FMU, and its check."""

from .check import FmuCheck, check_fmu
from .compile import PLATFORMS
from .motion import export_motion, save_input_table
from .package import export_fmu
from .ssp import export_ssp, pid_controller

__all__ = [
    "PLATFORMS",
    "FmuCheck",
    "check_fmu",
    "export_fmu",
    "export_motion",
    "export_ssp",
    "pid_controller",
    "save_input_table",
]
