"""Recordings whose readings err by the same for a while, as those of a state estimator do."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.diagnosed import record
from visadapt import diagnose
from visadapt.diagnosis.words import LASTING
from visadapt.effects import ActuatorGain, PoleLength, ViscousFriction
from visadapt.systems import CartPole
from visadapt.world import World

EVERY_STATE = ("x", "x_dot", "theta", "theta_dot")
DEVIATIONS = (0.005, 0.02, 0.005, 0.02)  # m, m/s, rad, rad/s, of the errors that last
SECONDS = 0.25
CATALOGUE = [ViscousFriction, ActuatorGain, PoleLength]


def estimated(effects, seed, rows=120):
    """Four episodes of 6 s whose readings err by an Ornstein-Uhlenbeck process and by white noise."""
    recording = record(effects, rows=rows, seed=seed, measured=EVERY_STATE, noise=(5e-4, 2e-3, 5e-4, 2e-3))
    generator, decay = np.random.default_rng(seed), math.exp(-recording.period / SECONDS)
    episodes = []
    for episode in recording.episodes:
        errors = [generator.normal(0, DEVIATIONS)]
        for _ in range(rows - 1):
            errors.append(decay * errors[-1] + generator.normal(0, DEVIATIONS) * math.sqrt(1 - decay**2))
        episodes.append(replace(episode, state=episode.state + np.array(errors)))
    return replace(recording, episodes=tuple(episodes))


def diagnosed(recording):
    return diagnose(recording, World(CartPole()), catalogue=CATALOGUE)


@pytest.fixture(scope="module")
def of_nothing():
    return diagnosed(estimated([], 1))


def test_errors_that_last_are_no_gap(of_nothing):
    assert of_nothing.verdict == "no_gap"
    assert of_nothing.gap.before == pytest.approx(of_nothing.gap.floor, rel=0.02)


def test_it_is_said_for_how_long_they_last(of_nothing):
    (said,) = (one for one in of_nothing.warnings if one.startswith(LASTING))
    for name in EVERY_STATE:
        assert float(said.split(f" {name} for about ")[1].split(" s")[0]) == pytest.approx(SECONDS, rel=0.4)


def test_an_effect_is_found_with_its_size_beside_them():
    result = diagnosed(estimated([ViscousFriction(coefficient=1.5)], 2))
    assert (result.verdict, [cause.effect for cause in result.causes]) == ("identified", ["viscous_friction"])
    low, high = result.causes[0].parameters["coefficient"].ci90
    assert low < 1.5 < high
    assert high - low < 0.3
