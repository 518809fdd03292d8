from . import effects as effects
from .diagnosis.diagnose import diagnose as diagnose
from .diagnosis.planning import Plan as Plan, plan as plan
from .diagnosis.result import Diagnosis as Diagnosis
from .diagnosis.saved import load_effects as load_effects
from .effects.base import (
    ActuationEffect as ActuationEffect,
    DynamicsEffect as DynamicsEffect,
    Effect as Effect,
    Parameter as Parameter,
    SensingEffect as SensingEffect,
)
from .effects.camera import CameraEffect as CameraEffect
from .effects.catalogue import catalogue as catalogue
from .effects.residual import Residual as Residual
from .evaluation.scoring import score as score
from .films.filming import film as film
from .learning.joint import Adapted as Adapted
from .policies.base import Policy as Policy
from .recordings.episode import Episode as Episode, Recording as Recording
from .recordings.hdf5 import read_recording as read_recording, write_recording as write_recording
from .recordings.loading import load_recording as load_recording
from .setups.base import Setup as Setup
from .setups.onnx_file import export_policy as export_policy
from .setups.policy_file import load_policy as load_policy, load_source as load_source, save_policy as save_policy
from .setups.training import adapt as adapt, setup_for as setup_for, train as train
from .systems.base import System as System, Variable as Variable
from .systems.cartpole import CartPole as CartPole
from .systems.fixed_wing import FixedWing as FixedWing
from .systems.parameter_file import load_parameters as load_parameters
from .systems.quadrotor import Quadrotor as Quadrotor
from .targets.base import Observation as Observation, Target as Target, TaskTarget as TaskTarget
from .targets.env_map import Entry as Entry, EnvMap as EnvMap
from .targets.following import FollowingTarget as FollowingTarget
from .targets.gymnasium import GymnasiumTarget as GymnasiumTarget
from .targets.reaching import ReachingTarget as ReachingTarget
from .targets.regulation import RegulationTarget as RegulationTarget
from .targets.rollout import run as run
from .targets.synthetic import (
    FlightTarget as FlightTarget,
    SyntheticTarget as SyntheticTarget,
    constant_force as constant_force,
    sine_force as sine_force,
)
from .tasks.base import Task as Task
from .tasks.references import read_reference as read_reference
from .tasks.regulate import Regulate as Regulate, read_task as read_task
from .weights import shipped as shipped
from .world import World as World
