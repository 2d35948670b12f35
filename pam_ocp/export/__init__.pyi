# Names of pam_ocp.export, loaded at their first use.
from .c_code.package import export_c as export_c
from .check import FmuCheck as FmuCheck
from .check import check_fmu as check_fmu
from .compile import PLATFORMS as PLATFORMS
from .motion import export_motion as export_motion
from .motion import save_input_table as save_input_table
from .package import export_fmu as export_fmu
from .package import export_muscle as export_muscle
from .ssp import export_ssp as export_ssp
from .ssv import save_ssv as save_ssv
from .worlds.jax_world import JaxBlock as JaxBlock
from .worlds.jax_world import JaxPlant as JaxPlant
from .worlds.jax_world import JaxStepper as JaxStepper
from .worlds.jax_world import to_jax as to_jax
from .worlds.modelica import export_modelica as export_modelica
from .worlds.mujoco_world import MujocoMuscle as MujocoMuscle
from .worlds.mujoco_world import MujocoMuscles as MujocoMuscles
from .worlds.mujoco_world import export_mjcf as export_mjcf
from .worlds.mujoco_world import mujoco_limb as mujoco_limb
from .worlds.mujoco_world import to_mujoco as to_mujoco
from .worlds.onnx_world import to_onnx as to_onnx
from .worlds.registry import WORLDS as WORLDS
from .worlds.registry import export as export
from .worlds.torch_world import to_torch as to_torch

def __call__(*args: object, **kwargs: object) -> object: ...
