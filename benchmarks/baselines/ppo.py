"""PPO of stable-baselines3 (Raffin et al. 2021), pretrained in the source, then fine-tuned in the target.

The reward of a step is exp(-cost), the cost being the squared distances from rest with the weights of `COST`: between 0
and 1, so that to stay up always pays. Settings are the library's defaults, but for many machines at once, larger
batches for speed, and a smaller first deviation of the commands, whose full range throws the pole; none is tuned
further. In the source the checkpoint that does best there is kept (A.3); in the target the policy is scored as it
stands. Its first update is after 2,048 samples: before, it is the source's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor

from benchmarks.baselines.pets import model_inputs
from benchmarks.baselines.problem import COST, TUNING_SEED, Problem, Sizes, Stage, score_path
from visadapt.effects import Effect
from visadapt.evaluation import score
from visadapt.history import History
from visadapt.policies import Policy
from visadapt.storage.run_folder import read_json
from visadapt.systems import CartPole
from visadapt.targets import SyntheticTarget
from visadapt.targets.synthetic import fine_world, no_effects
from visadapt.tasks.balance import EPISODE_STEPS
from visadapt.world import World

MACHINES = 64
ROLLOUT = 2048
"""samples between updates, the default"""
BATCH = 256
"""samples of a gradient step"""
LOOKS = 5
"""at the policy in the source, evenly over the pretraining"""
SCALE = (1.0, 1.0, 0.1, 1.0)
"""of position, velocity, angle and angular velocity as shown"""
GAMMA = 0.99
LOG_STD = -1.5
CURVE = (2048, 4096, 10240, 20480, 51200, 102400, 200704)
"""samples after which the fine-tuned policy is scored, until it has reached the best of ours"""


class Machines(VecEnv):
    """A batch of cart-poles, each started anew when its episode ends, as stable-baselines3 wants them.

    Args:
        draw_effects: of a batch of episodes.
        start: first states (B, 4) of a batch of episodes.
        fine: whether they are integrated as finely as the target, or as the source.
    """

    def __init__(
        self,
        draw_effects: Callable[[int, torch.Generator], Sequence[Effect]],
        start: Callable[[int, torch.Generator], Tensor],
        with_history: bool,
        fine: bool,
        seed: int,
    ) -> None:
        self.draw_effects, self.start, self.with_history, self.fine = draw_effects, start, with_history, fine
        self.generator = torch.Generator().manual_seed(seed)
        width = len(shown(History.start(torch.zeros(1, 4), 1), with_history)[0])
        boxes = [gymnasium.spaces.Box(-limit, limit, (size,)) for limit, size in ((np.inf, width), (1.0, 1))]
        super().__init__(MACHINES, *boxes)

    def reset(self) -> np.ndarray:
        self.effects = self.draw_effects(MACHINES, self.generator)
        make = fine_world if self.fine else World
        self.world = make(CartPole(), self.effects, period=0.05).requires_grad_(False)
        self.at, self.history = self._begun()
        self.age = torch.zeros(MACHINES, dtype=torch.long)
        return shown(self.history, self.with_history).numpy()

    def step_async(self, actions: np.ndarray) -> None:
        self.action = torch.as_tensor(actions, dtype=torch.float32)

    @torch.no_grad()
    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        self.at = self.world.step(self.at, self.action)
        seen, self.at = self.world.measure(self.at, self.generator)
        self.history = self.history.acting(self.action.clamp(-1, 1)).observing(seen)
        self.age += 1
        weights, state = torch.tensor(COST.state), self.at.state
        cost = (weights * state.square()).sum(1) + COST.action * self.action[:, 0].square()
        fallen = state[:, 2].abs() > 0.3
        ended = fallen | (self.age >= EPISODE_STEPS)
        reward = torch.where(fallen, torch.zeros_like(cost), (-cost).exp())
        last, infos = shown(self.history, self.with_history).numpy(), [dict[str, Any]() for _ in range(MACHINES)]
        for row in ended.nonzero()[:, 0].tolist():
            infos[row] = {"terminal_observation": last[row], "TimeLimit.truncated": not bool(fallen[row])}
        if bool(ended.any()):
            self._restart(ended.nonzero()[:, 0])
        return shown(self.history, self.with_history).numpy(), reward.numpy(), ended.numpy(), infos

    def _begun(self) -> tuple[Any, History]:
        state = self.start(MACHINES, self.generator)
        seen, at = self.world.measure(self.world.start(state), self.generator)
        return at, History.start(seen, 1)

    def _restart(self, rows: Tensor) -> None:
        """New episodes, with effects drawn anew, in these rows."""
        for effect, fresh in zip(self.effects, self.draw_effects(MACHINES, self.generator), strict=True):
            for parameter in effect.table:
                values = getattr(effect, parameter.name)
                if values.dim():
                    values.data[rows] = getattr(fresh, parameter.name).data[rows]
        at, history = self._begun()
        self.at, self.history = self.at.replaced(rows, at[rows]), self.history.replaced(rows, history[rows])
        self.age[rows] = 0

    def close(self) -> None:
        pass

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self, attr_name, None)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


class Trained(Policy):
    """The mean command of a PPO policy."""

    def __init__(self, model: PPO, with_history: bool) -> None:
        super().__init__(4, 1)
        self.network = model.policy
        self.with_history = with_history

    @torch.no_grad()
    def act(self, history: History) -> Tensor:
        out: Tensor = self.network.get_distribution(shown(history, self.with_history)).mode()
        return out.clamp(-1, 1)


def shown(history: History, with_history: bool) -> Tensor:
    """What PPO sees (B, inputs): the position, and what the ensemble of PETS sees; in units of SCALE."""
    states = history.observations / torch.tensor(SCALE)
    return torch.cat((states[:, -1, :1], model_inputs(History(states, history.actions), with_history)), 1)


def pretrained(problem: Problem, sizes: Sizes, path: Path, seed: int) -> PPO:
    """The PPO policy that does best in the source, from starts as wide as those of ours."""
    task = problem.setup(sizes).settings.source.task
    start = lambda batch, generator: task.training_start(batch, 1.0, generator)[0]  # noqa: E731
    machines = Machines(no_effects, start, problem.with_history, fine=False, seed=seed)
    if path.exists():
        return PPO.load(path, env=machines, device="cpu")
    args = {"n_steps": ROLLOUT // MACHINES, "batch_size": BATCH, "gamma": GAMMA, "seed": seed, "device": "cpu"}
    model = PPO("MlpPolicy", machines, policy_kwargs={"log_std_init": LOG_STD}, **args)
    best = (-1, -math.inf)
    for _ in range(LOOKS):
        model.learn(sizes.source_steps // LOOKS, reset_num_timesteps=False)
        found = score(Trained(model, problem.with_history), SyntheticTarget(), sizes.episodes, TUNING_SEED)
        if (now := (found.survived, -(found.mean_speed or 0.0))) > best:
            best = now
            model.save(path)
    return PPO.load(path, env=machines, device="cpu")


def stages(problem: Problem, sizes: Sizes, folder: Path, seed: int) -> Iterator[Stage]:
    """The pretrained policy, then the curve of its fine-tuning."""
    folder.mkdir(parents=True, exist_ok=True)
    model = pretrained(problem, sizes, folder / "source.zip", seed)
    policy = Trained(model, problem.with_history)
    yield Stage("source", 0, policy)
    yield Stage("target", 0, policy)
    target = problem.target()
    machines = Machines(target.draw_effects, target.initial.draw, problem.with_history, fine=True, seed=seed)
    model.set_env(machines)
    model.num_timesteps = 0
    goal = _speed_of_ours(folder)
    for samples in [each for each in CURVE if each <= sizes.target_steps + ROLLOUT]:
        model.learn(samples - model.num_timesteps, reset_num_timesteps=False)
        stage = Stage("adapted", samples, policy)
        yield stage
        found = read_json(score_path(folder, stage))
        if found["survived"] == found["episodes"] and found["mean_speed"] <= goal:
            return


def _speed_of_ours(folder: Path) -> float:
    """The least of ours in this problem and seed, m/s, after any samples; 0 where it has not been run."""
    paths = (folder.parents[2] / "ours" / folder.parent.name / folder.name).glob("score-adapted-*.json")
    return min((read_json(path)["mean_speed"] or math.inf for path in paths), default=0.0)
