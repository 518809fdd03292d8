"""PPO of stable-baselines3 (Raffin et al. 2021), pretrained in the source, then fine-tuned in the target.

Rewards are those of `courses`. Settings are the library's defaults, but for many machines at once, larger batches for
speed, and a smaller first deviation of the commands, whose full range throws the pole; none is tuned further. In the
source the checkpoint that does best there is kept (A.3); in the target the policy is scored as it stands. Its first
update is after 2,048 samples: before, it is the source's.

From frames, PPO begins with the frame encoder of ours as it was trained to read positions and angles, and trains that
too. In the source it sees the frames of ours' renderer, in the target those of the camera.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from gymnasium.spaces import Box
from stable_baselines3 import PPO
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor

from benchmarks.baselines.courses import Balancing, Course, Filmed, flying, starting
from benchmarks.baselines.machines import MACHINES, Machines
from benchmarks.baselines.problem import TUNING_SEED, Problem, Sizes, Stage
from experiments.kept_scores import kept_score
from visadapt.history import LENGTH, History
from visadapt.policies import ImagePolicy, Policy
from visadapt.policies.frame_encoder import N_FEATURES
from visadapt.setups.cartpole import cartpole_frames
from visadapt.setups.policy_file import load_policy
from visadapt.targets import FlightTarget, SyntheticTarget
from visadapt.targets.synthetic import WorldTarget, no_effects
from visadapt.weights import shipped

ROLLOUT = 2048
"""samples between updates, the default"""
BATCH = 256
"""samples of a gradient step"""
LOOKS = 5
"""at the policy in the source, evenly over the pretraining"""
GAMMA = 0.99
LOG_STD = -1.5
CURVE = (2048, 4096, 10240, 20480, 51200, 102400, 200704)
"""samples after which the fine-tuned policy is scored"""


class Trained(Policy):
    """The mean command of a PPO policy."""

    def __init__(self, model: PPO, course: Course) -> None:
        super().__init__(len(course.system.states), len(course.system.actions))
        self.shown = course.show
        self.network = model.policy
        self.course = course

    @torch.no_grad()
    def act(self, history: History) -> Tensor:
        out: Tensor = self.network.get_distribution(self.course.shown(history)).mode()
        return out.clamp(-1, 1)


class Eyes(BaseFeaturesExtractor):
    """The frame encoder of ours, for what `Filmed` shows."""

    def __init__(self, observation_space: Box) -> None:
        super().__init__(observation_space, N_FEATURES)
        policy = load_policy(shipped("cartpole_frames"))
        assert isinstance(policy, ImagePolicy)
        self.size = policy.observation_shape
        self.trained = {key: weight.clone() for key, weight in policy.perception.state_dict().items()}
        # PPO's orthogonal initial weights cannot be written into tensors of another memory format.
        self.encoder = policy.perception.requires_grad_(True).to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]

    def restore(self) -> None:
        """Give the encoder its trained weights, which PPO replaces with new ones when it makes its networks."""
        self.encoder.load_state_dict(self.trained)

    def forward(self, shown: Tensor) -> Tensor:
        frames, actions = shown[:, : LENGTH * math.prod(self.size)], shown[:, LENGTH * math.prod(self.size) :]
        history = History(frames.unflatten(1, (LENGTH, *self.size)), actions.unflatten(1, (LENGTH, -1)))
        features: Tensor = self.encoder(history)
        return features


def model_of(machines: Machines, seed: int) -> PPO:
    """A new PPO policy, with what is not the library's default."""
    args = {"n_steps": ROLLOUT // MACHINES, "batch_size": BATCH, "gamma": GAMMA, "seed": seed, "device": "cpu"}
    networks: dict[str, Any] = {"log_std_init": LOG_STD}
    if not isinstance(machines.course, Filmed):
        return PPO("MlpPolicy", machines, **args, policy_kwargs=networks)
    model = PPO("MlpPolicy", machines, **args, policy_kwargs={**networks, "features_extractor_class": Eyes})
    eyes = model.policy.features_extractor
    assert isinstance(eyes, Eyes)
    eyes.restore()
    return model


def courses(problem: Problem, sizes: Sizes) -> tuple[Course, Course]:
    """Those of the pretraining, which start as widely as those of ours, and of the target."""
    target = problem.target()
    camera = target.camera if isinstance(target, SyntheticTarget) else None
    setup = problem.setup(sizes) if camera is None else cartpole_frames()
    task = setup.settings.source.task

    def wide(batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        return task.training_start(batch, 1.0, generator)

    if isinstance(target, FlightTarget):
        own = target.task
        return flying(own, target.system, wide), flying(own, target.system, own.evaluation_start)
    assert isinstance(target, SyntheticTarget)
    begin = starting(target.initial)
    if camera is None:
        return Balancing(wide, problem.with_history), Balancing(begin, problem.with_history)
    reach = camera.camera.reach
    assert setup.observe is not None
    return Filmed(wide, setup.observe, reach), Filmed(begin, target.draw, reach)


def pretrained(problem: Problem, course: Course, sizes: Sizes, path: Path, seed: int) -> PPO:
    """The PPO policy that does best in the source."""
    machines = Machines(course, no_effects, problem.setup(sizes).source, seed)
    if path.exists():
        return PPO.load(path, env=machines, device="cpu")
    model = model_of(machines, seed)
    best, kept_so_far = (math.inf, math.inf), path.with_name("source-best.zip")
    for look in range(LOOKS):
        model.learn(sizes.source_steps // LOOKS, reset_num_timesteps=False)
        kept = path.with_name(f"source-{look}.json")
        found = kept_score(kept, Trained(model, course), problem.scored("source"), sizes.episodes, seed=TUNING_SEED)
        print(f"PPO, {problem.name}, seed {seed}, source, {model.num_timesteps} steps: {found}", flush=True)
        row = problem.row("PPO", "source", 0, [kept])
        if (row.failed, row.mean) < best:
            best = row.failed, row.mean
            model.save(kept_so_far)
    kept_so_far.rename(path)
    return PPO.load(path, env=machines, device="cpu")


def stages(problem: Problem, sizes: Sizes, folder: Path, seed: int) -> Iterator[Stage]:
    """The pretrained policy, then the curve of its fine-tuning."""
    folder.mkdir(parents=True, exist_ok=True)
    wide, course = courses(problem, sizes)
    model = pretrained(problem, wide, sizes, folder / "source.zip", seed)
    policy = Trained(model, course)
    for domain in ("source", "target"):
        yield Stage(domain, 0, policy)
    target = problem.target()
    assert isinstance(target, WorldTarget)
    model.set_env(Machines(course, target.draw_effects, None, seed))
    model.num_timesteps = 0
    for samples in [each for each in CURVE if each <= sizes.target_steps + ROLLOUT]:
        model.learn(samples - model.num_timesteps, reset_num_timesteps=False)
        yield Stage("adapted", samples, policy)
