# Names of pam_ocp.operating, loaded at their first use.
from .allocation import Allocation as Allocation
from .allocation import AllocationError as AllocationError
from .allocation import common_and_difference as common_and_difference
from .allocation import pressures_of as pressures_of
from .branch import equilibrium_branch as equilibrium_branch
from .linear import linearize as linearize
from .linear import linearize_along as linearize_along
from .linear import linearize_grid as linearize_grid
from .linear import modes as modes
from .moments import StaticOptimisation as StaticOptimisation
from .moments import static_optimisation as static_optimisation
from .nlsys import as_nlsys as as_nlsys
from .operating_point import OperatingPoint as OperatingPoint
from .resting_point import EquilibriumError as EquilibriumError
from .resting_point import equilibrium as equilibrium
from .several import equilibria as equilibria
from .several import equilibrium_path as equilibrium_path
