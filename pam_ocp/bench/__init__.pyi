# Names of pam_ocp.bench, loaded at their first use.
from .server import serve as serve
from .session import Session as Session
