# Names of pam_ocp.bench, loaded at their first use.
from .serve import serve as serve
from .session import Session as Session
