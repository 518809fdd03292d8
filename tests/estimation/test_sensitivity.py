"""The response of innovations to effects at short periods, where no effect is integrated, against integration."""

import numpy as np
import pytest
import torch

from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.search.search import Search
from visadapt.effects import ActuationEffect, DynamicsEffect, PeriodicForce
from visadapt.effects.catalogue import catalogue
from visadapt.estimation.candidate import FINE, SHORT_PERIOD, CandidateModel, linearise
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


@pytest.fixture(scope="module")
def source():
    """The source along 400 rows, 4 ms apart, with its fit and what adding effects to it changes."""
    world, time = World(SYSTEM, period=0.004), 0.004 * np.arange(400)
    commands = torch.tensor(0.9 * np.sin(9 * time))[:, None]
    with torch.no_grad():
        at, states = world.start(torch.tensor([[0.0, 0.0, 0.1, 0.0]], dtype=torch.float64)), []
        for command in commands:
            states.append(at.state[0])
            at = world.step(at, command[None])
    generator = torch.Generator().manual_seed(0)
    measured = torch.stack(states)[:, [0, 2]]
    measured = measured + 1e-3 * torch.randn(measured.shape, generator=generator, dtype=torch.float64)
    episode = Episode(time, commands.numpy(), measured.numpy())
    rows = prepare(Recording((episode,), ("x", "theta"), 0.004, ("swinging",)), SYSTEM).rows
    assert rows.period <= SHORT_PERIOD
    fits = Search(SYSTEM, rows, ()).source.fits
    return rows, fits, Sensitivity.on_every(1, SYSTEM, (), fits, rows)


@pytest.mark.parametrize("effect", ANSWERED_BY_SLOPES, ids=lambda effect: effect.name)
def test_the_response_is_that_of_integrated_steps(source, effect):
    rows, fits, sensitivity = source
    points = grid(effect, spans(SYSTEM, rows, fits.state[0]))
    point = points[len(points) // 2].clone()
    neutral = neutral_point(effect)
    for k, parameter in enumerate(effect.table):
        if parameter.linear:
            point[k] = neutral[k] + 0.05 * (parameter.high - neutral[k])
    without = torch.where(torch.tensor([p.neutral is None for p in effect.table]), point, neutral)
    found = sensitivity.around(effect, point[None], ())[0][:, 0]
    model = CandidateModel(SYSTEM, [effect], rows, FINE)
    after, before = (linearise(model, theta, fits.state[0]).next_state for theta in (point, without))
    drive = (after - before)[..., None] * rows.inside[:, 1:, None, None]
    expected = sensitivity.innovations.response(drive, torch.zeros_like(rows.measured[..., None]))[:, 0]
    assert float((found - expected).norm()) < 0.1 * float(expected.norm())


@pytest.mark.parametrize("frequency", [0.3, 1.1, 4.0])
def test_the_pulls_of_all_rows_add_up_to_that_of_a_force_that_comes_and_goes(source, frequency):
    rows, _, sensitivity = source
    point = torch.tensor([[0.0, frequency, 0.4, 0.0]], dtype=torch.float64)
    expected = -sensitivity.by_unit(PeriodicForce, point, [0])[:, 0, 0] @ sensitivity.innovations.error
    pull = sensitivity.pull(PeriodicForce, torch.zeros(4, dtype=torch.float64), 0)
    time = (rows.time[:, :-1] + rows.time[:, 1:]) / 2
    found = (pull * (2 * torch.pi * frequency * time + 0.4).cos()).sum()
    assert float(found) == pytest.approx(float(expected), rel=0.02)
