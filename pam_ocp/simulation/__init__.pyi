# Names of pam_ocp.simulation, loaded at their first use.
from ..core.trajectory import Comparison as Comparison
from .compare import RecordComparison as RecordComparison
from .compare import compare_with_record as compare_with_record
from .instruments import Instrument as Instrument
from .instruments import measured as measured
from .kept import KeptNumbers as KeptNumbers
from .many import ManySimulations as ManySimulations
from .many import draws as draws
from .many import simulate_many as simulate_many
from .many import sweep as sweep
from .simulator import simulate as simulate
from .statistics import SobolCases as SobolCases
from .statistics import SobolIndices as SobolIndices
from .statistics import Statistic as Statistic
from .work import StrokeWork as StrokeWork
from .work import stroke_work as stroke_work
