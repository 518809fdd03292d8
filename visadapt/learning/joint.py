"""Joint learning of residual and policy: Algorithm 1 of the paper, round after round.

Each round executes the policy in the target for B counted samples, grounds the residual on all samples so far, and
tunes the policy by backpropagation through the world so grounded (`learning.plans`). Every stage of a round writes one
file, which gets its final name once it is complete; an interrupted run goes on after the last complete stage.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from visadapt.effects import Residual
from visadapt.learning.explanation import NOT_DIAGNOSED, Explain, Explanation
from visadapt.learning.grounding import GroundLoss, fit_named, ground, rescale
from visadapt.learning.ledger import Ledger
from visadapt.learning.policy import TuneSettings, initialise_feedforward, tune
from visadapt.learning.setup_settings import SetupSettings
from visadapt.learning.windows import Observe, Windows
from visadapt.policies import Policy
from visadapt.progress import Progress, Report, staged
from visadapt.recordings import Episode, read_recording, write_recording
from visadapt.storage.checkpoints import fitting, load_tree, load_weights, save_tree
from visadapt.targets import Target, TargetError
from visadapt.targets.rollout import run
from visadapt.world import World

EXPLORATION = 0.05  # Standard deviation of white noise on the commands while data are collected

FILES = ("recording.h5", "residual.safetensors", "policy.safetensors")  # What the stages of a round leave in its folder


Label = Callable[[list[Episode]], list[Episode]]  # Gives the episodes of a round the states that grounding learns from


@dataclass(frozen=True)
class Round:
    """What a round did: its losses over optimisation steps, and the samples counted when it began to learn."""

    samples: int
    grounding: Sequence[tuple[int, float, float]]  # (step, training loss, held-out loss)
    policy: list[float]  # loss by iteration; empty where the policy was left as it is, since there is no gap
    explanation: Explanation = NOT_DIAGNOSED


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
    folder: Path | None
    """where the run is kept; None: it is not"""
    source: World
    """the source, with the effects that were fitted, and those that the last diagnosis named"""

    def restore(self, policy: Policy, samples: int) -> None:
        """Give `policy`, and the residual it reads, the weights they had after `samples` counted samples.

        Raises:
            ValueError: no round ended there, or the run was not kept.
        """
        if self.folder is None:
            raise ValueError("this run was not kept: give adapt a folder")
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
    settings: SetupSettings,
    folder: Path,
    budget: int,
    round_samples: int,
    seed: int,
    observe: Observe | None = None,
    label: Label | None = None,
    report: Report | None = None,
    explorer: Policy | None = None,
    explain: Explain | None = None,
) -> Adapted:
    """Run Algorithm 1 in `folder`, going on from what is there.

    Args:
        policy, residual: the networks, changed in place; the policy reads the residual.
        source: the physics known beforehand; the parameters of its effects, if it has any, are fitted.
        budget, round_samples: N and B, target samples in all and in a round.
        observe: renders simulated states as the camera would; None where the policy sees what the sensors measure.
        label: estimates the states from the camera's frames; without it, the target's own states are used.
        explorer: the policy that collects the target's data, in place of the one that is tuned (Algorithm 1).
        explain: names the causes of the gap, which are then added to the source. The residual learns the gap only where
            they do not explain it; where there is no gap, the policy gets its weights from before the first round.
            Where other causes explain the data as well, the next round adds to its commands the excitation that tells
            them apart.

    Raises:
        ValueError: an empty round, or a budget that is smaller than a round.
        TargetError: the target misbehaves. BudgetExceeded: a step more than the budget.
        CheckpointError: `folder` holds a run of other networks.
    """
    if round_samples < 1:
        raise ValueError(f"a round needs at least 1 sample, got B = {round_samples}")
    if budget < round_samples:
        raise ValueError(
            f"the budget N = {budget} is smaller than a round of B = {round_samples} samples: raise N or lower B"
        )
    start = {key: value.clone() for key, value in policy.state_dict().items() if not key.startswith("residual.")}
    policy.residual = residual
    untrained = copy.deepcopy(residual.network.state_dict())
    collector = explorer or policy
    known = source
    found = NOT_DIAGNOSED
    learnt = False  # whether the residual has been fitted
    ledger = Ledger(budget)
    recorded: list[Episode] = []
    episodes: list[Episode] = []
    labelled = 0
    rounds: list[Round] = []
    count = math.ceil(budget / round_samples)
    for number in range(count):
        name = f"round {number + 1}/{count}"
        recording, fitted, tuned = (_weights(folder, number).with_name(file) for file in FILES)
        # Each stage draws from its own stream, so that a resumed run draws the same.
        drawn = [torch.Generator().manual_seed(1_000_000 * seed + 10 * number + stage) for stage in range(3)]
        if not recording.exists():
            wanted, longest = min(round_samples, ledger.left), settings.longest_episode
            added = found.experiment(collector, min(wanted, longest)) if found.experiment else None
            write_recording(recording, collect(collector, target, wanted, longest, drawn[0], added))
        new = read_recording(recording)
        for episode in new:
            ledger.count(f"{name}: data", episode.samples)
        recorded += new
        found = explain(recorded, recording.with_name("diagnosis.json")) if explain else NOT_DIAGNOSED
        windows: Windows | None = None
        if not found.complete:
            # Only the residual needs states, and from the frames of a faulty camera none could be estimated.
            episodes += label(recorded[labelled:]) if label else recorded[labelled:]
            labelled = len(recorded)
            windows = Windows.cut(episodes, settings.observations, observe)
        known = source.with_effects([*source.effects, *found.effects])
        first = not found.complete and not learnt
        learnt = learnt or first
        if found.complete:
            residual.network.load_state_dict(untrained)
        grounded = known.with_effects([*known.effects, residual])
        progress = staged(report, f"{name}: ground")
        grounding, windows = _ground(fitted, grounded, known, residual, windows, first, settings, drawn[1], progress)
        if first and settings.feedforward:
            initialise_feedforward(policy, source, residual.scale)
            start["feedforward.weight"] = policy.feedforward.weight.detach().clone()
        no_gap = found.complete and not len(known.effects)
        if settings.trust < 1 or no_gap:
            policy.load_state_dict(start, strict=False)
        world, how, trust = grounded, settings.tuning, settings.trust
        if found.complete:
            world, how, trust = known, settings.with_names(known), 1.0
        if no_gap:
            how = replace(how, iterations=0)  # there is nothing to tune for
        progress = staged(report, f"{name}: tune")
        tuning = _tune(tuned, policy, start, trust, world, observe, how, drawn[2], windows, progress)
        rounds.append(Round(ledger.used, grounding, tuning, found))
    return Adapted(policy, ledger, rounds, [*episodes, *recorded[labelled:]], folder, known)


def _ground(
    path: Path,
    grounded: World,
    known: World,
    residual: Residual,
    windows: Windows | None,
    first: bool,
    settings: SetupSettings,
    generator: torch.Generator,
    progress: Progress | None,
) -> tuple[list[GroundLoss], Windows | None]:
    """Fit the named effects and the residual of `grounded` to the windows, or read what is in `path`.

    Returns the residual's losses, and the windows as `fit_named` leaves them. Without windows nothing is fitted.
    """
    if not path.exists():
        losses: list[GroundLoss] = []
        changed = {}
        if windows is not None:
            true = fit_named(known, windows)
            if first:
                rescale(residual, known, true, settings.ground.negligible)
            losses = ground(residual, known, true, settings.ground, generator, progress)
            changed = {} if true is windows else {"states": true.states, "times": true.times}
        save_tree(path, {"weights": grounded.state_dict(), "losses": losses, "windows": changed})
    tree = load_tree(path)
    with fitting(path):
        load_weights(grounded, tree["weights"], path)
        if windows is not None:
            windows = replace(windows, **tree["windows"])
        return [GroundLoss(*each) for each in tree["losses"]], windows


def _tune(
    path: Path,
    policy: Policy,
    start: Mapping[str, Tensor],
    trust: float,
    world: World,
    observe: Observe | None,
    settings: TuneSettings,
    generator: torch.Generator,
    windows: Windows | None,
    progress: Progress | None,
) -> list[float]:
    """Tune the policy in `world`, then set its weights to start + trust * (tuned - start); or read them from `path`.

    Returns the loss of every iteration.
    """
    if not path.exists():
        partial = path.with_suffix(".partial.safetensors")
        losses = tune(policy, world, observe, settings, generator, windows, progress, partial)
        if trust < 1:
            reached = policy.state_dict()
            way = {key: torch.lerp(start[key], reached[key], trust) for key in start}
            policy.load_state_dict(way, strict=False)
        save_tree(path, {"weights": policy.state_dict(), "losses": losses})
        partial.unlink(missing_ok=True)
    tree = load_tree(path)
    with fitting(path):
        load_weights(policy, tree["weights"], path)
        return list(tree["losses"])


def _weights(folder: Path, number: int) -> Path:
    """Where round `number`, counted from 0, leaves the policy."""
    return folder / f"round-{number + 1:02d}" / "policy.safetensors"


def collect(
    policy: Policy, target: Target, wanted: int, longest: int, generator: torch.Generator, added: Tensor | None = None
) -> list[Episode]:
    """Episodes of `wanted` samples under `policy`, one after the other as on a machine; `added` (steps, n_action) is
    added to the commands of each."""
    episodes: list[Episode] = []
    while wanted > 0:
        episodes.append(run(target, policy, 1, min(wanted, longest), generator, EXPLORATION, added)[0].episode)
        if episodes[-1].samples == 0:
            raise TargetError(f"{target.name}: the episode is over before its first step")
        wanted -= episodes[-1].samples
    return episodes
