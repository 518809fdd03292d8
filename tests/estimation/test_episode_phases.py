"""A periodic effect that keeps running while episodes begin at any time: its phase differs from one to the next."""

import math

import pytest
import torch

from tests.diagnosed import NOISE, record
from visadapt import diagnose
from visadapt.effects import ConstantForce, PeriodicForce, ViscousFriction
from visadapt.estimation.candidate import CandidateModel, linearise
from visadapt.estimation.effect_fit import fit_effects
from visadapt.estimation.episode_phases import with_common_phase, with_episode_phases
from visadapt.estimation.fit_states import Effects
from visadapt.estimation.segments import cut
from visadapt.learning.grounding import fit_named, gap
from visadapt.learning.transitions import Transitions
from visadapt.systems import CartPole
from visadapt.world import World

STATES = ("x", "x_dot", "theta", "theta_dot")
PHASES = (0.4, -2.9, 2.0, -1.2)
AMPLITUDE, FREQUENCY = 1.5, 0.6


def running(phases=PHASES):
    """A force with a phase for each of the episodes."""
    return PeriodicForce(amplitude=AMPLITUDE, frequency=FREQUENCY, phase=torch.tensor(phases), offset=0.0)


@pytest.fixture(scope="module")
def recording():
    return record([running()], measured=STATES)


def arrays(recording):
    """Readings and commands of each episode."""
    states, actions = zip(*((e.state, e.action) for e in recording.episodes), strict=True)
    return list(map(torch.from_numpy, states)), list(map(torch.from_numpy, actions))


def test_derivatives_by_the_phase_of_an_episode_are_those_of_finite_differences(recording):
    measured, commands = arrays(recording)
    used = [torch.ones_like(values) for values in measured]
    stamps = [0.05 * torch.arange(len(values)) for values in measured]
    rows = cut(measured, used, commands, stamps, (0, 1, 2, 3), 0.05, 20)
    effects: Effects = (ViscousFriction, with_episode_phases(PeriodicForce, len(measured)), ConstantForce)
    model = CandidateModel(CartPole(), effects, rows)
    theta = torch.tensor([1.0, 2.0, 0.7, 0.3, 0.2, 1.0, -2.0, 0.5, -0.4], dtype=torch.float64)
    with torch.no_grad():
        found = linearise(model, theta, rows.measured).by_parameter
        for k in range(len(theta)):
            moved = 1e-5 * torch.eye(len(theta), dtype=torch.float64)[k]
            ends = [linearise(model, end, rows.measured).next_state for end in (theta + moved, theta - moved)]
            expected = (ends[0] - ends[1]) / 2e-5
            size = float(expected.abs().max())
            assert size > 1e-4
            torch.testing.assert_close(found[..., k], expected, rtol=0, atol=1e-3 * size)


def test_one_force_is_fitted_to_all_episodes_and_leaves_nothing_in_any(recording):
    start, (measured, commands) = PeriodicForce(amplitude=0.0, frequency=1.0, phase=0.0, offset=0.0), arrays(recording)
    fit = fit_effects(CartPole(), [start], measured, commands, recording.period)
    amplitude, frequency, phase, _ = fit.values[PeriodicForce].tolist()
    assert amplitude == pytest.approx(AMPLITUDE, rel=0.05)
    assert frequency == pytest.approx(FREQUENCY, rel=0.02)
    assert phase == pytest.approx(PHASES[0], abs=0.1)
    for shift, own in zip(fit.shifts.tolist(), PHASES, strict=True):
        assert math.cos(2 * math.pi * frequency * shift + phase - own) > 0.99


def test_the_gap_that_a_residual_learns_is_that_beside_the_force_in_every_episode():
    clean = record([running()], measured=STATES, noise=[1e-3 * noise for noise in NOISE])
    source = World(CartPole(), [PeriodicForce(amplitude=0.0, frequency=1.0, phase=0.0, offset=0.0)], substeps=10)
    transitions = Transitions.cut(clean.episodes)
    missing = gap(source, transitions).square().mean(0).sqrt()
    left = gap(source, fit_named(source, transitions)).square().mean(0).sqrt()
    assert (left < 0.03 * missing).all()


def test_a_diagnosis_names_the_force_and_says_that_the_phase_differs(recording):
    found = diagnose(recording, World(CartPole()), [PeriodicForce, ViscousFriction, ConstantForce])
    assert found.verdict == "identified"
    (cause,) = found.causes
    assert cause.parameters.keys() == {"amplitude", "frequency", "phase", "offset"}
    assert cause.parameters["amplitude"].value == pytest.approx(AMPLITUDE, rel=0.05)
    assert cause.parameters["phase"].ci90 == (-math.pi, math.pi)
    (told,) = [line for line in found.warnings if "differs from episode to episode" in line]
    assert "(0." in told
    assert told.count(",") == len(PHASES) - 1


def test_a_force_in_step_with_the_episodes_keeps_its_one_phase():
    found = diagnose(
        record([running([0.4] * 4)], measured=STATES),
        World(CartPole()),
        [PeriodicForce, ViscousFriction, ConstantForce],
    )
    (cause,) = found.causes
    low, high = cause.parameters["phase"].ci90
    assert low < 0.4 < high < low + 0.5
    assert not any("differs from episode to episode" in line for line in found.warnings)


def test_one_phase_again_is_the_effect_itself():
    assert with_common_phase(with_episode_phases(PeriodicForce, 5)) is PeriodicForce
    assert with_episode_phases(PeriodicForce, 1) is PeriodicForce
    assert with_episode_phases(ViscousFriction, 5) is ViscousFriction
