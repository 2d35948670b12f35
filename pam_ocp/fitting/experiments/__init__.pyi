# Names of pam_ocp.fitting.experiments, loaded at their first use.
from .cells import CellDesign as CellDesign
from .cells import design_cells as design_cells
from .excitation import GapSignal as GapSignal
from .signals import SignalDesign as SignalDesign
from .signals import design_experiment as design_experiment
from .signals import design_signal as design_signal
