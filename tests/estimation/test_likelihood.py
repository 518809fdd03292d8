"""Linearisation against autograd and finite steps; fits against the truth."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.diagnosed import record
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.search.search import Search
from visadapt.effects import ActuatorDelay, CartMass, ConstantForce, SensorScale, ViscousFriction
from visadapt.estimation.candidate import CandidateModel, linearise
from visadapt.estimation.fit_states import CAREFUL, initial_fit, with_effect
from visadapt.estimation.fitting import LEAST_NOISE, fit, refitted
from visadapt.estimation.segments import initial_states
from visadapt.recordings import Episode, Recording
from visadapt.systems import CartPole
from visadapt.world import World


@pytest.fixture(scope="module")
def viscous():
    return prepare(record([ViscousFriction(coefficient=0.8)]), CartPole()).rows


@pytest.mark.parametrize("row", [0, 30])
def test_a_reading_that_may_not_be_used_does_not_matter(viscous, row):
    likelihoods = []
    for value in (0.0, 5.0):
        used, measured = viscous.used.clone(), viscous.measured.clone()
        used[:, row], measured[:, row] = 0, value
        rows = replace(viscous, used=used, measured=measured)
        start = with_effect(initial_fit(CartPole(), rows), [0.8])
        likelihoods.append(float(fit([CandidateModel(CartPole(), [ViscousFriction], rows)], start, 3).likelihood))
    assert likelihoods[0] == likelihoods[1]


def test_linearisation_predicts_small_steps(viscous):
    model = CandidateModel(CartPole(), [ViscousFriction, SensorScale, ActuatorDelay, CartMass], viscous)
    theta = torch.tensor([0.5, 1.1, 0.9, 0.03, 1.2], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    state = 0.2 * torch.randn(*viscous.shape, 4, generator=generator, dtype=torch.float64)
    at = linearise(model, theta, state)
    step = 3e-5 * torch.randn(*state.shape, generator=generator, dtype=torch.float64)
    turn = 3e-5 * torch.randn(len(theta), generator=generator, dtype=torch.float64)
    there = linearise(model, theta + turn, state + step)
    change = (at.transition @ step[:, :-1, :, None])[..., 0] + at.by_parameter @ turn
    torch.testing.assert_close(there.next_state - at.next_state, change, atol=6e-8, rtol=0)
    seen = (at.sensing @ step[..., None])[..., 0] + at.sensing_by_parameter @ turn
    torch.testing.assert_close(there.measured - at.measured, seen, atol=6e-8, rtol=0)


def test_a_step_under_strong_friction_errs_by_less_than_a_good_sensor(viscous):
    # Where it errs by more, an effect that is integrated in shorter steps fits better, and is named in its place.
    damping, system = torch.tensor([5.0], dtype=torch.float64), CartPole()
    generator = torch.Generator().manual_seed(0)
    state = 0.3 * torch.randn(*viscous.shape, 4, generator=generator, dtype=torch.float64)
    found = linearise(CandidateModel(system, [ViscousFriction], viscous), damping, state).next_state
    fine = World(system, [ViscousFriction(coefficient=float(damping)).double()], viscous.period, substeps=50)
    commands = viscous.command[viscous.episode[:, None], viscous.index][:, :-1]
    true = fine.step(fine.start(state[:, :-1].flatten(0, 1)), commands.flatten(0, 1)).state
    least = LEAST_NOISE * torch.tensor([each.largest for each in system.states], dtype=torch.float64)
    assert bool(((found.flatten(0, 1) - true).abs() < least / 5).all())


def test_a_fit_finds_size_and_noise_and_leaves_no_disturbance(viscous):
    search = Search(CartPole(), viscous, [ViscousFriction])
    fits = search.single(ViscousFriction).fits
    deviation = fits.information[0, 0, 0].rsqrt()
    assert abs(float(fits.theta[0, 0]) - 0.8) < 4 * float(deviation)
    assert float(deviation) < 0.1
    torch.testing.assert_close((fits.log_noise[0] / 2).exp(), torch.tensor([0.002, 0.002]).double(), rtol=0.2, atol=0)
    assert float((fits.log_process[0] / 2).exp().max()) < 0.01


def test_information_is_the_curvature_of_the_likelihood(viscous):
    search = Search(CartPole(), viscous, [ViscousFriction])
    best = search.fit([((ViscousFriction,), search.single(ViscousFriction).fits)], CAREFUL)[0].fits
    step = float(best.information[0, 0, 0].rsqrt())
    model = CandidateModel(CartPole(), [ViscousFriction], viscous)
    losses = []
    for side in (-step, step):
        # A range of no width holds the parameter where it is while the states settle.
        model.low = model.high = best.theta[0] + side
        held = best[torch.tensor([0])]
        object.__setattr__(held, "theta", best.theta + side)
        losses.append(float(best.likelihood[0] - fit([model], held, 10).likelihood[0]))
    assert sum(losses) / 2 == pytest.approx(0.5, rel=0.1)


def test_a_refit_without_some_windows_is_a_fit_of_the_others(viscous):
    used = torch.ones(1, viscous.shape[0], dtype=torch.float64)
    used[:, 2] = 0
    found = []
    for rows in (viscous, viscous.select(used[0].nonzero()[:, 0])):
        search = Search(CartPole(), rows, [ViscousFriction])
        found.append(search.fit([((ViscousFriction,), search.single(ViscousFriction).fits)], CAREFUL)[0].fits)
    best, alone = found
    with torch.inference_mode():
        theta = refitted(CandidateModel(CartPole(), [ViscousFriction], viscous), best, used).theta
    # One step goes most of the way.
    assert abs(float(theta - alone.theta)) < 0.3 * abs(float(best.theta - alone.theta))


def test_a_batch_of_sets_is_fitted_as_each_alone(viscous):
    together = Search(CartPole(), viscous, [])
    starts = [((effect,), together._start(together.source, effect)) for effect in (ViscousFriction, ConstantForce)]
    both = together.fit(starts, CAREFUL)
    for start, found in zip(starts, both, strict=True):
        alone = Search(CartPole(), viscous, []).fit([start], CAREFUL)[0]
        torch.testing.assert_close(found.fits.theta, alone.fits.theta, atol=1e-4, rtol=1e-3)
        assert found.log_odds == pytest.approx(alone.log_odds, abs=0.05)


def test_noise_of_measurements_is_told_from_a_load_that_is_missing():
    """A load moves the position by half of a period's velocity too: taken as a jump of the velocity alone, it made
    readings of positions look free of noise, and velocities and the pole noisier than they are."""
    noise = (1e-3, 5e-3, 1e-3, 5e-3)
    measured = ("x", "x_dot", "theta", "theta_dot")
    rows = prepare(record([CartMass(scale=1.774)], 8, 120, measured=measured, noise=noise), CartPole()).rows
    search = Search(CartPole(), rows, [CartMass])
    for fits, within in ((search.source.fits, 0.25), (search.single(CartMass).fits, 0.1)):
        torch.testing.assert_close((fits.log_noise[0] / 2).exp(), torch.tensor(noise).double(), rtol=within, atol=0)
    cart, pole = (search.source.fits.log_process[0] / 2).exp()
    assert cart > 50 * pole  # what is missing acts on the cart


def test_no_sensor_scale_is_favoured_where_none_can_be_told():
    """A cart that nothing pushes rolls on at any speed, so that its motion is as likely in every unit of length."""
    generator = np.random.default_rng(0)
    episodes = []
    for _ in range(4):
        state = np.tile([0.0, 0.0, math.pi, 0.0], (60, 1))
        state[:, 0] = generator.uniform(-0.3, 0.3) + generator.uniform(-0.2, 0.2) * 0.05 * np.arange(60)
        noise = generator.normal(0, 0.002, (60, 4))
        episodes.append(Episode(0.05 * np.arange(60), np.zeros((60, 1)), (state + noise)[:, [0, 2]]))
    rows = prepare(Recording(tuple(episodes), ("x", "theta"), 0.05, ("",) * 4), CartPole()).rows
    start = Search(CartPole(), rows, [SensorScale]).single(SensorScale).fits
    found = []
    for scale in (0.5, 1.0, 2.0):
        model = CandidateModel(CartPole(), [SensorScale], rows)
        # A range of no width holds the parameters where they are.
        model.low = model.high = torch.tensor([scale, 1.0]).double()
        held = replace(start, theta=model.low[None], state=initial_states(rows, CartPole())[None] / model.low[0])
        found.append(float(fit([model], held, 20).likelihood[0]))
    assert max(found) - min(found) < 0.3
