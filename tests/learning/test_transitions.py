from dataclasses import replace

import numpy as np
import pytest
import torch

from visadapt.history import LENGTH, History
from visadapt.learning.transitions import Transitions
from visadapt.recordings import Episode


def episode(number, rows, frames=True, states=True):
    """Values that say where they are from: state 100 n + t, action (10 n + t) / 1000, the last 9; frame 20 n + t."""
    at = np.arange(rows)
    action = (10 * number + at)[:, None] / 1000
    action[-1] = 9.0
    return Episode(
        time=at * 0.05,
        action=action,
        state=(100.0 * number + at)[:, None] + np.array([0.0, 0.25]) if states else None,
        frame=np.full((rows, 2, 3), 0, np.uint8) + (20 * number + at).astype(np.uint8)[:, None, None]
        if frames
        else None,
    )


TWO = [episode(1, 8), episode(2, 3)]
"""7 and 2 samples."""


class TestAlignment:
    def test_a_sample_is_a_state_the_action_there_and_the_state_after(self):
        transitions = Transitions.cut(TWO)
        assert len(transitions) == 9
        assert transitions.state[:, 0].tolist() == [100, 101, 102, 103, 104, 105, 106, 200, 201]
        assert transitions.next_state[:, 0].tolist() == [101, 102, 103, 104, 105, 106, 107, 201, 202]
        assert transitions.state[:, 1].tolist() == [value + 0.25 for value in transitions.state[:, 0].tolist()]
        actions = [0.010, 0.011, 0.012, 0.013, 0.014, 0.015, 0.016, 0.020, 0.021]
        assert transitions.action[:, 0].tolist() == pytest.approx(actions)
        assert transitions.lengths == [8, 3]

    def test_the_history_shows_the_5_latest_rows_and_stands_still_before_the_episode(self):
        transitions = Transitions.cut(TWO)
        history = transitions.history(torch.arange(9))
        wanted = {
            0: [100, 100, 100, 100, 100],
            2: [100, 100, 100, 101, 102],
            6: [102, 103, 104, 105, 106],
            7: [200, 200, 200, 200, 200],
            8: [200, 200, 200, 200, 201],
        }
        for row, states in wanted.items():
            assert history.observations[row, :, 0].tolist() == states

    def test_past_actions_are_those_before_the_one_taken_now_and_zero_before_the_episode(self):
        transitions = Transitions.cut(TWO)
        wanted = {
            0: [0, 0, 0, 0, 0],
            2: [0, 0, 0, 0.010, 0.011],
            6: [0.011, 0.012, 0.013, 0.014, 0.015],
            7: [0, 0, 0, 0, 0],
            8: [0, 0, 0, 0, 0.020],
        }
        for row, actions in wanted.items():
            assert transitions.history(torch.tensor([row])).actions[0, :, 0].tolist() == pytest.approx(actions)

    def test_it_is_the_history_that_a_policy_had_when_it_chose_the_action(self):
        transitions = Transitions.cut(TWO)
        state = torch.as_tensor(TWO[0].state, dtype=torch.float32)
        action = torch.as_tensor(TWO[0].action, dtype=torch.float32)
        lived = History.start(state[:1], 1)
        for t in range(7):
            found = transitions.history(torch.tensor([t]))
            assert torch.equal(found.observations, lived.observations)
            assert torch.equal(found.actions, lived.actions)
            lived = lived.acting(action[t : t + 1]).observing(state[t + 1 : t + 2])

    def test_task_states_are_those_of_the_rows_that_it_shows_and_none_where_there_are_none(self):
        placed = [replace(each, task_state=np.stack([each.time, -each.time], 1)) for each in TWO]
        transitions = Transitions.cut(placed)
        assert transitions.task_states[transitions.rows].shape == (len(transitions), LENGTH, 2)
        for row in (0, 3, 6):
            first = [max(row - back, 0) for back in range(LENGTH - 1, -1, -1)]
            np.testing.assert_array_equal(transitions.task_states[transitions.rows[row], 0], TWO[0].time[first])
        assert Transitions.cut(TWO).task_states.shape == (11, 0)

    def test_the_action_of_the_last_row_was_not_executed_and_is_nowhere(self):
        transitions = Transitions.cut(TWO)
        assert transitions.action.max() < 1
        assert transitions.history(torch.arange(9)).actions.max() < 1

    def test_an_episode_of_one_row_adds_no_sample_and_shifts_no_other(self):
        transitions = Transitions.cut([episode(1, 3), episode(3, 1), episode(2, 3)], frames=True)
        assert transitions.state[:, 0].tolist() == [100, 101, 200, 201]
        assert (255 * transitions.history(torch.tensor([3])).observations[0, :, 0, 0]).round().tolist() == [40] * 4 + [
            41
        ]


class TestShown:
    def test_frames_are_the_cameras(self):
        seen = Transitions.cut(TWO[:1], frames=True).history(torch.tensor([6])).observations
        assert seen.shape == (1, LENGTH, 2, 3)
        assert seen.dtype == torch.float32
        assert (255 * seen[0, :, 1, 2]).round().tolist() == pytest.approx([22, 23, 24, 25, 26], abs=1)

    def test_states_are_shown_as_they_are(self):
        seen = Transitions.cut(TWO).history(torch.tensor([8])).observations
        assert seen[0].tolist() == [[200.0, 200.25]] * 4 + [[201.0, 201.25]]


class TestErrors:
    @pytest.mark.parametrize("frames", [False, True])
    def test_an_episode_without_states_is_named(self, frames):
        with pytest.raises(ValueError, match="episode 1 has no states"):
            Transitions.cut([TWO[0], episode(2, 3, states=False)], frames)

    def test_an_episode_without_frames_is_named(self):
        with pytest.raises(ValueError, match="episode 1 has no camera frames"):
            Transitions.cut([TWO[0], episode(2, 3, frames=False)], frames=True)

    @pytest.mark.parametrize("episodes", [[], [episode(1, 1)]])
    def test_no_sample_at_all(self, episodes):
        with pytest.raises(ValueError, match="no sample"):
            Transitions.cut(episodes)
