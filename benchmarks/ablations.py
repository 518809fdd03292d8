"""What each part of an adaptation is worth, on six targets, at 200 counted samples, and what knowing the effect is.

    python -m benchmarks.ablations
    python -m benchmarks.ablations --shown states --out results/ablations_states.csv

Each seed adapts the source policy anew, as shipped and with a part left out, and is scored on episodes whose starts
no training saw. No score chooses anything. From frames the source policy is the shipped one; from states, where the
networks see 5 states and actions, it is trained first. "true effect" has what is hidden in the simulator, and takes no
samples: the source policy is tuned there, or a new one trained. Interrupt it anywhere; started again, it goes on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
import tyro
from torch import Tensor, nn

from experiments.cartpole_targets import TARGETS, Shown, experiment, source, target, unadapted_score
from experiments.kept_scores import kept_score
from experiments.parallel import Jobs, in_processes
from experiments.result_tables import print_speed, speed_row, write_rows
from renderers import load_renderer
from visadapt.effects import Residual
from visadapt.evaluation import CartPoleScore
from visadapt.history import History
from visadapt.policies import ImagePolicy, Policy, StatePolicy
from visadapt.policies.networks import (
    ImageResidualNetwork,
    ResidualNetwork,
    StateHistoryResidualNetwork,
    StateResidualNetwork,
    mlp,
)
from visadapt.setups.base import Setup
from visadapt.setups.cartpole import from_states
from visadapt.storage.run_folder import open_run
from visadapt.targets import SyntheticTarget
from visadapt.world import World

SAMPLES = 200
ROUND_SAMPLES = 100

Variant = Callable[[Setup, Policy], Setup]


class NoGradient(Residual):
    """A residual past which no gradient flows."""

    def delta(self, history: History) -> Tensor:
        return super().delta(history).detach()


def _changed(setup: Setup, change: Callable[[Residual], Residual]) -> Setup:
    """The setup with each new residual changed."""
    return replace(setup, residual=lambda policy, source: change(setup.residual(policy, source)))


def past_the_residual(setup: Setup, policy: Policy) -> Setup:
    """The residual acts on what is imagined, but the gradient flows through renderer and physics alone."""
    return _changed(setup, lambda made: NoGradient(made.network, made.scale))


def past_the_renderer(setup: Setup, policy: Policy) -> Setup:
    """Frames are rendered, but the gradient flows through physics and residual alone."""
    render = setup.observe
    assert render is not None
    return replace(setup, observe=lambda states: render(states).detach())


def output_layer_alone(setup: Setup, policy: Policy) -> Setup:
    """Of the policy, the maps to the plan alone are tuned: that of the last hidden layer, and the feed-forward."""
    assert isinstance(policy, (ImagePolicy, StatePolicy))
    policy.requires_grad_(False)
    last = policy.out if isinstance(policy, ImagePolicy) else policy.rest[-1]
    last.requires_grad_(True)
    return setup


def untuned(setup: Setup, policy: Policy) -> Setup:
    """The feed-forward on the residual, in closed form, and no backpropagation."""
    tuning = replace(setup.settings.tuning, iterations=0)
    return replace(setup, settings=replace(setup.settings, tuning=tuning))


def held_over_a_plan(setup: Setup, policy: Policy) -> Setup:
    """The residual's correction is constant over a plan, so that the gradient flows through the physics alone."""
    plans, own = from_states(setup.source).refinement, setup.settings.tuning
    assert plans is not None
    held = replace(plans, iterations=300, streams=32, recorded=own.recorded, observation_noise=own.observation_noise)
    return replace(setup, settings=replace(setup.settings, tuning=held))


def with_an_mlp(setup: Setup, policy: Policy) -> Setup:
    """The paper's head of the residual: two hidden layers of 64, fitted by gradient descent."""

    def change(made: Residual) -> Residual:
        network = made.network
        assert isinstance(network, ResidualNetwork)
        assert isinstance(network.head, nn.Linear)
        network.head = mlp(network.head.in_features, 64, 64, network.head.out_features)
        for weight in network.head[-1].parameters():
            nn.init.zeros_(weight)
        return made

    return _changed(setup, change)


def without_history(setup: Setup, policy: Policy) -> Setup:
    """The paper's residual of one state and action, without a history; the policy still reads 5 of each."""

    def residual(policy: Policy, source: World) -> Residual:
        return Residual(StateResidualNetwork(policy.n_state, policy.n_action), torch.ones(policy.n_state))

    return replace(setup, residual=residual)


def without_unexplained_accelerations(setup: Setup, policy: Policy) -> Setup:
    """The residual reads the observed motion and the commands, but not the accelerations that the source leaves."""

    def change(made: Residual) -> Residual:
        network = made.network
        assert isinstance(network, (ImageResidualNetwork, StateHistoryResidualNetwork))
        all_of_them = network.unexplained
        network.unexplained = lambda *given: torch.zeros_like(all_of_them(*given))  # type: ignore[method-assign]
        return made

    return _changed(setup, change)


def with_an_mlp_renderer(setup: Setup, policy: Policy) -> Setup:
    """Streams are seen through the paper's renderer, four layers of neurons; the tracker keeps ours."""
    renderer = load_renderer(Path("assets/renderer_mlp.safetensors")).requires_grad_(False)
    return replace(setup, observe=lambda states: renderer(states[:, 0], states[:, 2]))


def with_smallest_ridge(setup: Setup, policy: Policy) -> Setup:
    """The residual is fitted with the smallest ridge, however it predicts, and whether or not the policy holds."""
    ground = setup.settings.ground
    return replace(setup, settings=replace(setup.settings, ground=replace(ground, ridges=ground.ridges[:1])))


def _with(**changed: object) -> Variant:
    return lambda setup, policy: replace(setup, settings=replace(setup.settings, **changed))  # type: ignore[arg-type]


VARIANTS: dict[str, Variant] = {
    "as shipped": lambda setup, policy: setup,
    "no tuning": untuned,
    "no feed-forward": _with(feedforward=False),
    "each round tunes on": _with(tunes_on=True, later=None),
    "each round from the source policy": _with(later=None),
    "smallest ridge": with_smallest_ridge,
    "output layer alone": output_layer_alone,
    "gradient past the renderer": past_the_renderer,
    "gradient past the residual": past_the_residual,
    "correction held over a plan": held_over_a_plan,
    "no history": without_history,
    "no unexplained accelerations": without_unexplained_accelerations,
    "MLP residual": with_an_mlp,
    "MLP renderer": with_an_mlp_renderer,
}


WITHOUT: dict[Shown, tuple[str, ...]] = {
    "frames": ("no history",),
    "states": ("gradient past the renderer", "MLP renderer"),
}
"""Variants that there are not: frames always have a history, states no renderer."""


def tuned_with_the_truth(setup: Setup, policy: Policy, folder: Path, seed: int) -> Policy:
    """The policy tuned in the true physics."""
    setup.tune(policy, seed)
    return policy


def trained_with_the_truth(setup: Setup, policy: Policy, folder: Path, seed: int) -> Policy:
    """A new policy, trained in the true physics."""
    return setup.pretrain(folder / "policy.safetensors", seed)


KNOWING: dict[str, Callable[[Setup, Policy, Path, int], Policy]] = {
    "true effect, tuned": tuned_with_the_truth,
    "true effect, trained anew": trained_with_the_truth,
}
"""By name: makes a policy in a simulator that has the target's effects, which takes no samples of the target."""


def _in_the_true_physics(setup: Setup, machine: SyntheticTarget, seed: int) -> Setup:
    """The setup whose source is the target's system with its effects.

    A force that changes has one phase, but streams begin at any time of an episode.
    """
    effects = machine.draw_effects(1, torch.Generator().manual_seed(seed))
    return replace(setup, source=World(machine.system, effects, machine.period))


@dataclass(frozen=True)
class Settings:
    """What is run, and where."""

    shown: Shown = "frames"
    """what the policy sees"""
    seeds: int = 3
    episodes: int = 60
    targets: tuple[str, ...] = tuple(TARGETS)
    """which of TARGETS"""
    variants: tuple[str, ...] = ()
    """which of VARIANTS and KNOWING; by default all that there are for what the policy sees"""
    jobs: Jobs = 2
    """adaptations at once, one core each"""
    work: Path = Path("runs/ablations")
    out: Path = Path("results/ablations.csv")


def main(settings: Settings) -> None:
    """Run what is missing, then write the table."""
    settings = replace(settings, work=settings.work / settings.shown)
    variants = settings.variants or [name for name in (*VARIANTS, *KNOWING) if name not in WITHOUT[settings.shown]]
    rows = []
    if settings.shown == "states":
        source(settings.shown, settings.work)
    jobs = [
        (name, variant, seed) for name in settings.targets for variant in variants for seed in range(settings.seeds)
    ]
    unadapted = in_processes(unadapted_score, settings, [(name,) for name in settings.targets])
    found = in_processes(_after, settings, jobs)
    for name in settings.targets:
        rows.append(speed_row(experiment(name, settings.shown), "unadapted", "target", 0, [unadapted[(name,)]]))
        for variant in variants:
            scores = [found[name, variant, seed] for seed in range(settings.seeds)]
            samples = 0 if variant in KNOWING else SAMPLES
            rows.append(speed_row(experiment(name, settings.shown), variant, "adapted", samples, scores))
    write_rows(settings.out, rows)
    for row in rows:
        print_speed(row)


def _after(settings: Settings, name: str, variant: str, seed: int) -> CartPoleScore:
    torch.set_num_threads(1)
    setup, policy = source(settings.shown, settings.work)
    machine, folder = target(name, settings.shown), settings.work / name / variant / f"seed-{seed}"
    setup = _in_the_true_physics(setup, machine, seed) if variant in KNOWING else VARIANTS[variant](setup, policy)
    about = {"shown": settings.shown, "seed": seed, "episodes": settings.episodes}
    open_run(folder, {**about, **setup.settings.numbers()})
    path = folder / "score.json"
    if not path.exists():
        if variant in KNOWING:
            policy = KNOWING[variant](setup, policy, folder, seed)
        else:
            setup.adapt(policy, machine, folder, SAMPLES, ROUND_SAMPLES, seed)
    return kept_score(path, policy, machine, settings.episodes)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
