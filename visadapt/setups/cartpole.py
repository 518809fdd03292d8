"""The cart-pole from states, and from pixels through a learnt renderer (the paper's sections 3.2.1 to 3.2.3)."""

from __future__ import annotations

import copy
from dataclasses import asdict, replace
from functools import cache, partial
from pathlib import Path

import torch
from torch import Tensor

from renderers import LayeredRenderer, RendererError, load_renderer
from visadapt.effects import CameraEffect
from visadapt.learning.grounding import GroundSettings
from visadapt.learning.perception import PerceptionSettings, train_encoder
from visadapt.learning.setup_settings import SetupSettings
from visadapt.learning.tracking import Tracker
from visadapt.learning.training_state import train_or_load
from visadapt.learning.tuning import TuneSettings
from visadapt.policies import ImagePolicy, Policy, StatePolicy
from visadapt.progress import Report, staged
from visadapt.setups.base import Setup
from visadapt.setups.policy_file import residual_for
from visadapt.systems import CartPole
from visadapt.tasks.balance import CENTRED_CARTPOLE, PAPER_CARTPOLE, Balance, Cost, RegulatorCost, cost_to_go
from visadapt.weights import shipped
from visadapt.world import World

CONTRAST = 0.2  # Grey levels, where white is 1: frames are divided by it before the networks see them

FULL_VIEW = 1.45  # m to either side that a camera must see for `from_frames` as it is; the drawn cart-pole's sees 1.5 m

UNLIMITED = 1e9  # m, no limit on the cart's position: without a camera nothing depends on it

REST_WEIGHTS = (1.0, 6.0, 1.0, 0.1)
"""Weights of x, x_dot, theta and theta_dot squared in tuning; x_dot weighs most, since the cart is scored by it."""


def _near_rest(source: World) -> TuneSettings:
    """How a policy is refined near rest, where it is scored, with a cost-to-go at the end of each plan."""
    to_go = cost_to_go(source, REST_WEIGHTS, Cost.action)
    return TuneSettings(
        Balance(
            RegulatorCost(REST_WEIGHTS, to_go=to_go),
            start_spread=(0.3, 0.1, 0.1, 0.1),
            # The residual would take a kick for a force that lasts.
            kick=(0.0, 0.0, 0.0, 0.0),
            divergence=(1.2, 2.0, 0.25, 3.0),
        ),
        iterations=2000,
        batch=512,
        learning_rate=1.5e-3,
        longest=60,
        streams=64,
        every=5,
        curriculum=False,
    )


def from_states(source: World) -> SetupSettings:
    """Settings for the cart-pole that is shown its states, with the cost-to-go of a source.

    The policy is tuned in closed loop, and gradients flow through the residual: held over a plan, its correction for a
    late motor would not change with the plan's commands. With a residual, which holds near recorded states, most
    streams start from these, and all live long enough to come to rest.
    """
    wide = Balance(PAPER_CARTPOLE, divergence=(UNLIMITED, 4.0, 0.5, 10.0))
    refinement = replace(_near_rest(source), observation_noise=0.0)
    in_closed_loop = replace(refinement, streams=None, every=1, batch=64, iterations=400, closed_loop=True)
    return SetupSettings(
        source=TuneSettings(wide, iterations=3000, learning_rate=3e-3, observation_noise=0.0),
        refinement=refinement,
        # Without noise a policy trusts the residual more than it deserves, and may fall under a late motor; with 0.01
        # it reads too little of a force that changes.
        tuning=replace(in_closed_loop, learning_rate=2e-3, recorded=0.8, observation_noise=0.003),
        named=in_closed_loop,
    )


def from_frames(source: World) -> SetupSettings:
    """Settings for the cart-pole that is shown frames, with the cost-to-go of a source.

    The policy is refined and tuned in closed loop: each imagined step is rendered, and gradients flow through renderer,
    residual and physics.
    """
    in_closed_loop = replace(_near_rest(source), streams=None, every=1, batch=16, iterations=250, closed_loop=True)
    return SetupSettings(
        source=TuneSettings(Balance(CENTRED_CARTPOLE), iterations=2500),
        # After 250 iterations the source policy drives the cart at 0.022 m/s, after 1,000 at 0.019, after these at
        # 0.018; without a refinement at 0.025.
        refinement=replace(in_closed_loop, iterations=2500, learning_rate=1e-3),
        # An iteration takes 0.4 s of CPU. 60 in the first round are too few; so are 30 in later ones with a late motor.
        tuning=replace(in_closed_loop, iterations=100, batch=8, learning_rate=1e-3),
        later=50,
        named=in_closed_loop,
        # After 50 samples of a force that changes, six seeds reach cart speeds of 0.023 to 0.285 m/s with the ridge 0.1
        # alone, and of 0.023 to 0.045 m/s with these ridges to choose from.
        ground=GroundSettings(ridges=(0.1, 0.3, 1.0, 3.0, 10.0)),
        perception=PerceptionSettings(),
    )


def cartpole_states(
    source: World | None = None, with_history: bool = False, settings: SetupSettings | None = None
) -> Setup:
    """The cart-pole that is shown its states.

    Args:
        source: the physics known beforehand; without it, the paper's CartPole, 0.05 s between commands.
        with_history: whether policy and residual read 5 states and actions, or the last alone.
    """
    source = source or World(CartPole())
    return Setup(
        source=source,
        policy=partial(StatePolicy, 4, with_history=with_history),
        residual=residual_for,
        settings=settings or from_states(source),
    )


def cartpole_frames(
    source: World | None = None,
    renderer: LayeredRenderer | Path | str | None = None,
    settings: SetupSettings | None = None,
) -> Setup:
    """The cart-pole that is shown a camera's frames, and learns from these alone.

    Args:
        source: the physics known beforehand, whose states begin with x, x_dot, theta, theta_dot, and what is known of
            the camera's faults; without it, the paper's CartPole, 0.05 s between commands.
        renderer: states to frames, trained, or the file of one; without it, that of the drawn cart-pole.
        settings: how the policy learns; without it, `from_frames`, narrowed to what the renderer's camera sees.

    Raises:
        RendererError: the file holds no layered renderer.
    """
    source = source or World(CartPole())
    given = renderer if isinstance(renderer, LayeredRenderer) else _load(Path(renderer or shipped("renderer")))
    trained = copy.deepcopy(given).requires_grad_(False).eval()
    camera = [effect for effect in source.effects if isinstance(effect, CameraEffect)]
    tracker = Tracker(trained, source.with_effects(()), camera)
    settings = settings or _narrowed(from_frames(source), trained)

    @cache
    def copied(device: torch.device, dtype: torch.dtype) -> LayeredRenderer:
        # The renderer stays where it is: the tracker reads frames of the target with it.
        return copy.deepcopy(trained).to(device, dtype)

    def render(x: Tensor, theta: Tensor) -> Tensor:
        own = trained.background
        here = (x.device, x.dtype) == (own.device, own.dtype)
        return (trained if here else copied(x.device, x.dtype))(x, theta)

    def observe(state: Tensor) -> Tensor:
        return render(state[:, 0], state[:, 2])

    def prepare(policy: Policy, path: Path, seed: int, settings: SetupSettings, report: Report | None) -> None:
        """Train the policy's frame encoder and keep it in `path`, or take the one that is there."""
        assert isinstance(policy, ImagePolicy)
        perception = settings.perception or PerceptionSettings()
        encoder = policy.perception.requires_grad_(True)
        generator, progress = torch.Generator().manual_seed(seed), staged(report, "perception")
        train = partial(train_encoder, encoder, render, source.period, perception, generator, progress)
        train_or_load(path, encoder, {"seed": seed, **asdict(perception)}, train)
        policy.encoder.load_state_dict(encoder.requires_grad_(False).state_dict())

    return Setup(
        source=source,
        policy=lambda: ImagePolicy(trained.background.sigmoid().detach(), CONTRAST),
        residual=partial(residual_for, perception=settings.perception),
        settings=settings,
        renderer=trained,
        observe=observe,
        label=tracker.label,
        prepare=prepare,
    )


def _narrowed(settings: SetupSettings, renderer: LayeredRenderer) -> SetupSettings:
    """The settings with all positions of the cart scaled down, where the camera sees less than `FULL_VIEW`."""
    share = renderer.reach / FULL_VIEW
    if share >= 1:
        return settings

    def narrowed(tune: TuneSettings) -> TuneSettings:
        task = tune.task
        assert isinstance(task, Balance)
        spread, far = (share * task.start_spread[0], *task.start_spread[1:]), task.divergence[1:]
        return replace(tune, task=replace(task, start_spread=spread, divergence=(share * task.divergence[0], *far)))

    own = settings.perception or PerceptionSettings()
    perception = replace(own, cart=replace(own.cart, reach=share * own.cart.reach))
    return replace(
        settings.with_tuning(narrowed),
        source=narrowed(settings.source),
        refinement=narrowed(settings.refinement) if settings.refinement else None,
        perception=perception,
    )


def _load(path: Path) -> LayeredRenderer:
    renderer = load_renderer(path)
    if not isinstance(renderer, LayeredRenderer):
        raise RendererError(f"{path}: holds a {type(renderer).__name__}, a LayeredRenderer is needed")
    return renderer
