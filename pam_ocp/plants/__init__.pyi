# Names of pam_ocp.plants, loaded at their first use.
from . import feeds as feeds
from . import loads as loads
from . import losses as losses
from .alone import muscle_alone as muscle_alone
from .elastic import SeriesLoad as SeriesLoad
from .elastic import SpringOverMuscle as SpringOverMuscle
from .hanging import HangingLoad as HangingLoad
from .inversion import Inversion as Inversion
from .joint import AntagonisticJoint as AntagonisticJoint
from .plant import Plant as Plant
from .plant_data import save_plant as save_plant
from .plant_file import load_plant as load_plant
from .regulated import PositionFeedback as PositionFeedback
from .regulated import RegulatedLoad as RegulatedLoad
from .sensors import Sensor as Sensor
from .slide import AntagonisticSlide as AntagonisticSlide
from .undelayed import without_dead_times as without_dead_times
