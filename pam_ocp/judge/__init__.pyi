# Names of pam_ocp.judge, loaded at their first use.
from .statement import Statement as Statement
