import pytest
import torch

from tests.flying import PERIOD, seeded, states_on, straight, waves
from visadapt.history import HORIZON
from visadapt.systems import FixedWing
from visadapt.systems.rigid_body import POSITION, VELOCITY
from visadapt.tasks.follow import Follow
from visadapt.tasks.reach import Reach
from visadapt.world import World

ROWS = 31


@pytest.fixture(scope="module")
def task():
    return Follow(waves(6, ROWS))


class TestFollow:
    def test_a_flight_starts_as_the_reference_does_attitude_and_rates_included(self, task):
        state, task_state = task.evaluation_start(4, seeded())
        assert state.shape == (4, 13)
        assert task_state[:, 1].tolist() == [0] * 4
        torch.testing.assert_close(state, states_on(task.references)[task_state[:, 0], 0])
        assert task.steps == ROWS - 1

    @pytest.mark.parametrize(("batch", "counts"), [(4, {1}), (6, {1}), (12, {2}), (15, {2, 3})])
    def test_references_repeat_only_once_all_have_been_flown(self, task, batch, counts):
        which = task.evaluation_start(batch, seeded())[1][:, 0]
        assert len(which) == batch
        assert set(which.unique(return_counts=True)[1].tolist()) == counts

    def test_which_are_flown_is_drawn_with_the_seed(self, task):
        one, same, other = (task.evaluation_start(6, seeded(seed))[1] for seed in (0, 0, 1))
        assert torch.equal(one, same)
        assert not torch.equal(one, other)

    def test_a_policy_is_told_the_next_rows_of_its_own_reference(self, task):
        goal = task.goal(torch.tensor([[3, 7], [0, 0]])).unflatten(1, (HORIZON, 6))
        for told, which, row in zip(goal, (3, 0), (7, 0), strict=True):
            rows = slice(row + 1, row + 1 + HORIZON)
            assert torch.equal(told[:, :3], task.references.positions[which, rows])
            assert torch.equal(told[:, 3:], task.references.velocities[which, rows])

    @pytest.mark.parametrize("row", [ROWS - 1 - HORIZON, ROWS - 4, ROWS - 1, ROWS + 2])
    def test_beyond_its_end_a_reference_goes_straight_on_at_its_last_velocity(self, row):
        task, longer = (Follow(straight(rows=rows)) for rows in (ROWS, ROWS + 20))
        task_state = torch.tensor([[0, row], [1, row]])
        torch.testing.assert_close(task.ahead(task_state), longer.ahead(task_state))

    def test_on_a_bend_the_last_velocity_is_that_of_the_last_row(self, task):
        ahead = task.ahead(torch.tensor([[2, ROWS - 3]]))[0]
        own = task.references
        last, velocity = own.positions[2, -1], own.velocities[2, -1]
        torch.testing.assert_close(ahead[1, :3], last)
        for k in range(2, HORIZON):
            torch.testing.assert_close(ahead[k], torch.cat((last + (k - 1) * PERIOD * velocity, velocity)))

    def test_a_step_later_is_the_next_row_of_the_same_reference(self, task):
        assert task.advance(torch.tensor([[4, 0], [1, 9]])).tolist() == [[4, 1], [1, 10]]

    def test_a_miss_is_the_distance_to_the_row_that_is_due_and_the_first_row_is_none(self, task):
        task_state = torch.tensor([[2, 0], [5, 0]])
        states = states_on(task.references)[task_state[:, 0]].clone()
        states[:, 0, POSITION] += 100.0
        states[0, 1:, POSITION] += torch.tensor([0.3, 0.0, -0.4])
        states[1, 8, POSITION] += torch.tensor([0.0, 2.0, 0.0])
        states[..., VELOCITY.start :] += 7.0
        wanted = torch.zeros(2, ROWS - 1)
        wanted[0], wanted[1, 7] = 0.5, 2.0
        torch.testing.assert_close(task.misses(states, task_state), wanted)

    def test_it_is_as_far_off_as_from_the_row_that_is_due_and_beyond_the_end_from_the_last(self, task):
        state = task.states_on(torch.tensor([2, 5]), torch.tensor([7, ROWS - 1]))
        state[:, POSITION] += torch.tensor([[0.0, 3.0, 4.0], [0.0, 0.0, -2.0]])
        away = task.distance_off(state, torch.tensor([[2, 7], [5, ROWS + 3]]))
        torch.testing.assert_close(away, torch.tensor([5.0, 2.0]))

    def test_double_precision_stays_double(self):
        task = Follow(waves(3, dtype=torch.float64))
        state, task_state = task.evaluation_start(3, seeded())
        assert (
            state.dtype == task.goal(task_state).dtype == task.misses(state[:, None], task_state).dtype == torch.float64
        )


def flown(*points):
    """States (1, T, 13) at points."""
    states = torch.zeros(1, len(points), 13)
    states[0, :, POSITION] = torch.tensor(points)
    return states


class TestReach:
    task = Reach()
    target = torch.tensor([[50.0, 2.0, -1.0]])

    @pytest.mark.parametrize(
        ("points", "miss"),
        [
            # Level and straight, 3 m to one side and 4 m below, with the point amid two rows, or at one.
            ([(0.0, 5.0, -5.0), (40.0, 5.0, -5.0), (80.0, 5.0, -5.0)], 5.0),
            ([(0.0, 5.0, -5.0), (50.0, 5.0, -5.0), (80.0, 5.0, -5.0)], 5.0),
            # Through it, between rows, aslant.
            ([(40.0, 1.0, -2.0), (60.0, 3.0, 0.0)], 0.0),
            # On its way there, but 10 m short, or with its last row beside it.
            ([(0.0, 2.0, -1.0), (20.0, 2.0, -1.0), (40.0, 2.0, -1.0)], 10.0),
            ([(0.0, 0.0, -1.0), (50.0, 0.0, -1.0)], 2.0),
            # Never near: what counts is its whole distance, here from the first row on.
            ([(0.0, 2.0, -1.0), (-20.0, 2.0, -1.0), (-90.0, 2.0, -1.0)], 50.0),
            # A corner is nearest.
            ([(0.0, 12.0, -1.0), (50.0, 5.0, -1.0), (100.0, 12.0, -1.0)], 3.0),
            ([(50.0, 102.0, -1.0), (50.0, 6.0, -1.0), (50.0, 102.0, -1.0)], 4.0),
            # Back and forth: the nearest of all counts.
            ([(0.0, 2.0, -1.0), (45.0, 2.0, -1.0), (10.0, 2.0, -1.0), (42.0, 2.0, -1.0)], 5.0),
            # Standing still.
            ([(47.0, 2.0, 3.0), (47.0, 2.0, 3.0)], 5.0),
        ],
    )
    def test_a_miss_is_the_least_distance_of_the_path_between_rows_too(self, points, miss):
        found = self.task.misses(flown(*points), self.target)
        torch.testing.assert_close(found, torch.tensor([[miss]]), rtol=1e-5, atol=2e-6)

    def test_it_is_as_far_off_as_from_the_line_through_the_point_behind_it_too(self):
        states = torch.zeros(3, 13)
        states[:, POSITION] = torch.tensor([[5.0, 0.0, 0.0], [3.0, 4.0, 1.5], [60.0, 80.0, -6.0]])
        away = Reach().distance_off(states, torch.tensor([[30.0, 40.0, 0.0]]).expand(3, 3))
        torch.testing.assert_close(away, torch.tensor([4.0, 1.5, 6.0]))

    def test_each_flight_has_its_own_target(self):
        states = flown((0.0, 0.0, 0.0), (100.0, 0.0, 0.0)).repeat(2, 1, 1)
        task_states = torch.tensor([[50.0, 3.0, 0.0], [20.0, 0.0, -1.0]])
        torch.testing.assert_close(self.task.misses(states, task_states), torch.tensor([[3.0], [1.0]]))

    def test_at_its_start_the_wing_flies_level_with_nothing_to_correct(self):
        state, _ = self.task.evaluation_start(3, seeded())
        command = FixedWing().trim(torch.tensor([self.task.speed]))[1].repeat(3, 1)
        torch.testing.assert_close(state[:, VELOCITY], torch.tensor([[11.5, 0.0, 0.0]]).repeat(3, 1))
        assert not state[:, POSITION].any()
        world = World(FixedWing(), period=0.05)
        at = world.start(state)
        for _ in range(40):
            at = world.step(at, command)
        gone = torch.tensor([[2 * 11.5, 0.0, 0.0]]).repeat(3, 1)
        torch.testing.assert_close(at.state[:, POSITION], gone, rtol=1e-4, atol=1e-3)
        torch.testing.assert_close(at.state[:, VELOCITY.start :], state[:, VELOCITY.start :], rtol=1e-4, atol=1e-3)

    def test_targets_are_50_m_ahead_and_up_to_5_m_aside_and_are_all_a_policy_is_told(self):
        _, task_state = self.task.evaluation_start(2000, seeded())
        assert (task_state[:, 0] == 50.0).all()
        aside = task_state[:, 1:]
        assert aside.abs().max() <= 5.0
        torch.testing.assert_close(aside.std(0), torch.full((2,), 5 / 3**0.5), rtol=0.05, atol=0)
        assert (aside.mean(0).abs() < 0.3).all()
        assert torch.equal(self.task.goal(task_state), task_state)
        assert torch.equal(self.task.advance(task_state), task_state)

    def test_a_flight_lasts_long_enough_to_get_there(self):
        assert self.task.steps * self.task.period * self.task.speed > 1.5 * self.task.distance
