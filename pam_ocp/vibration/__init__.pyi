# Names of pam_ocp.vibration, loaded at their first use.
from ..core.exceptions import VibrationError as VibrationError
from ..operating.along import StabilityPath as StabilityPath
from ..operating.along import stability_path as stability_path
from .cycle import LimitCycle as LimitCycle
from .cycle import limit_cycle as limit_cycle
from .cycle_branch import CycleBranch as CycleBranch
from .cycle_branch import continue_cycle as continue_cycle
from .energy_balance import Energy as Energy
from .energy_balance import energy as energy
from .free import Backbone as Backbone
from .free import FreeVibration as FreeVibration
from .free import backbone as backbone
from .free import free_vibration as free_vibration
from .hopf_bifurcation import HopfBorder as HopfBorder
from .hopf_bifurcation import HopfPoint as HopfPoint
from .hopf_bifurcation import hopf as hopf
from .hopf_bifurcation import hopf_border as hopf_border
