# Names of pam_ocp.muscles, loaded at their first use.
from . import gas as gas
from . import laws as laws
from .catalogue import Attribution as Attribution
from .catalogue import attribution as attribution
from .catalogue import muscle as muscle
from .catalogue import muscle_names as muscle_names
from .heat import ConstantHeatTransfer as ConstantHeatTransfer
from .heat import PressureHeatTransfer as PressureHeatTransfer
from .heat import Rubber as Rubber
from .muscle_file import load_muscle as load_muscle
from .muscle_file import save_muscle as save_muscle
from .pneumatic_muscle import Muscle as Muscle
from .pneumatic_muscle import in_parallel as in_parallel
from .validity import ValidityWarning as ValidityWarning
