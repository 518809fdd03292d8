"""Whether unsteady stamps are those of the readings or of a late log."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicHermiteSpline

from tests.diagnosed import record
from visadapt.diagnosis.search.angle_defect import between, shortest_arc
from visadapt.diagnosis.search.heldout import folds
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.search.sensor_checks import derived_velocities
from visadapt.effects import ViscousFriction
from visadapt.estimation.segments import cut
from visadapt.recordings import Episode
from visadapt.systems import CartPole

WHOLE = record(measured=("x", "x_dot", "theta", "theta_dot"), noise=(0.0, 0.0, 0.0, 0.0))


WHOLE_POSITIONS = tuple(Episode(e.time, e.action, e.state[:, [0, 2]]) for e in WHOLE.episodes)


def jittered(read_late: bool):
    """Positions and angles of WHOLE with stamps up to 6 ms late; the readings are late as well, or the log alone is."""
    generator = np.random.default_rng(0)
    episodes = []
    for episode in WHOLE.episodes:
        late = generator.uniform(0, 0.006, len(episode.time))
        state = episode.state[:, [0, 2]] + read_late * late[:, None] * episode.state[:, [1, 3]]
        state = state + generator.normal(0, 2e-4, state.shape)
        episodes.append(Episode(episode.time + late, episode.action, state))
    return dataclasses.replace(WHOLE, episodes=tuple(episodes), measured=("x", "theta"))


def test_lost_rows_are_counted_among_those_that_may_be_used():
    generator = np.random.default_rng(0)
    episodes, usable, lost = [], [], 0
    for episode in record(episodes=4, rows=100).episodes:
        state, kept = episode.state.copy(), generator.random(100) < 0.6
        for row in np.flatnonzero(generator.random(100) < 0.15):
            state[row] = state[row - 1] if row else state[row]
            lost += bool(row and kept[row] and kept[row - 1])
        episodes.append(Episode(episode.time, episode.action, state))
        usable.append(np.repeat(kept[:, None], 2, 1))
    whole = dataclasses.replace(record(episodes=4, rows=100), episodes=tuple(episodes), usable=tuple(usable))
    repeats = prepare(whole, CartPole()).repeats
    assert sum(int(rows.sum()) for rows in repeats.lost) == lost
    assert sum(int(rows[1:].sum()) for rows in repeats.seen) == sum(
        (read[1:] & read[:-1])[:, 0].sum() for read in usable
    )


def with_filtered_velocities(recording):
    """The same with velocities as a rig derives them: differences through a first-order filter of 0.1 s."""
    episodes = []
    for episode in recording.episodes:
        slopes = np.diff(episode.state, axis=0, prepend=episode.state[:1]) / 0.05
        for row in range(1, len(slopes)):
            slopes[row] = slopes[row - 1] + (slopes[row] - slopes[row - 1]) * 0.5
        state = np.stack((episode.state[:, 0], slopes[:, 0], episode.state[:, 1], slopes[:, 1]), 1)
        episodes.append(Episode(episode.time, episode.action, state))
    return dataclasses.replace(recording, episodes=tuple(episodes), measured=WHOLE.measured)


@pytest.mark.parametrize("filtered", [True, False])
@pytest.mark.parametrize("read_late", [True, False])
def test_it_is_decided_whether_the_readings_or_the_log_were_late(read_late, filtered):
    recording = with_filtered_velocities(jittered(read_late)) if filtered else jittered(read_late)
    prepared = prepare(recording, CartPole())
    assert any("evenly spaced" in warning for warning in prepared.warnings) != read_late
    steps = prepared.rows.time[0].diff()
    assert bool((steps - steps.mean()).abs().max() < 1e-9) != read_late


def test_velocities_that_a_rig_derives_are_left_out():
    prepared = prepare(
        with_filtered_velocities(dataclasses.replace(jittered(True), episodes=WHOLE_POSITIONS)), CartPole()
    )
    assert prepared.rows.channels == (0, 2)
    assert sum("derived from it on the rig, or filtered; left out" in warning for warning in prepared.warnings) == 2


def test_noise_of_few_readings_does_not_make_velocities_late():
    late = 0
    for seed in range(30):
        generator, episode = np.random.default_rng(seed), WHOLE.episodes[seed % len(WHOLE.episodes)]
        state = episode.state[:60] + generator.normal(0, (0.01, 0.04, 0.018, 0.1), (60, 4))
        measured, used = [torch.from_numpy(state)], [torch.ones(60, 4)]
        command, time = [torch.from_numpy(episode.action[:60])], [torch.from_numpy(episode.time[:60])]
        rows = cut(measured, used, command, time, (0, 1, 2, 3), 0.05, 60)
        late += bool(derived_velocities(CartPole(), rows))
    assert late == 0


def test_velocities_that_an_estimator_corrects_with_their_positions_are_not_late():
    generator, time = np.random.default_rng(0), 0.02 * np.arange(500)
    # Every tenth row, both jump by what a reading of the position is off; in between the velocity is the slope.
    jumps = np.where(np.arange(500) % 10 == 0, generator.normal(0, 0.01, 500), 0.0)
    wrong = np.array([0.0, 0.0])
    errors = []
    for jump in jumps:
        wrong = 0.95 * (wrong + np.array([0.02 * wrong[1], 0.0])) + np.array([1.0, 2.0]) * jump
        errors.append(wrong)
    x = np.stack((0.3 * np.sin(2 * time), 0.6 * np.cos(2 * time)), 1) + np.array(errors)
    state = torch.from_numpy(np.concatenate((x, np.zeros((500, 2))), 1))
    command = torch.zeros(500, 1, dtype=torch.float64)
    rows = cut([state], [torch.ones(500, 4)], [command], [torch.from_numpy(time)], (0, 1, 2, 3), 0.02, 500)
    assert "x_dot" not in derived_velocities(CartPole(), rows)


def test_whole_episodes_are_in_the_sources_signs_with_lost_readings_filled_in():
    recording = record([ViscousFriction(coefficient=0.8)])
    episodes = []
    for episode in recording.episodes:
        state = episode.state * np.array([1.0, -1.0])
        state[20] = state[19]
        episodes.append(Episode(episode.time, episode.action, state))
    whole = prepare(dataclasses.replace(recording, episodes=tuple(episodes)), CartPole()).whole
    for found, episode in zip(whole.episodes, recording.episodes, strict=True):
        expected = episode.state.copy()
        kept = np.delete(np.arange(len(expected)), 20)
        time, values = episode.time[kept], expected[kept]
        expected[20] = CubicHermiteSpline(time, values, np.gradient(values, time, axis=0))(episode.time[20])
        np.testing.assert_allclose(found.state, expected)
        np.testing.assert_array_equal(found.action, episode.action)


def test_an_arc_of_angles_may_hold_the_hanging_pole():
    assert shortest_arc([0, 1, 61, 62], 63) == (61, 64)
    assert shortest_arc([5, 7], 63) == (5, 7)
    assert shortest_arc([4], 63) == (4, 4)
    assert between(torch.tensor([3.1, -3.1, 3.3 + 2 * torch.pi, 2.9, 0.0]), 3.0, 3.4).tolist() == [1, 1, 1, 0, 0]


def test_of_one_episode_a_half_is_held_out_where_it_is_long_enough_for_predictions():
    def first(rows):
        episode = WHOLE.episodes[0]
        part = Episode(episode.time[:rows], episode.action[:rows], episode.state[:rows])
        return prepare(dataclasses.replace(WHOLE, episodes=(part,)), CartPole()).rows

    assert [first(rows).shape[0] for rows in (60, 40, 30)] == [2, 2, 2]
    assert first(20).shape[0] == 1
    assert folds(first(60), 4).tolist() == [[1, 0], [0, 1]]
