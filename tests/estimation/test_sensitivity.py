"""The response of innovations to effects, against integration in short steps: at short periods, where no effect is
integrated, and in a fast motion, where the screening takes longer steps than a fit."""

import numpy as np
import pytest
import torch

from tests.own_systems import DoublePendulum
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.search.search import Search
from visadapt.effects import ActuationEffect, DynamicsEffect, PeriodicForce
from visadapt.effects.catalogue import catalogue
from visadapt.estimation.candidate import FINE, SHORT_PERIOD, CandidateModel, linearise
from visadapt.estimation.effect_fit import remembers
from visadapt.estimation.grids import grid, neutral_point, spans
from visadapt.estimation.sensitivity import Sensitivity
from visadapt.recordings import Episode, Recording
from visadapt.systems import CartPole
from visadapt.world import World

SYSTEM = CartPole()
ANSWERED_BY_SLOPES = [
    effect
    for effect in catalogue(SYSTEM)
    if (issubclass(effect, ActuationEffect) or (issubclass(effect, DynamicsEffect) and effect.only_loads()))
    and not effect.repeats_readings
]
PENDULUM = DoublePendulum()
INTEGRATED = [
    effect
    for effect in catalogue(PENDULUM)
    if issubclass(effect, ActuationEffect | DynamicsEffect)
    and not (effect.repeats_readings or remembers(effect, PENDULUM) or effect.name.endswith("saturation"))
]


def along(world, start, commands, noise):
    """The source along a motion that `commands` (T, n_action) drive from a state, of which the states with noise are
    measured, with its fit and what adding effects to it changes."""
    system, read = world.system, [k for k, deviation in enumerate(noise) if deviation]
    with torch.no_grad():
        at, states = world.start(torch.tensor([start], dtype=torch.float64)), []
        for command in torch.tensor(commands):
            states.append(at.state[0])
            at = world.step(at, command[None])
    clean, generator = torch.stack(states)[:, read], torch.Generator().manual_seed(0)
    deviations = torch.tensor(noise, dtype=torch.float64)[read]
    measured = clean + deviations * torch.randn(clean.shape, generator=generator, dtype=torch.float64)
    episode = Episode(world.period * np.arange(len(commands)), commands, measured.numpy())
    names = tuple(system.states[k].name for k in read)
    rows = prepare(Recording((episode,), names, world.period, ("moving",)), system).rows
    fits = Search(system, rows, ()).source.fits
    return rows, fits, Sensitivity.on_every(1, system, (), fits, rows)


@pytest.fixture(scope="module")
def source():
    """400 rows of a cart-pole, 4 ms apart, whose positions are measured."""
    commands = 0.9 * np.sin(9 * 0.004 * np.arange(400))[:, None]
    found = along(World(SYSTEM, period=0.004), [0.0, 0.0, 0.1, 0.0], commands, [1e-3, 0, 1e-3, 0])
    assert found[0].period <= SHORT_PERIOD
    return found


def off(system, effect, rows, fits, sensitivity):
    """The error of the response to a small effect, as a share of the response by integration in short steps."""
    points = grid(effect, spans(system, rows, fits.state[0]))
    point = points[len(points) // 2].clone()
    neutral = neutral_point(effect)
    for k, parameter in enumerate(effect.table):
        if parameter.linear:
            point[k] = neutral[k] + 0.05 * (parameter.high - neutral[k])
    without = torch.where(torch.tensor([p.neutral is None for p in effect.table]), point, neutral)
    found = sensitivity.around(effect, point[None], ())[0][:, 0]
    model = CandidateModel(system, [effect], rows, FINE)
    after, before = (linearise(model, theta, fits.state[0]).next_state for theta in (point, without))
    drive = (after - before)[..., None] * rows.inside[:, 1:, None, None]
    expected = sensitivity.innovations.response(drive, torch.zeros_like(rows.measured[..., None]))[:, 0]
    return float((found - expected).norm()) / float(expected.norm())


@pytest.mark.parametrize("effect", ANSWERED_BY_SLOPES, ids=lambda effect: effect.name)
def test_the_response_is_that_of_integrated_steps(source, effect):
    assert off(SYSTEM, effect, *source) < 0.1


@pytest.fixture(scope="module")
def fast():
    """300 rows of a double pendulum, 20 ms apart, that turns at up to 15 rad/s."""
    time = 0.02 * np.arange(300)
    commands = np.column_stack([0.5 * np.sin(2.1 * time), 0.3 * np.sin(3.7 * time)])
    world = World(PENDULUM, period=0.02, substeps=20)
    found = along(world, [1.5, 1.0, 0.0, 0.0], commands, [1e-3, 1e-3, 2e-2, 2e-2])
    assert found[0].longest_step < found[0].period
    return found


@pytest.mark.parametrize("effect", INTEGRATED, ids=lambda effect: effect.name)
def test_the_response_of_a_fast_motion_is_that_of_short_steps(fast, effect):
    assert off(PENDULUM, effect, *fast) < 0.2


@pytest.mark.parametrize("frequency", [0.3, 1.1, 4.0])
def test_the_pulls_of_all_rows_add_up_to_that_of_a_force_that_comes_and_goes(source, frequency):
    rows, _, sensitivity = source
    point = torch.tensor([[0.0, frequency, 0.4, 0.0]], dtype=torch.float64)
    expected = -sensitivity.by_unit(PeriodicForce, point, [0])[:, 0, 0] @ sensitivity.innovations.error
    pull = sensitivity.pull(PeriodicForce, torch.zeros(4, dtype=torch.float64), 0)
    time = (rows.time[:, :-1] + rows.time[:, 1:]) / 2
    found = (pull * (2 * torch.pi * frequency * time + 0.4).cos()).sum()
    assert float(found) == pytest.approx(float(expected), rel=0.02)
