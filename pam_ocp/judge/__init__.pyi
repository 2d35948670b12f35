# Names of pam_ocp.judge, loaded at their first use.
from .loop import LoopVerdict as LoopVerdict
from .loop import judge_loop as judge_loop
from .motion import Finding as Finding
from .motion import Judgement as Judgement
from .motion import Motion as Motion
from .motion import Verdict as Verdict
from .motion import judge as judge
from .statement import Statement as Statement
