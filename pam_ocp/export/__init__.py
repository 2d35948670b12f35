"""Export of a plant as an FMU, and its check."""

from .check import FmuCheck, check_fmu
from .compile import PLATFORMS
from .controllers import pid_controller, state_feedback_controller
from .motion import export_motion, save_input_table
from .package import export_fmu
from .ssp import export_ssp

__all__ = [
    "PLATFORMS",
    "FmuCheck",
    "check_fmu",
    "export_fmu",
    "export_motion",
    "export_ssp",
    "pid_controller",
    "save_input_table",
    "state_feedback_controller",
]
