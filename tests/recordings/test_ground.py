"""Rows of a flight in which the vehicle stands on the ground."""

import dataclasses

import numpy as np
import pytest

from tests.diagnosis.test_diagnosis_flights import PERIODS, record
from tests.recorded import write
from visadapt.recordings import load_recording
from visadapt.systems import FixedWing, Quadrotor

STANDING = 20  # Rows


def standing(state, seed):
    """Readings where a vehicle stands level, below the place in a state (13,)."""
    at = np.zeros((STANDING, 13))
    at[:, :3], at[:, 6] = state[:3], 1
    return at + np.random.default_rng(seed).normal(size=at.shape) * [
        *[0.01] * 3,
        *[0.02] * 3,
        *[0.001] * 4,
        *[0.005] * 3,
    ]


@pytest.mark.parametrize("system", [Quadrotor, FixedWing])
@pytest.mark.parametrize(("before", "after"), [(True, False), (False, True), (True, True), (False, False)])
def test_rows_on_the_ground_are_left_out(system, before, after, tmp_path):
    recorded = record(system(), rows=80, episodes=1)
    (flight,) = recorded.episodes
    parts = [(flight.state, flight.action)]
    nothing = np.tile([-1.0, 0, 0, 0], (STANDING, 1))
    if before:
        parts = [(standing(flight.state[0], 1), nothing), *parts]
    if after:
        parts = [*parts, (standing(flight.state[-1], 2), nothing)]
    states, actions = (np.concatenate(each) for each in zip(*parts, strict=True))
    names = (*recorded.measured, *(action.name for action in system.actions))
    time = PERIODS[system.name] * np.arange(len(states))
    path = write(tmp_path / "run.csv", dict(zip(("time", *names), (time, *states.T, *actions.T), strict=True)))
    found = load_recording(path, system())
    said = " ".join(found.warnings)
    assert ("rows before the take-off are left out" in said) == before
    assert ("rows after the landing are left out" in said) == after
    (episode,) = found.episodes
    # A take-off shows when the mean over the time of a prediction has moved.
    assert len(flight.time) - 24 <= len(episode.time) <= len(flight.time)
    if not before and not after:
        np.testing.assert_allclose(episode.state, flight.state, atol=1e-9)


def test_a_vehicle_that_never_takes_off_is_left_as_it_is(tmp_path):
    recorded = record(Quadrotor(), rows=80, episodes=1)
    (flight,) = recorded.episodes
    states = np.concatenate([standing(flight.state[0], seed) for seed in range(4)])
    episode = dataclasses.replace(flight, state=states, action=flight.action * [0, 1, 1, 1] + [-1, 0, 0, 0])
    names = (*recorded.measured, *(action.name for action in Quadrotor.actions))
    columns = (episode.time, *episode.state.T, *episode.action.T)
    path = write(tmp_path / "run.csv", dict(zip(("time", *names), columns, strict=True)))
    assert len(load_recording(path, Quadrotor()).episodes[0].time) == 80
