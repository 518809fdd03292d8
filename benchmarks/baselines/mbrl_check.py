"""PETS of mbrl-lib (Pineda et al. 2021), the paper's, on the cart-pole, beside ours: is ours as good?

    python -m venv .mbrl && .mbrl/bin/pip install -e . tyro hydra-core imageio termcolor tqdm
    .mbrl/bin/pip install --no-deps mbrl==0.2.0
    .mbrl/bin/python -m benchmarks.baselines.mbrl_check

mbrl-lib asks for an older gymnasium than ours, so it has an environment of its own. Networks, their training, the
propagation of particles and the cross-entropy method are mbrl-lib's; the source's runs, the cost of a plan, the numbers
of members, plans and iterations and the width of the networks are those of `pets`. mbrl-lib's defaults draw the first
plans from the whole range of commands (a standard deviation of 0.5) and bound the networks' standard deviation of a
state's change from below at 0.0067, in SI units. Ours draws them with 0.03, and scales the changes first; so does the
last row here.

Writes results/pets_mbrl.csv.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import mbrl.models
import numpy as np
import omegaconf
import torch
import tyro
from mbrl.planning.trajectory_opt import CEMOptimizer, TrajectoryOptimizer
from mbrl.types import TransitionBatch
from mbrl.util.replay_buffer import BootstrapIterator
from torch import Tensor

from benchmarks.baselines.cartpole import CARTPOLES, COST
from benchmarks.baselines.ensemble import HIDDEN, MEMBERS, source_ensemble, source_runs
from benchmarks.baselines.pets import ELITES, ITERATIONS, KEPT, PLANS, EnsemblePlanner
from benchmarks.baselines.problem import Sizes
from benchmarks.baselines.subjects import CartPoleSubject
from experiments.result_tables import print_speed, speed_row, write_rows
from visadapt.evaluation import score
from visadapt.history import HORIZON, History
from visadapt.policies import Policy
from visadapt.world import World

SUBJECT = CartPoleSubject(with_history=False)
BATCH = 256
"""samples of a gradient step"""
CHANGE_UNIT = 0.1
"""by which changes of the state are divided where they are scaled, in SI units: about their standard deviation"""


class DrawnWithin(CEMOptimizer):
    """The cross-entropy method, whose first plans are drawn with a standard deviation of its own."""

    def __init__(self, noise: float, **settings: object) -> None:
        super().__init__(**settings)
        self.noise = noise

    def _init_population_params(self, x0: Tensor) -> tuple[Tensor, Tensor]:
        return x0.clone(), torch.full_like(x0, self.noise**2)


class MbrlPlanner(Policy):
    """Plans through mbrl-lib's model; states are in units of `unit` there."""

    def __init__(self, model: mbrl.models.OneDTransitionRewardModel, noise: float, unit: float) -> None:
        super().__init__(4, 1)
        self.model, self.noise, self.unit = model, noise, unit
        self.generator = torch.Generator().manual_seed(0)
        self.planners: list[TrajectoryOptimizer] = []

    @torch.no_grad()
    def act(self, history: History) -> Tensor:
        if bool(history.begins.all()):
            self.planners = [self.planner() for _ in history.actions]
        plans = [
            planner.optimize(lambda plans, state=state: -self.costs(state, plans))
            for planner, state in zip(self.planners, history.observations[:, -1], strict=True)
        ]
        return torch.from_numpy(np.stack(plans))[:, 0]

    def planner(self) -> TrajectoryOptimizer:
        """One for each episode: it goes on from its last plan."""
        settings = {
            "_target_": "benchmarks.baselines.mbrl_check.DrawnWithin",
            "noise": self.noise,
            "num_iterations": ITERATIONS,
            "elite_ratio": ELITES / PLANS,
            "population_size": PLANS,
            "alpha": KEPT,
            "device": "cpu",
            "return_mean_elites": True,
            "lower_bound": None,
            "upper_bound": None,
        }
        ends = np.ones(1, np.float32)
        return TrajectoryOptimizer(omegaconf.OmegaConf.create(settings), -ends, ends, HORIZON)

    def costs(self, state: Tensor, plans: Tensor) -> Tensor:
        """(PLANS,) mean costs over the particles of plans (PLANS, HORIZON, 1) from a state (4,)."""
        commands = plans.repeat(MEMBERS, 1, 1)
        now = state.expand(len(commands), -1)
        at, states = self.model.reset(now / self.unit, self.generator), []
        for k in range(HORIZON):
            seen, _, _, at = self.model.sample(commands[:, k], at, rng=self.generator)
            states.append(seen * self.unit)
        return COST(torch.stack(states, 1), commands, now).unflatten(0, (MEMBERS, -1)).mean(0)


def learnt(world: World, epochs: int, unit: float, seed: int) -> mbrl.models.OneDTransitionRewardModel:
    """mbrl-lib's ensemble of the source, trained by mbrl-lib on the runs that `pets` learns from."""
    torch.manual_seed(seed)
    network = mbrl.models.GaussianMLP(
        3 + 1,
        4,
        "cpu",
        num_layers=2,
        ensemble_size=MEMBERS,
        hid_size=HIDDEN,
        propagation_method="fixed_model",
        activation_fn_cfg={"_target_": "torch.nn.SiLU"},
    )
    model = mbrl.models.OneDTransitionRewardModel(
        network, normalize=True, learned_rewards=False, obs_process_fn=lambda state: state[..., 1:]
    )
    history, after = source_runs(world, SUBJECT, torch.Generator().manual_seed(seed))
    before, command = history.observations[:, -1], history.actions[:, -1]
    none = np.zeros(len(before), np.float32)
    units = [(before / unit).numpy(), command.numpy(), (after / unit).numpy()]
    runs = TransitionBatch(*units, none, none.astype(bool), none.astype(bool))
    model.update_normalizer(runs)
    batches = BootstrapIterator(runs, BATCH, MEMBERS, shuffle_each_epoch=True, rng=np.random.default_rng(seed))
    mbrl.models.ModelTrainer(model, optim_lr=1e-3).train(batches, num_epochs=epochs, evaluate=False, silent=True)
    return model


@dataclass(frozen=True)
class Settings:
    """What is run, and where."""

    episodes: int = 20
    epochs: int = 30
    """of mbrl-lib's training: over 40,000 samples in batches of 256, 4,700 updates; `pets` has 4,000"""
    seed: int = 0
    out: Path = Path("results/pets_mbrl.csv")


def planners(settings: Settings, world: World) -> Iterable[tuple[str, Policy]]:
    """By name in the table."""
    ours = source_ensemble(world, SUBJECT, Sizes().updates, settings.seed)
    yield "ours", EnsemblePlanner(ours, SUBJECT, 1)
    for unit, scaled in ((1.0, "as it is"), (CHANGE_UNIT, "changes scaled")):
        model = learnt(world, settings.epochs, unit, settings.seed)
        for noise in (0.5, SUBJECT.noise):
            yield f"mbrl-lib, {scaled}, first plans {noise:g}", MbrlPlanner(model, noise, unit)


def main(settings: Settings) -> None:
    """Score each in the source, and write the table."""
    torch.set_num_threads(1)
    problem = CARTPOLES[0]
    rows = []
    for name, policy in planners(settings, problem.setup(Sizes()).source):
        found = score(policy, problem.scored("source"), settings.episodes)
        rows.append(speed_row(problem.name, name, "source", 0, [found]))
        print_speed(rows[-1])
    write_rows(settings.out, rows)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
