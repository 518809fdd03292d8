"""Targets that the CartPole is adapted to, and the source policy of each kind of observation."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal, Protocol

import torch

from experiments.kept_scores import kept_score
from renderers import DrawnCartPole
from visadapt.effects import ActuatorDelay, ActuatorGain, ConstantForce, CoulombFriction
from visadapt.evaluation import CartPoleScore
from visadapt.policies import Policy
from visadapt.setups.base import Setup
from visadapt.setups.cartpole import cartpole_frames, cartpole_states
from visadapt.storage.run_folder import open_run
from visadapt.systems import CartPole
from visadapt.targets import SyntheticTarget, no_effects, sine_force
from visadapt.weights import shipped

Shown = Literal["frames", "states"]
"""What a policy sees."""

TARGETS: dict[str, Callable[..., SyntheticTarget]] = {
    "2(sin t + 1) N": partial(SyntheticTarget, sine_force),
    "dry friction 4 N": partial(SyntheticTarget, lambda batch, generator: [CoulombFriction(force=4.0)]),
    "gain 0.7": partial(SyntheticTarget, lambda batch, generator: [ActuatorGain(scale=0.7)]),
    "pole twice as heavy": partial(SyntheticTarget, no_effects, system=CartPole(pole_mass=2 * CartPole().pole_mass)),
    "constant 2 N": partial(SyntheticTarget, lambda batch, generator: [ConstantForce(force=2.0)]),
    "delay 0.05 s and 1 N": partial(
        SyntheticTarget, lambda batch, generator: [ActuatorDelay(delay=0.05), ConstantForce(force=1.0)]
    ),
}
"""By the name that the tables give them."""


def target(name: str, shown: Shown) -> SyntheticTarget:
    """The target of that name, with a camera where frames are shown."""
    return TARGETS[name](camera=DrawnCartPole() if shown == "frames" else None)


def experiment(name: str, shown: Shown) -> str:
    """What the tables call the experiment."""
    return f"CartPole, {'pixels' if shown == 'frames' else 'states'}, {name}"


def source(shown: Shown, folder: Path) -> tuple[Setup, Policy]:
    """The setup, and its source policy: from frames the shipped one; from states, where networks see 5 states and
    actions, one that is trained and kept in `folder`."""
    if shown == "frames":
        setup = cartpole_frames()
        return setup, setup.load(shipped("cartpole_frames"))
    setup = cartpole_states(with_history=True)
    torch.set_num_threads(1)  # Rounding, and with it the weights that training gives, depends on the number of threads
    return setup, setup.pretrain(folder / "source.safetensors", seed=0)


class Adaptations(Protocol):
    """Settings of an experiment that adapts a source policy to TARGETS."""

    @property
    def shown(self) -> Shown:
        """What the policy sees."""
        ...

    @property
    def episodes(self) -> int:
        """Episodes of a score."""
        ...

    @property
    def work(self) -> Path:
        """Folder of intermediate results."""
        ...


def unadapted_score(settings: Adaptations, name: str) -> CartPoleScore:
    """The score of the source policy on the target of that name, kept in the folder of the experiment."""
    torch.set_num_threads(1)
    folder = settings.work / "unadapted"
    open_run(folder, {"shown": settings.shown, "episodes": settings.episodes})
    _, policy = source(settings.shown, settings.work)
    return kept_score(folder / f"{name}.json", policy, target(name, settings.shown), settings.episodes)
