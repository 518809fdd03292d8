"""Control from states: the paper's CartPole experiments without a camera (sections 3.2.1 and 3.2.2)."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch

from visadapt.effects import Residual
from visadapt.learning.grounding import GroundSettings
from visadapt.learning.joint import Adapted, AdaptSettings, adapt
from visadapt.learning.policy import TuneSettings, train_or_load
from visadapt.policies import StatePolicy
from visadapt.policies.networks import StateResidualNetwork
from visadapt.progress import Report, staged
from visadapt.targets import Target
from visadapt.targets.rollout import see_states
from visadapt.tasks.base import Balance
from visadapt.tasks.cost import PAPER_CARTPOLE
from visadapt.world import World

ANYWHERE = (1e9, 4.0, 0.5, 10.0)
"""delta_div where nothing depends on the cart's position, and no camera loses it."""


@dataclass(frozen=True)
class StateSettings:
    """How a CartPole policy on states is trained."""

    with_history: bool = False
    """whether policy and residual see 5 states and actions, or the last alone"""
    source: TuneSettings = field(
        default_factory=lambda: TuneSettings(
            Balance(PAPER_CARTPOLE, divergence=ANYWHERE), iterations=3000, learning_rate=3e-3, observation_noise=0.0
        )
    )
    adapted: TuneSettings = field(
        default_factory=lambda: TuneSettings(
            Balance(
                PAPER_CARTPOLE,
                start_spread=(0.3, 0.2, 0.1, 0.2),
                kick=(0.0, 0.0, 0.0, 0.0),
                divergence=(1e9, 2.0, 0.25, 3.0),
                first_divergence=0.4,
            ),
            iterations=400,
            learning_rate=2e-3,
            longest=25,
            recorded=0.8,
            observation_noise=0.0,
        )
    )
    ground: GroundSettings = field(default_factory=GroundSettings)


def pretrain(
    source: World, settings: StateSettings, path: Path, seed: int, report: Report | None = None
) -> StatePolicy:
    """The policy of the source, trained there or read from `path`."""
    torch.manual_seed(seed)
    policy = StatePolicy(n_state=4, with_history=settings.with_history)
    about = {"seed": seed, **asdict(settings.source)}
    generator = torch.Generator().manual_seed(seed)
    train_or_load(path, policy, source, None, settings.source, generator, about, staged(report, "source policy"))
    return policy


def adapt_states(
    policy: StatePolicy,
    source: World,
    target: Target,
    settings: StateSettings,
    folder: Path,
    budget: int,
    round_samples: int,
    seed: int,
    report: Report | None = None,
) -> Adapted:
    """Adapt `policy`, in place, to `target` with at most `budget` counted samples: Algorithm 1 in `folder`."""
    torch.manual_seed(seed)
    system = source.system if settings.with_history else None
    residual = Residual(StateResidualNetwork(n_state=4, system=system, period=source.period), torch.ones(4))
    plan = AdaptSettings(settings.adapted, settings.ground, budget, round_samples, "state", seed=seed)
    return adapt(policy, residual, source, target, None, see_states, plan, folder, report=report)
