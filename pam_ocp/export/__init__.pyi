# Names of pam_ocp.export, loaded at their first use.
from .c_code.package import export_c as export_c
from .check import FmuCheck as FmuCheck
from .check import check_fmu as check_fmu
from .compile import PLATFORMS as PLATFORMS
from .motion import export_motion as export_motion
from .motion import save_input_table as save_input_table
from .package import export_fmu as export_fmu
from .ssp import export_ssp as export_ssp
from .ssv import save_ssv as save_ssv
