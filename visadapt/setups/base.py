"""The pieces of one control problem put together: pretraining in the source, tuning, adaptation to a target."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import nn

from visadapt.effects import Effect, Residual, Stage
from visadapt.effects.catalogue import sized
from visadapt.estimation.effect_fit import check_fittable
from visadapt.learning.joint import Adapted, adapt
from visadapt.learning.ledger import Ledger
from visadapt.learning.rounds import JointLearning, Label
from visadapt.learning.setup_settings import SetupSettings
from visadapt.learning.training_state import train_or_load
from visadapt.learning.transitions import Observe
from visadapt.learning.tuning import TuneSettings, tune
from visadapt.policies import ImagePolicy, Policy
from visadapt.progress import Report, staged
from visadapt.setups.explained import check_diagnosable, explained
from visadapt.setups.policy_file import describe, load_into, parameters_of
from visadapt.storage.checkpoints import weights_digest
from visadapt.storage.run_folder import open_run
from visadapt.systems import System
from visadapt.targets import Target
from visadapt.targets.base import periods_differ
from visadapt.tasks.base import Task
from visadapt.world import World

Prepare = Callable[[Policy, Path, int, SetupSettings, Report | None], None]
"""Prepares a new policy for training; called with (policy, file, seed, settings, report). Writes its result to the file
or, where the file exists, reads it from there."""

Made = TypeVar("Made")

NEWER_SETTINGS = ("perception", "refinement")
"""Policy files of earlier versions do not state these; such files are taken as they are."""


@dataclass(frozen=True)
class Setup:
    """One control problem: a source, what the policy is to do and is shown, and how it learns.

    `cartpole_states`, `cartpole_frames`, `quadrotor` and `fixed_wing` make those of the paper. A setup of one's own
    needs the four fields without a default, and a task in its settings.

    >>> import visadapt as va
    >>> from visadapt.setups.cartpole import cartpole_states
    >>> setup = cartpole_states(va.World(va.CartPole(pole_mass=0.2)))
    >>> setup.load(va.shipped("cartpole_states")).n_action
    1
    """

    source: World
    """the physics known beforehand; adaptation fits the parameters of its effects, if it has any"""
    policy: Callable[[], Policy]
    """makes a new policy"""
    residual: Callable[[Policy, World], Residual]
    """makes a new residual for a policy in the source"""
    settings: SetupSettings
    renderer: nn.Module | None = None
    """makes the frames that a policy is shown: cart position (B,) in m, pole angle (B,) in rad to frames (B, H, W)"""
    observe: Observe | None = None
    """renders simulated states (B, n_state) as the camera would; None where the policy sees what the sensors measure"""
    label: Label | None = None
    """estimates the states of recorded episodes from their frames; without it, the target's own states are used"""
    prepare: Prepare | None = None
    """called on a new policy before it is trained"""
    test: Task | None = None
    """the task that the policy is scored in; None: the one it is trained in"""

    def __post_init__(self) -> None:
        for effect in self.source.effects:
            if isinstance(effect, Residual):
                raise ValueError("the source has a residual, which is learnt for a target: give the source without it")
            rows = max((p.numel() for p in effect.parameters()), default=1)
            if rows > 1:
                raise ValueError(
                    f"the source's {effect.name} has {rows} values of a parameter, one for each row of a batch; a "
                    "setup needs one value of each, which holds for batches of any size"
                )
        system = type(self.source.system)
        if "name" not in vars(system):
            raise ValueError(
                f"{system.__name__} has the name of the class that it derives from, {system.name!r}, which a policy's "
                "file would be read with: give it a name of its own"
            )
        commands = torch.stack(_seeded(0, self.policy).command_range, 1)
        for action, ours in zip(self.source.system.actions, commands, strict=True):
            if not torch.allclose(ours, ours.new_tensor([action.low, action.high])):
                low, high = ours.tolist()
                raise ValueError(
                    f"{action.name} of a {self.source.system.name} ranges from {action.low:g} to {action.high:g} "
                    f"{action.unit}, the commands of the policy from {low:g} to {high:g}: give the action that range, "
                    "and let the system's derivative multiply it by its largest value"
                )

    def pretrain(self, path: Path, seed: int, report: Report | None = None) -> Policy:
        """The policy trained in the source, or read from `path` where that exists; an interrupted training goes on.

        Raises:
            CheckpointError: `path` holds another network, or one that was trained in another way.
        """
        policy, refinement = _seeded(seed, self.policy), self.settings.refinement
        prepared, unrefined = (path.with_suffix(f".{stage}.safetensors") for stage in ("prepared", "rough"))
        if self.prepare is not None and not path.exists():
            self.prepare(policy, prepared, seed, self.settings, report)
        numbers = self.settings.numbers()
        about_unrefined = {"arguments": policy.arguments, "source": describe(self.source), "seed": seed}
        about_unrefined |= {**numbers["source"], "perception": numbers["perception"]}
        about = {**about_unrefined, "refinement": numbers["refinement"]}
        # `prepare` draws from a generator of `seed` itself, so training uses the seeds after it.
        first_seed = seed if self.prepare is None else seed + 1

        def train(file: Path, about: dict[str, Any], settings: TuneSettings, seed: int, name: str) -> None:
            generator = torch.Generator().manual_seed(seed)
            progress = staged(report, f"{self.source.system.name}: {name}")
            tuned = partial(tune, policy, self.source, self.observe, settings, generator, None, progress)
            train_or_load(file, policy, about, tuned, NEWER_SETTINGS)

        if refinement is None:
            train(path, about, self.settings.source, first_seed, "source policy")
        else:
            if not path.exists():
                train(unrefined, about_unrefined, self.settings.source, first_seed, "source policy")
            train(path, about, refinement, first_seed + 1, "source policy, refined")
        for finished in (prepared, unrefined):
            finished.unlink(missing_ok=True)
        policy.trained_in = describe(self.source)
        return policy.eval()

    def load(self, path: Path) -> Policy:
        """A policy that `pretrain`, or after `adapt` `save_policy`, wrote, with the residual that it reads.

        Raises:
            CheckpointError: there is no file, or one of another network.
        """
        return load_into(path, self.policy(), self.residual)

    def tune(self, policy: Policy, seed: int, report: Report | None = None) -> list[float]:
        """Tune `policy`, in place, in the source with its effects, without a target; returns the loss by iteration.

        A residual that it has of an earlier adaptation, which the source does not contain, is taken away.

        Raises:
            ValueError: a policy of another kind.
        """
        self.check_policy(policy)
        policy.residual, policy.grounded_in = None, None
        policy.trained_in = describe(self.source)
        generator, progress = torch.Generator().manual_seed(seed), staged(report, "tune")
        return tune(policy, self.source, self.observe, self.settings.with_names, generator, None, progress)

    def adapt(
        self,
        policy: Policy,
        target: Target,
        folder: Path,
        budget: int,
        round_samples: int,
        seed: int,
        report: Report | None = None,
        explorer: Policy | None = None,
        diagnose: bool = False,
    ) -> Adapted:
        """Adapt `policy`, in place, to `target` with at most `budget` counted samples: Algorithm 1 in `folder`.

        A policy that was adapted before collects the first round with the residual that it has, if that is one of this
        setup; the residual is then fitted to the new samples alone.

        Args:
            explorer: collects the data in place of `policy`.
            diagnose: name the causes of the gap in each round: `explained`.

        Raises:
            ValueError: as `check_adaptation`, a budget that is smaller than a round, or rounds or episodes that are
                too short to diagnose.
            TargetError: the target misbehaves. CheckpointError: `folder` holds a run of other networks.
            RunError: it holds one that was asked for otherwise: of another policy, source, or target. A target is
                known by its name and, where it has one, its system.
        """
        self.check_adaptation(policy, target)
        if diagnose:
            check_diagnosable(self.source, min(round_samples, self.settings.longest_episode))
        asked = {"target": target.name, "samples": budget, "round": round_samples, "seed": seed, "diagnose": diagnose}
        asked["machine"] = parameters_of(target.system) if isinstance(target.system, System) else None
        asked |= {"policy": weights_digest(policy), "explorer": None if explorer is None else weights_digest(explorer)}
        open_run(folder, {**asked, "known": describe(self.source), **self.settings.numbers()}, "adaptation.json")
        residual = _seeded(seed, partial(self.residual, policy, self.source)).to(next(policy.parameters()))
        explain = explained(self.source, self.renderer, seed, report) if diagnose else None
        learning = JointLearning(
            policy,
            residual,
            self.source,
            target,
            self.settings,
            Ledger(budget),
            observe=self.observe,
            label=self.label,
            report=report,
            explorer=explorer,
            explain=explain,
        )
        adapted = adapt(learning, folder, round_samples, seed)
        policy.grounded_in = describe(adapted.source)
        return adapted

    def check_adaptation(self, policy: Policy, target: Target) -> None:
        """Raises ValueError where `adapt` cannot begin: a policy of another kind, a target of another period or with
        other actions, effects of the source that cannot be fitted, or effects of the camera, such as a delay, with
        which no states can be estimated from frames."""
        self.check_policy(policy)
        self.check_target(target)
        system = self.source.system
        named = [each for each in self.source.effects if isinstance(each, Effect) and each.stage is not Stage.CAMERA]
        check_fittable([sized(type(each), system) for each in named], system)
        if self.label is not None:
            self.label([])  # raises where no states can be estimated

    def check_policy(self, policy: Policy) -> None:
        """Raises ValueError where `policy` is not one that this setup makes."""
        wanted = _seeded(0, self.policy)
        if type(policy) is not type(wanted) or (policy.n_state, policy.n_action) != (wanted.n_state, wanted.n_action):
            raise ValueError(
                f"the policy is a {type(policy).__name__} of {policy.n_state} states and {policy.n_action} commands; "
                f"a {self.source.system.name} needs a {type(wanted).__name__} of {wanted.n_state} and {wanted.n_action}"
            )
        if isinstance(policy, ImagePolicy) and isinstance(wanted, ImagePolicy):
            own, ours = (each.perception.background.double().cpu() for each in (policy, wanted))
            if own.shape != ours.shape or not torch.allclose(own, ours):
                raise ValueError(
                    "the policy was not trained with this renderer: give the one that it was trained with (--renderer)"
                )
        own_period, period = (each.arguments.get("period", self.source.period) for each in (policy, wanted))
        if periods_differ(own_period, period):
            raise ValueError(
                f"the policy aims at goals {own_period:g} s apart, the source has {period:g} s between actions"
            )

    def check_target(self, target: Target) -> None:
        """Raises ValueError where `target` has another period or another number of actions than the source."""
        if periods_differ(target.period, self.source.period):
            raise ValueError(
                f"{target.name} has {target.period:g} s between actions, the source {self.source.period:g} s: "
                f"make the source World(system, period={target.period:g})"
            )
        actions = len(self.source.system.actions)
        if target.n_action != actions:
            raise ValueError(
                f"{target.name} takes {target.n_action} actions, a {self.source.system.name} has {actions}"
            )


def _seeded(seed: int, make: Callable[[], Made]) -> Made:
    """What `make` makes with random numbers of `seed`; torch's own generator is left as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return make()
