"""Recordings that begin while the motor still acts on commands from before: what it does at the start is no cause."""

import dataclasses

import numpy as np
import pytest

from tests.diagnosed import record
from visadapt import diagnose
from visadapt.effects import ActuatorBacklash, ActuatorLag, Gust, ViscousFriction
from visadapt.recordings import Episode
from visadapt.systems import CartPole
from visadapt.world import World

CATALOGUE = [ActuatorLag, ActuatorBacklash, ViscousFriction, Gust]
SKIPPED = 20
LEFT_OUT = "still depend on commands from before"


def later(recording):
    """The recording from its row SKIPPED on, as if it had begun there."""
    episodes = tuple(
        Episode(each.time[SKIPPED:] - each.time[SKIPPED], each.action[SKIPPED:], each.state[SKIPPED:])
        for each in recording.episodes
    )
    return dataclasses.replace(recording, episodes=episodes)


def found_in(effects, cut, seed=0):
    recording = record(effects, episodes=4, rows=100, seed=seed, noise=(1e-3, 5e-3, 1e-3, 5e-3))
    return diagnose(later(recording) if cut else recording, World(CartPole()), CATALOGUE)


@pytest.mark.parametrize(
    "effects",
    [[ActuatorLag(time_constant=0.15), ViscousFriction(coefficient=2.0)], [ActuatorBacklash(width=0.4)]],
    ids=["a lag and friction", "play"],
)
def test_nothing_is_named_beside_what_acts(effects):
    found = found_in(effects, cut=True)
    assert found.verdict == "identified"
    assert {cause.effect for cause in found.causes} == {effect.name for effect in effects}
    for cause, true in zip(sorted(found.causes, key=lambda one: one.effect), effects, strict=True):
        for name, one in cause.parameters.items():
            np.testing.assert_allclose(one.value, float(getattr(true, name)), rtol=0.03)
    (said,) = (warning for warning in found.warnings if LEFT_OUT in warning)
    assert said.startswith("up to the first 0.")


def test_a_run_from_its_start_keeps_all_rows():
    found = found_in([ActuatorLag(time_constant=0.15), ViscousFriction(coefficient=2.0)], cut=False)
    assert {cause.effect for cause in found.causes} == {"actuator_lag", "viscous_friction"}
    assert not any(LEFT_OUT in warning for warning in found.warnings)


def test_a_gust_in_the_first_rows_stays_a_cause():
    found = found_in([ActuatorLag(time_constant=0.15), Gust(start=0.15, end=0.35, force=8.0)], cut=False)
    assert {cause.effect for cause in found.causes} == {"actuator_lag", "gust"}
    assert not any(LEFT_OUT in warning for warning in found.warnings)
