"""Adapts control policies from pixels to a machine whose dynamics differ from the simulator's.

Every name that a user needs is a name of this package; each is imported when it is first asked for.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from visadapt import effects as effects
    from visadapt.diagnosis.diagnose import diagnose as diagnose
    from visadapt.diagnosis.result import Diagnosis as Diagnosis
    from visadapt.effects.base import (
        ActuationEffect as ActuationEffect,
    )
    from visadapt.effects.base import (
        DynamicsEffect as DynamicsEffect,
    )
    from visadapt.effects.base import (
        Effect as Effect,
    )
    from visadapt.effects.base import (
        Parameter as Parameter,
    )
    from visadapt.effects.base import (
        SensingEffect as SensingEffect,
    )
    from visadapt.effects.catalogue import catalogue as catalogue
    from visadapt.effects.residual import Residual as Residual
    from visadapt.evaluation.scoring import score as score
    from visadapt.films.filming import film as film
    from visadapt.learning.joint import Adapted as Adapted
    from visadapt.policies.base import Policy as Policy
    from visadapt.recordings.episode import Episode as Episode
    from visadapt.recordings.hdf5 import read_recording as read_recording
    from visadapt.recordings.hdf5 import write_recording as write_recording
    from visadapt.recordings.loading import load_recording as load_recording
    from visadapt.recordings.recording import Recording as Recording
    from visadapt.setups.base import Setup as Setup
    from visadapt.setups.policy_file import load_policy as load_policy
    from visadapt.setups.policy_file import load_source as load_source
    from visadapt.setups.policy_file import save_policy as save_policy
    from visadapt.setups.training import adapt as adapt
    from visadapt.setups.training import setup_for as setup_for
    from visadapt.setups.training import train as train
    from visadapt.systems.base import System as System
    from visadapt.systems.base import Variable as Variable
    from visadapt.systems.cartpole import CartPole as CartPole
    from visadapt.systems.fixed_wing import FixedWing as FixedWing
    from visadapt.systems.parameter_file import load_parameters as load_parameters
    from visadapt.systems.quadrotor import Quadrotor as Quadrotor
    from visadapt.targets.base import Observation as Observation
    from visadapt.targets.base import Target as Target
    from visadapt.targets.env_map import Entry as Entry
    from visadapt.targets.env_map import EnvMap as EnvMap
    from visadapt.targets.flight import FlightTarget as FlightTarget
    from visadapt.targets.gymnasium import GymnasiumTarget as GymnasiumTarget
    from visadapt.targets.rollout import run as run
    from visadapt.targets.synthetic import (
        SyntheticTarget as SyntheticTarget,
    )
    from visadapt.targets.synthetic import (
        constant_force as constant_force,
    )
    from visadapt.targets.synthetic import (
        sine_force as sine_force,
    )
    from visadapt.tasks.base import Task as Task
    from visadapt.tasks.references import read_reference as read_reference
    from visadapt.weights import shipped as shipped
    from visadapt.world import World as World

_MODULES = {
    "diagnosis.diagnose": "diagnose",
    "diagnosis.result": "Diagnosis",
    "effects.catalogue": "catalogue",
    "effects.base": "ActuationEffect DynamicsEffect Effect Parameter SensingEffect",
    "effects.residual": "Residual",
    "evaluation.scoring": "score",
    "films.filming": "film",
    "learning.joint": "Adapted",
    "policies.base": "Policy",
    "recordings.episode": "Episode",
    "recordings.hdf5": "read_recording write_recording",
    "recordings.loading": "load_recording",
    "recordings.recording": "Recording",
    "setups.base": "Setup",
    "setups.policy_file": "load_policy load_source save_policy",
    "setups.training": "adapt setup_for train",
    "systems.base": "System Variable",
    "systems.cartpole": "CartPole",
    "systems.fixed_wing": "FixedWing",
    "systems.parameter_file": "load_parameters",
    "systems.quadrotor": "Quadrotor",
    "targets.base": "Observation Target",
    "targets.env_map": "Entry EnvMap",
    "targets.flight": "FlightTarget",
    "targets.gymnasium": "GymnasiumTarget",
    "targets.rollout": "run",
    "targets.synthetic": "SyntheticTarget constant_force sine_force",
    "tasks.base": "Task",
    "tasks.references": "read_reference",
    "weights": "shipped",
    "world": "World",
}
"""The module that each name is defined in."""

_HOME = {name: module for module, names in _MODULES.items() for name in names.split()}

__all__ = sorted({*_HOME, "effects"})


def __getattr__(name: str) -> object:
    if name == "effects":
        return importlib.import_module("visadapt.effects")
    if name in _HOME:
        found: object = getattr(importlib.import_module(f"visadapt.{_HOME[name]}"), name)
        return found
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
