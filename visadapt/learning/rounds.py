"""One round of the paper's Algorithm 1: collect, explain, ground, tune.

Each stage writes one file into the folder of its round, under its final name once it is complete, so that an
interrupted run goes on after the last complete stage.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from visadapt.effects import Residual, SensingEffect
from visadapt.learning.collection import Kept, collect
from visadapt.learning.explanation import NOT_DIAGNOSED, Explain, Explanation
from visadapt.learning.feedforward import initialise_feedforward
from visadapt.learning.grounding import GroundLoss, fit_named, ground, rescale
from visadapt.learning.ledger import Ledger
from visadapt.learning.setback import Performance, setback
from visadapt.learning.setup_settings import SetupSettings
from visadapt.learning.stability import early_cost, improved, plan_costs, stable
from visadapt.learning.transitions import Observe, Transitions
from visadapt.learning.tuning import DivergedError, TuneSettings, tune
from visadapt.policies import Policy
from visadapt.policies.networks import FlightResidualNetwork
from visadapt.progress import Progress, Report, staged
from visadapt.recordings import Episode, read_recording, write_recording
from visadapt.storage.checkpoints import CheckpointError, fitting, load_tree, load_weights, save_tree
from visadapt.storage.run_folder import read_json, write_json
from visadapt.systems import System
from visadapt.targets import Target, TaskTarget
from visadapt.tasks.base import Task
from visadapt.world import World

COLLECTING, GROUNDING, TUNING, ACCEPTING = range(4)  # Stages of a round, each with random numbers of its own

LARGEST_SEED = 2**63 - 1  # Seeds are taken modulo this, so that a torch.Generator accepts them

Label = Callable[[list[Episode]], list[Episode]]  # Gives the episodes of a round the states that grounding learns from


@dataclass(frozen=True)
class Round:
    """What a round did: its losses over optimisation steps, and the samples counted when it began to learn."""

    samples: int
    grounding: Sequence[tuple[int, float, float]]  # (step, training loss, held-out loss)
    policy: list[float]
    """loss by iteration; empty where the policy kept its weights: there is no gap, or tuning made it much worse"""
    explanation: Explanation = NOT_DIAGNOSED


@dataclass(frozen=True)
class RoundFolder:
    """Where a round is kept, and the seeds of its stages."""

    path: Path
    name: str  # in progress and ledger
    seed: int  # of the first stage

    @classmethod
    def of(cls, run: Path, number: int, count: int, seed: int) -> RoundFolder:
        """Round `number`, from 0, of `count` rounds in the folder `run`, with the run's seed."""
        path, name = run / f"round-{number + 1:02d}", f"round {number + 1}/{count}"
        # A stage adds its number, below 10, so that no two stages of up to 100,000 rounds share a seed.
        return cls(path, name, (1_000_000 * seed + 10 * number) % LARGEST_SEED)

    @property
    def recording(self) -> Path:
        """Episodes that were collected."""
        return self.path / "recording.h5"

    @property
    def cut(self) -> Path:
        """Which episodes, from 0 on, end where the target failed; missing where none does."""
        return self.path / "cut.json"

    @property
    def diagnosis(self) -> Path:
        """What a diagnosis of all episodes so far found."""
        return self.path / "diagnosis.json"

    @property
    def residual(self) -> Path:
        """Weights of the residual and of the named effects, once they are fitted."""
        return self.path / "residual.safetensors"

    @property
    def policy(self) -> Path:
        """Weights of the policy, once it is tuned."""
        return self.path / "policy.safetensors"

    def generator(self, stage: int) -> torch.Generator:
        """Random numbers of a stage, which a resumed run draws again."""
        return torch.Generator().manual_seed(self.seed + stage)


@dataclass
class JointLearning:
    """A run of Algorithm 1 between two rounds; policy and residual are changed in place.

    A policy that was adapted before collects the first round with the weights of the residual that it has.
    """

    policy: Policy  # reads the residual
    residual: Residual
    source: World  # the physics known beforehand; the parameters of its effects, if it has any, are fitted
    target: Target
    settings: SetupSettings
    ledger: Ledger
    observe: Observe | None = None
    """renders simulated states as the camera would; None where the policy sees what the sensors measure"""
    label: Label | None = None
    """estimates the states from the camera's frames; without it, the target's own states are used"""
    report: Report | None = None
    explorer: Policy | None = None
    """collects the target's data in place of the policy that is tuned"""
    explain: Explain | None = None
    """names the causes of the gap, which are then added to the source. The residual learns the gap only where they do
    not explain it; where there is no gap, the policy gets its weights from before the first round. Where other causes
    explain the data as well, the next round adds to its commands the excitation that tells them apart."""
    recordings: list[Path] = field(default_factory=list)  # of the target, one of each round
    labelled: list[Episode] = field(default_factory=list)  # those with the states that grounding learns from
    waiting: list[Episode] = field(default_factory=list)  # those not labelled yet: no residual has needed them so far
    found: Explanation = NOT_DIAGNOSED  # by the last round's diagnosis
    grounded: bool = False  # whether the residual has been fitted

    def __post_init__(self) -> None:
        self._initial_weights = self._weights()
        """the policy's before the first round, with its feed-forward once that is known"""
        self._tuned_weights: dict[str, Tensor] | None = None
        """the policy's after the last round; None before"""
        self._untrained_residual = copy.deepcopy(self.residual.network.state_dict())
        """weights of a new residual, which it gets back where named causes explain the gap"""
        if self.policy.residual is not None:
            with suppress(CheckpointError):  # one of another architecture is dropped
                load_weights(self.residual, self.policy.residual.state_dict(), Path("the policy's residual"))
        self.policy.residual = self.residual
        self._began_with = copy.deepcopy(self.policy.state_dict())
        self._collected: list[list[Episode]] = []  # those of each round
        self._cut: list[list[int]] = []  # of each round, which episodes end where the target failed

    @property
    def known(self) -> World:
        """The source with the effects that the last diagnosis named."""
        return self.source.with_effects([*self.source.effects, *self.found.effects])

    @property
    def _grounded_world(self) -> World:
        """The known world with the residual."""
        return self.known.with_effects([*self.known.effects, self.residual])

    @property
    def episodes(self) -> list[Episode]:
        """The episodes of the target, with states as far as grounding needed them."""
        return [*self.labelled, *self.waiting]

    def round(self, folder: RoundFolder, samples: int) -> Round:
        """Collect at most `samples`, explain all that was collected, ground, and tune."""
        self._collect(folder, samples)
        if self.explain is not None:
            self.found = self.explain(self.recordings, folder.diagnosis)
            network = self.residual.network
            if isinstance(network, FlightResidualNetwork) and network.predict is not None:
                # A vehicle's disturbance estimate then holds only what source and named effects leave unexplained. A
                # policy that is loaded from its file estimates in the same way.
                network.predict = self.known.steps_along
        if self.found.complete:
            losses: list[GroundLoss] = []
            self.residual.network.load_state_dict(self._untrained_residual)
            tuning = self._tune_with_names(folder)
        else:
            losses, transitions = self._ground(folder)
            tuning = self._tune_with_residual(folder, transitions)
        return Round(self.ledger.used, losses, tuning, self.found)

    def _collect(self, folder: RoundFolder, samples: int) -> None:
        """Collect `samples` steps of the target, but no more than the ledger has left, and enter them in the ledger.

        A round that was interrupted goes on with the next episode or, after its collection, reads its recording.
        """
        kept = Kept(folder.path / "collected")
        if not folder.recording.exists():
            collector, longest = self.explorer or self.policy, self.settings.longest_episode
            wanted = min(samples, self.ledger.left)
            added = self.found.experiment(collector, min(wanted, longest)) if self.found.experiment else None
            generator = folder.generator(COLLECTING)
            episodes = collect(collector, self.target, wanted, longest, generator, added, kept)
            if cut := kept.cut():
                write_json(folder.cut, {"episodes": cut})
            write_recording(folder.recording, episodes)
        kept.remove()
        self.recordings.append(folder.recording)
        collected = read_recording(folder.recording)
        for episode in collected:
            self.ledger.count(f"{folder.name}: data", episode.samples)
        self.waiting += collected
        self._collected.append(collected)
        self._cut.append(read_json(folder.cut)["episodes"] if folder.cut.exists() else [])

    def take_back(self) -> str:
        """Give the policy what it began with, if it did much worse in later rounds' data than in the first's; why, or
        nothing."""
        if self.explorer is not None:
            return ""
        # Of a flight, the target's own task, whose references may be others than those that tuning takes; of frames
        # none, since the target's states are not for a policy that sees frames; nor where sensors are found to be
        # wrong, since a policy that allows for it does well where its readings do not show it.
        task: Task | None = self.settings.tuning.task
        if isinstance(self.target, TaskTarget):
            task = self.target.task
        elif self.observe is not None or any(isinstance(effect, SensingEffect) for effect in self.found.effects):
            task = None
        longest = self.settings.longest_episode
        rounds = zip(self._collected, self._cut, strict=True)
        why = setback([Performance.of(each, longest, task, cut) for each, cut in rounds])
        if why:
            self.policy.load_state_dict(self._began_with)
            self.found = NOT_DIAGNOSED
        return why

    def _transitions(self) -> Transitions:
        """Transitions of all episodes so far, for which the waiting ones are labelled first.

        Labelling waits until here, since only the residual needs states, and none could be estimated from the frames of
        a faulty camera.
        """
        self.labelled += self.label(self.waiting) if self.label else self.waiting
        self.waiting = []
        return Transitions.cut(self.labelled, frames=self.observe is not None)

    def _ground(self, folder: RoundFolder) -> tuple[list[GroundLoss], Transitions]:
        """Fit the named effects and the residual to all samples; the residual's losses, and the transitions with the
        states and times that `fit_named` gives them."""
        transitions, known, world = self._transitions(), self.known, self._grounded_world
        if not folder.residual.exists():
            refined = fit_named(known, transitions)
            on_device = refined.to(self.residual.scale)
            if not self.grounded:
                rescale(self.residual, known, on_device, self.settings.ground.negligible)
            losses = self._fit_residual(folder, on_device)
            changed = {} if refined is transitions else {"states": refined.states, "times": refined.times}
            save_tree(folder.residual, {"weights": world.state_dict(), "losses": losses, "windows": changed})
        tree = load_tree(folder.residual)
        with fitting(folder.residual):
            load_weights(world, tree["weights"], folder.residual)
            transitions = replace(transitions, **tree["windows"])
            return [GroundLoss(*each) for each in tree["losses"]], transitions

    def _fit_residual(self, folder: RoundFolder, transitions: Transitions) -> list[GroundLoss]:
        """Fit the residual, again with the next larger ridge where the policy is unstable in the world with it."""
        self._begin_tuning()
        world, settings = self._grounded_world, self.settings.tuning
        settings = replace(settings, task=settings.task.in_world(world))

        def accept() -> bool:
            return stable(self._plan_costs(folder, world, settings, transitions))

        generator, progress = folder.generator(GROUNDING), self._progress(folder, "ground")
        return ground(self.residual, self.known, transitions, self.settings.ground, generator, progress, accept)

    def _begin_tuning(self) -> None:
        """Give the policy the weights that tuning with the residual begins with.

        Also called before the residual is fitted: a fit is accepted where this policy is stable.
        """
        if not self.grounded:
            self._tuned_weights = None  # Those tuned with names alone have no feed-forward
            if self.settings.feedforward:
                initialise_feedforward(self.policy, self.source, self.residual.scale)
                self._initial_weights["feedforward.weight"] = self.policy.feedforward.weight.detach().clone()
        if not self.settings.tunes_on:
            self._restore_initial_weights()

    def _tune_with_residual(self, folder: RoundFolder, transitions: Transitions) -> list[float]:
        """Tune the policy in the source with the named effects and the residual; the loss of every iteration."""
        self._begin_tuning()
        self.grounded = True
        return self._tune(folder, self._grounded_world, self.settings.tuning, transitions)

    def _tune_with_names(self, folder: RoundFolder) -> list[float]:
        """Tune the policy in the source with the named effects alone; where there is no gap, it gets its weights from
        before the first round."""
        world, settings = self.known, self.settings.with_names
        no_gap = not len(world.effects)
        if no_gap or not self.settings.tunes_on:
            self._restore_initial_weights()
        return self._tune(folder, world, replace(settings, iterations=0) if no_gap else settings)

    def _take_tuned_weights(self, cost: float, costs: Callable[[], Iterator[float]]) -> float:
        """Give the policy the weights of the round before, if it then costs less than the `cost` with those it has;
        returns the lower cost. `costs` gives the policy's `plan_costs` in the world where it is to be tuned."""
        if self._tuned_weights is None:
            return cost
        present = self._weights()
        self.policy.load_state_dict(self._tuned_weights, strict=False)
        if (lower := early_cost(costs())) < cost:
            return lower
        self.policy.load_state_dict(present, strict=False)
        return cost

    def _plan_costs(
        self, folder: RoundFolder, world: World, settings: TuneSettings, transitions: Transitions | None
    ) -> Iterator[float]:
        """Costs of the policy's plans in `world`; all policies of a round start in the same states."""
        return plan_costs(self.policy, world, self.observe, settings, folder.generator(ACCEPTING), transitions)

    def _weights(self) -> dict[str, Tensor]:
        """A copy of the policy's weights, without those of the residual."""
        weights = self.policy.state_dict()
        return {key: value.clone() for key, value in weights.items() if not key.startswith("residual.")}

    def _restore_initial_weights(self) -> None:
        """Give the policy its weights from before the first round."""
        self.policy.load_state_dict(self._initial_weights, strict=False)

    def _tune(
        self, folder: RoundFolder, world: World, settings: TuneSettings, transitions: Transitions | None = None
    ) -> list[float]:
        """Tune the policy in `world`, or give it the weights of a round that was tuned before; the losses."""
        path, settings = folder.policy, replace(settings, task=settings.task.in_world(world))
        if not path.exists():
            unfinished = path.with_suffix(".partial.safetensors")
            losses = self._improve(folder, world, settings, transitions, unfinished) if settings.iterations else []
            save_tree(path, {"weights": self.policy.state_dict(), "losses": losses})
            unfinished.unlink(missing_ok=True)
        tree = load_tree(path)
        with fitting(path):
            load_weights(self.policy, tree["weights"], path)
        self._tuned_weights = self._weights()
        return list(tree["losses"])

    def _improve(
        self,
        folder: RoundFolder,
        world: World,
        settings: TuneSettings,
        transitions: Transitions | None,
        unfinished: Path,
    ) -> list[float]:
        """Tune the policy in `world`; the losses, none where that makes it much worse.

        It goes on, with fewer iterations, from the weights of the round before, where these cost less in `world`. The
        training is kept in the file `unfinished`.
        """
        costs = partial(self._plan_costs, folder, world, settings, transitions)
        cost, later = early_cost(costs()), self.settings.later
        if later is not None and (lower := self._take_tuned_weights(cost, costs)) < cost:
            cost, settings = lower, replace(settings, iterations=min(later, settings.iterations))
        generator, progress = folder.generator(TUNING), self._progress(folder, "tune")
        given = (self.policy, world, self.observe, settings, generator, transitions, progress, unfinished)
        try:
            return improved(self.policy, cost, costs, partial(tune, *given))
        except DivergedError as error:
            states = [episode.state for episode in self.labelled if episode.state is not None]
            raise DivergedError(f"{error}{out_of_range(states, self.source.system)}") from error

    def _progress(self, folder: RoundFolder, stage: str) -> Progress | None:
        return staged(self.report, f"{folder.name}: {stage}")


def out_of_range(states: Sequence[NDArray[np.floating]], system: System) -> str:
    """A hint at the state that is furthest out of its range in rows (T, n_state) of a target; empty where none is."""
    if not states:
        return ""
    reached = np.abs(np.concatenate(states)).max(0)
    beyond = [size / one.largest for size, one in zip(reached, system.states, strict=False)]
    worst = int(np.argmax(beyond))
    one = system.states[worst]
    if beyond[worst] <= 1:
        return ""
    return (
        f"; {one.name} of the target reaches {reached[worst]:.3g}, of a range up to {one.largest:g} {one.unit}: is it "
        "in another unit?"
    )
