# Names of pam_ocp.muscles.laws, loaded at their first use.
from ..law import LAWS as LAWS
from ..law import ForceLaw as ForceLaw
from ..law import SixParameterLaw as SixParameterLaw
from ..law import coefficient as coefficient
from .braid import CorrectedLaw as CorrectedLaw
from .braid import GeometricLaw as GeometricLaw
from .empirical import FiveParameterLaw as FiveParameterLaw
from .empirical import HildebrandtLaw as HildebrandtLaw
from .empirical import LengthScaledLaw as LengthScaledLaw
from .empirical import ThreeElementLaw as ThreeElementLaw
from .empirical import TwoSlopeThreeElementLaw as TwoSlopeThreeElementLaw
from .thick_wall import ThickWallLaw as ThickWallLaw
from .user_defined import own_law as own_law
from .user_defined import polynomial_law as polynomial_law
from .user_defined import spline_law as spline_law
