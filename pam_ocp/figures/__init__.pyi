# Names of pam_ocp.figures, loaded at their first use.
from .canvas import new_figure as new_figure
from .crate import save_crate as save_crate
from .film import animate_plan as animate_plan
from .paper import for_paper as for_paper
from .plan import plot_costates as plot_costates
from .report import write_report as write_report
