"""Export of a plant as an FMU, and its check."""

from .check import FmuCheck, check_fmu
from .compile import PLATFORMS
from .package import export_fmu

__all__ = ["PLATFORMS", "FmuCheck", "check_fmu", "export_fmu"]
