"""Joint learning of residual and policy: Algorithm 1 of the paper, round after round.

Each round executes the policy in the target for B counted samples, grounds the residual on all samples so far, and
tunes the policy by backpropagation through renderer, residual and physics. Every stage of a round leaves one file,
under its final name only once it is whole; an interrupted run goes on after the last whole stage.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from visadapt.effects import Residual
from visadapt.learning.grounding import GroundLoss, GroundSettings, fit_named, ground, rescale, with_true_states
from visadapt.learning.ledger import Ledger
from visadapt.learning.policy import TuneSettings, initialise_feedforward, tune
from visadapt.learning.windows import Observe, Windows
from visadapt.policies import Policy
from visadapt.progress import Progress, Report, staged
from visadapt.recordings import Episode, read_recording, write_recording
from visadapt.storage.checkpoints import load_tree, load_weights, save_tree
from visadapt.targets import Target, TargetError
from visadapt.targets.rollout import run
from visadapt.world import World

Label = Callable[[list[Episode]], list[Episode]]
"""Gives the episodes of a round the states that grounding learns from."""


@dataclass(frozen=True)
class AdaptSettings:
    """How a policy is adapted to a target."""

    tune: TuneSettings
    ground: GroundSettings
    budget: int = 1000
    """N: target samples in all"""
    round_samples: int = 200
    """B: target samples in a round"""
    observations: str = "camera"
    """what grounding shows the residual: one of `windows.SOURCES`"""
    longest_episode: int = 250
    """steps"""
    exploration: float = 0.05
    """standard deviation of white noise on the commands while data are collected"""
    feedforward: bool = True
    """begin with a policy that opposes what the residual expects; False where one command cannot undo it in a period"""
    seed: int = 0

    def __post_init__(self) -> None:
        if self.round_samples < 1:
            raise ValueError(f"a round needs at least 1 sample, got B = {self.round_samples}")
        if self.budget < self.round_samples:
            raise ValueError(
                f"the budget N = {self.budget} is smaller than a round of B = {self.round_samples} samples: "
                "raise N or lower B"
            )

    @property
    def rounds(self) -> int:
        """ceil(N / B)"""
        return math.ceil(self.budget / self.round_samples)


@dataclass(frozen=True)
class Round:
    """What a round did: its losses over optimisation steps, and the samples counted when it began to learn."""

    samples: int
    grounding: list[tuple[int, float, float]]
    """(step, training loss, held-out loss)"""
    policy: list[float]
    """loss by iteration"""


@dataclass(frozen=True)
class Adapted:
    """The outcome of `adapt`; policy and residual were changed in place.

    >>> import visadapt as va
    >>> policy = va.load_policy(va.shipped("cartpole_states"))
    >>> target = va.SyntheticTarget(va.constant_force(1.0))
    >>> result = va.adapt(policy, va.World(va.CartPole()), target, samples=20, iterations=1)
    >>> result.ledger.entries
    [('round 1/1: data', 20)]
    """

    policy: Policy
    ledger: Ledger
    rounds: list[Round]
    episodes: list[Episode]
    folder: Path

    def restore(self, policy: Policy, samples: int) -> None:
        """Give `policy`, and the residual it listens to, the weights they had after `samples` counted samples.

        Raises:
            ValueError: no round ended there.
        """
        ends = [each.samples for each in self.rounds]
        if samples not in ends:
            raise ValueError(f"no round ended at {samples} samples; rounds ended at {', '.join(map(str, ends))}")
        path = _weights(self.folder, ends.index(samples))
        load_weights(policy, load_tree(path)["weights"], path)


def adapt(
    policy: Policy,
    residual: Residual,
    source: World,
    target: Target,
    observe: Observe | None,
    settings: AdaptSettings,
    folder: Path,
    label: Label | None = None,
    report: Report | None = None,
    explorer: Policy | None = None,
) -> Adapted:
    """Run Algorithm 1 in `folder`, going on from what is there.

    Args:
        policy, residual: the networks, changed in place; the policy listens to the residual.
        source: the physics known beforehand; effects that it has are named guesses, whose parameters are fitted.
        observe: the camera of simulated states, a learnt renderer; None where the policy sees what sensors measure.
        label: estimates the states from the camera's frames; without it, the target's own states are used.
        explorer: the policy that collects the target's data, in place of the one that is tuned (Algorithm 1).

    Raises:
        TargetError: the target misbehaves. BudgetExceeded: a step more than the budget.
        CheckpointError: `folder` holds a run of other networks.
    """
    effects = [*source.effects, residual]
    grounded = World(source.system, effects, source.period, source.integrator, source.substeps)
    policy.residual = residual
    ledger = Ledger(settings.budget)
    episodes: list[Episode] = []
    rounds: list[Round] = []
    for number in range(settings.rounds):
        here = _weights(folder, number).parent
        name = f"round {number + 1}/{settings.rounds}"
        wanted = min(settings.round_samples, ledger.left)
        collector = policy if explorer is None else explorer
        drawn = _generator(settings, number, 0)
        new = _collected(here / "recording.h5", collector, target, wanted, settings, drawn)
        for episode in new:
            ledger.count(f"{name}: data", episode.samples)
        episodes += new if label is None else label(new)
        windows = Windows.cut(episodes, settings.observations, observe)

        def fit(progress: Progress | None, windows: Windows = windows, number: int = number) -> list[GroundLoss]:
            windows = fit_named(source, windows)
            if number == 0:
                rescale(residual, source, windows, settings.ground.negligible)
            return ground(residual, source, windows, settings.ground, _generator(settings, number, 1), progress)

        grounding = _grounded(here / "residual.safetensors", fit, grounded, staged(report, f"{name}: ground"))
        windows = with_true_states(source, windows)
        if number == 0 and settings.feedforward:
            initialise_feedforward(policy, source, residual.scale)
        losses = _tuned(here, policy, grounded, observe, settings, windows, number, staged(report, f"{name}: tune"))
        rounds.append(Round(ledger.used, grounding, losses))
    return Adapted(policy, ledger, rounds, episodes, folder)


def _weights(folder: Path, number: int) -> Path:
    """Where round `number`, counted from 0, leaves the policy."""
    return folder / f"round-{number + 1:02d}" / "policy.safetensors"


def _generator(settings: AdaptSettings, number: int, stage: int) -> torch.Generator:
    """Each stage draws from its own stream, so that a resumed run draws the same."""
    return torch.Generator().manual_seed(1_000_000 * settings.seed + 10 * number + stage)


def _collected(
    path: Path,
    policy: Policy,
    target: Target,
    wanted: int,
    settings: AdaptSettings,
    generator: torch.Generator,
) -> list[Episode]:
    """Episodes of `wanted` samples under `policy`, one after the other as on a machine."""
    if path.exists():
        return read_recording(path)
    episodes: list[Episode] = []
    left = wanted
    while left > 0:
        steps = min(left, settings.longest_episode)
        episode = run(target, policy, 1, steps, generator, settings.exploration)[0].episode
        if episode.samples == 0:
            raise TargetError(f"{target.name}: the episode is over before its first step")
        episodes.append(episode)
        left -= episode.samples
    write_recording(path, episodes)
    return episodes


def _grounded(
    path: Path,
    fit: Callable[[Progress | None], list[GroundLoss]],
    grounded: World,
    progress: Progress | None,
) -> list[tuple[int, float, float]]:
    if path.exists():
        tree = load_tree(path)
        load_weights(grounded, tree["weights"], path)
        return [(int(step), float(train), float(held)) for step, train, held in tree["losses"]]
    losses = [(loss.step, loss.train, loss.held_out) for loss in fit(progress)]
    save_tree(path, {"weights": grounded.state_dict(), "losses": losses})
    return losses


def _tuned(
    here: Path,
    policy: Policy,
    grounded: World,
    observe: Observe | None,
    settings: AdaptSettings,
    windows: Windows,
    number: int,
    progress: Progress | None,
) -> list[float]:
    path, partial = here / "policy.safetensors", here / "policy.partial.safetensors"
    if path.exists():
        tree = load_tree(path)
        load_weights(policy, tree["weights"], path)
        losses: list[float] = tree["losses"]
        return losses
    generator = _generator(settings, number, 2)
    losses = tune(policy, grounded, observe, settings.tune, generator, windows, progress, partial)
    save_tree(path, {"weights": policy.state_dict(), "losses": losses})
    partial.unlink(missing_ok=True)
    return losses
