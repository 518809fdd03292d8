"""A task that others have run: dm_control's cart-pole, balance, from pixels.

    pip install 'visadapt[dm_control]'
    python -m benchmarks.dm_control_balance

The suite's environment as it is (Tassa et al. 2018, arXiv:1801.00690): 1,000 steps of 0.01 s, a reward of at most 1
in each, which falls with the pole's lean and speed, the cart's distance from the middle and the command. An action is
repeated for 5 steps; steps are counted as the suite's, so 5 to a sample of ours.

Those who have run it learn from reward and pixels alone. Ours knows beforehand the equations of a cart-pole with the
model's published masses, length and gear, how the scene looks in states that it is put into (4,000 frames, for which no
step is run), and what it is to do; never the reward. In order: the renderer is learnt from those frames, encoder and
policy are trained in the source seen through it, and every seed adapts the policy to the suite's physics from frames
alone. Scored by the return of 20 episodes, before, after the first round and after the last. Writes
results/dm_control.csv. Interrupt it anywhere; started again, it goes on.
"""

from __future__ import annotations

import importlib
import statistics
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from torch import Tensor

from experiments.learnt_camera import learnt_renderer
from experiments.result_tables import Row, write_rows
from visadapt.evaluation.scoring import SCORE_SEED
from visadapt.policies import Policy
from visadapt.progress import reporting
from visadapt.setups.cartpole import cartpole_frames
from visadapt.storage.run_folder import once, open_run
from visadapt.systems import CartPole
from visadapt.targets import Observation, Start, Target, TargetError
from visadapt.targets.mujoco_frames import cannot_render, choose_backend
from visadapt.targets.rollout import run
from visadapt.world import World

SOURCE = CartPole(cart_mass=1.0, pole_mass=0.1, pole_half_length=0.5, max_force=10.0, gravity=9.81)
"""The published values of its model, without its friction; the pole is a thin rod here and a capsule there."""
REPEAT, STEP, LENGTH = 5, 0.01, 1000
"""Steps that an action is held for, s of a step, steps of an episode."""
HEIGHT, WIDTH = 100, 120
GUESS = (59.5, 49.5, 30.0, 1.1)
"""Of the camera, from a look at the frames."""
REACH, FALLEN = 1.75, 0.3
"""m of the rail and rad, beyond which nothing more is learnt from an episode; its return goes on."""


class DmControlBalance(Target):
    """A batch of dm_control's cart-poles to be balanced; `returns` (B,) has what each has earned since the reset.

    Raises:
        TargetError: dm_control is not installed, or no off-screen renderer works.
    """

    name = "dm_control's cart-pole"
    period = REPEAT * STEP
    n_action = 1

    def __init__(self) -> None:
        choose_backend()
        try:
            self.suite: Any = importlib.import_module("dm_control.suite")
        except ImportError as error:
            raise TargetError(f"{self.name}: {error}; pip install 'visadapt[dm_control]'") from None
        self.environments: list[Any] = []
        self.drawn = self._loaded(0)  # draws all of them: each environment that draws has a GL context of its own
        self.returns = np.zeros(0)

    def reset(self, batch: int, generator: torch.Generator) -> Observation:
        seeds = torch.randint(2**31 - 1, (batch,), generator=generator).tolist()
        self.environments = [self._loaded(seed) for seed in seeds]
        self.returns = np.zeros(batch)
        return self._observe()

    def step(self, action: Tensor) -> Observation:
        if not self.environments:
            raise TargetError(f"{self.name}: step before reset")
        commands = action.detach().clamp(-1, 1).double().numpy()
        for k, (environment, command) in enumerate(zip(self.environments, commands, strict=True)):
            self.returns[k] += sum(environment.step(command).reward or 0.0 for _ in range(REPEAT))
        return self._observe()

    def show(self, states: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Frames (N, H, W) of states (N, 4), no step of which is run."""
        frames = []
        for x, x_dot, theta, theta_dot in states:
            with self.drawn.physics.reset_context():
                self.drawn.physics.data.qpos[:] = x, theta
                self.drawn.physics.data.qvel[:] = x_dot, theta_dot
            try:
                colours = self.drawn.physics.render(height=HEIGHT, width=WIDTH, camera_id="fixed")
            except Exception as error:  # depending on the backend an ImportError, AttributeError, RuntimeError, ...
                raise cannot_render(self.name, error) from error
            frames.append(colours.mean(2).round().astype(np.uint8))
        return np.stack(frames)

    def _loaded(self, seed: int) -> Any:
        environment = self.suite.load("cartpole", "balance", task_kwargs={"random": seed})
        environment.reset()
        return environment

    def _observe(self) -> Observation:
        data = [environment.physics.data for environment in self.environments]
        state = np.array([(each.qpos[0], each.qvel[0], each.qpos[1], each.qvel[1]) for each in data])
        alive = (abs(state[:, 0]) <= REACH) & (abs(state[:, 2]) <= FALLEN)
        frame = torch.from_numpy(self.show(state))
        return Observation(torch.from_numpy(state).float(), torch.from_numpy(alive), frame)


@dataclass(frozen=True)
class Settings:
    """What is run, and where."""

    budget: int = 1000
    """target samples of each adaptation, all counted; REPEAT steps of the suite each"""
    round_samples: int = 200
    seeds: int = 3
    """of the adaptations; renderer and source policy are made once, with seed 0"""
    frames: int = 4000
    """of set states, that the renderer is trained on"""
    renderer_steps: int = 800
    episodes: int = 20
    """that each policy is scored on"""
    work: Path = Path("runs/dm_control_balance")
    out: Path = Path("results/dm_control.csv")


def main(settings: Settings) -> None:
    """Run what is missing, then write the table."""
    torch.set_num_threads(1)
    target, work = DmControlBalance(), settings.work
    chosen = {key: value for key, value in asdict(settings).items() if key not in ("seeds", "work", "out")}
    open_run(work, chosen)
    with reporting() as report:
        states = Start(1.7, 0.0, 0.35, 0.0).draw(settings.frames, torch.Generator().manual_seed(0))
        camera = work / "renderer.safetensors"
        renderer = learnt_renderer(camera, states, target.show, GUESS, settings.renderer_steps, report)
        setup = cartpole_frames(World(SOURCE, period=target.period), renderer)
        # The suite begins a new episode by itself after LENGTH steps.
        setup = replace(setup, settings=replace(setup.settings, longest_episode=LENGTH // REPEAT))
        source = work / "source" / "policy.safetensors"
        policy = setup.pretrain(source, 0, report)
        earned = {0: [_returns(work / "before.json", policy, target, settings.episodes)]}
        for seed in range(settings.seeds):
            folder, policy = work / f"seed-{seed}", setup.load(source)
            adapted = setup.adapt(policy, target, folder, settings.budget, settings.round_samples, seed, report)
            for samples in (adapted.rounds[0].samples, adapted.rounds[-1].samples):
                adapted.restore(policy, samples)
                found = _returns(folder / f"score-{samples}.json", policy, target, settings.episodes)
                earned.setdefault(samples, []).append(found)
    rows = [_row(samples, found) for samples, found in earned.items()]
    write_rows(settings.out, rows)
    for row in rows:
        print(f"{row.domain:8} {row.samples:5} steps  {row.mean:.1f} +- {row.std:.1f}")


def _returns(kept: Path, policy: Policy, target: DmControlBalance, episodes: int) -> list[float]:
    """The return of each episode, as they are kept or else run; once all have fallen nothing more is earned."""

    def make() -> dict[str, list[float]]:
        run(target, policy.eval(), episodes, LENGTH // REPEAT, torch.Generator().manual_seed(SCORE_SEED))
        return {"returns": target.returns.tolist()}

    found: list[float] = once(kept, make)["returns"]
    return found


def _row(samples: int, found: list[list[float]]) -> Row:
    earned = [each for seed in found for each in seed]
    mean, std = round(statistics.fmean(earned), 1), round(statistics.pstdev(earned), 1)
    domain = "adapted" if samples else "target"
    about = ("dm_control, balance", "cartpole", "ours, frames alone", domain, REPEAT * samples, "return", "1")
    return Row(*about, mean, std, len(earned), 0, len(found))


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
