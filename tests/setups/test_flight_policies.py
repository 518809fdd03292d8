import pytest
import torch

from tests.flying import PERIOD, seeded, waves
from tests.scenes import stir
from visadapt.effects import Residual
from visadapt.history import LENGTH, History
from visadapt.policies import FollowPolicy, ReachPolicy
from visadapt.policies.networks import FlightResidualNetwork
from visadapt.storage.checkpoints import CheckpointError, load_network, save_network
from visadapt.systems import FixedWing, Quadrotor
from visadapt.systems.rigid_body import POSITION, rotation
from visadapt.targets import FlightTarget, SyntheticTarget, TargetError
from visadapt.targets.rollout import see_goals
from visadapt.tasks.follow import Follow
from visadapt.tasks.reach import Reach
from visadapt.world import World

KINDS = ["follow", "reach"]
POINTS = {"follow": slice(0, 60, 6), "reach": slice(0, 3, 3)}
"""Where in a goal positions begin."""


def made(kind, dtype=torch.float32):
    torch.manual_seed(0)
    return (FollowPolicy(PERIOD) if kind == "follow" else ReachPolicy()).to(dtype)


def shown(kind, batch=5, dtype=torch.float64):
    """States on their way, off their line, and goals."""
    task = Follow(waves(batch)) if kind == "follow" else Reach()
    state, task_state = task.evaluation_start(batch, seeded())
    state = state + 0.2 * torch.randn(state.shape, generator=seeded(1))
    return task.show(state, task_state).to(dtype)


def a_history(kind, dtype=torch.float64):
    return History.start(shown(kind, dtype=dtype), 4)


def a_residual(kind, dtype=torch.float64):
    """One that looks back, and says something."""
    system, period = (Quadrotor(), PERIOD) if kind == "follow" else (FixedWing(), 0.05)
    source = World(system, period=period)

    network = FlightResidualNetwork(system, period, source.steps_along)
    return Residual(stir(network), torch.ones(13)).to(dtype)


@pytest.mark.parametrize("kind", KINDS)
class TestPolicies:
    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_ten_times_four_commands_are_planned_the_first_of_which_is_executed(self, kind, dtype):
        policy, history = stir(made(kind, dtype)), a_history(kind, dtype)
        plan = policy(history)
        assert plan.shape == (5, 10, 4)
        assert plan.dtype == dtype
        assert torch.equal(policy.act(history), plan[:, 0])

    def test_commands_are_within_bounds_whatever_the_weights(self, kind):
        plan = stir(made(kind, torch.float64), spread=30.0)(a_history(kind))
        assert plan.abs().max() <= 1
        assert plan.abs().max() > 0.99

    def test_an_untrained_one_commands_little(self, kind):
        assert made(kind, torch.float64)(a_history(kind)).abs().max() < 0.2

    def test_where_the_vehicle_is_does_not_matter_only_where_its_goal_is_from_there(self, kind):
        policy, seen = stir(made(kind, torch.float64)), shown(kind)
        shift = torch.tensor([30.0, -20.0, 7.0], dtype=torch.float64)
        moved, left = seen.clone(), seen.clone()
        moved[:, POSITION] += shift
        for first in range(*POINTS[kind].indices(60)):
            moved[:, 13 + first : 16 + first] += shift
        left[:, POSITION] += shift
        plan, same, other = (policy(History.start(each, 4)) for each in (seen, moved, left))
        torch.testing.assert_close(same, plan)
        assert (other - plan).abs().max() > 0.1

    def test_nor_does_the_length_of_the_quaternion_or_its_sign(self, kind):
        policy, seen = stir(made(kind, torch.float64)), shown(kind)
        other = seen.clone()
        other[:, 6:10] *= -1.7
        torch.testing.assert_close(policy(History.start(other, 4)), policy(History.start(seen, 4)))

    def test_each_part_of_state_and_goal_but_that_matters(self, kind):
        policy, seen = stir(made(kind, torch.float64)), shown(kind)
        plan = policy(History.start(seen, 4))
        for column in range(seen.shape[1]):
            other = seen.clone()
            other[:, column] += 0.5
            assert (policy(History.start(other, 4)) - plan).abs().max() > 1e-4, column

    def test_a_residual_changes_nothing_until_the_policy_is_tuned_with_it(self, kind):
        policy, history = made(kind, torch.float64), a_history(kind)
        plan = policy(history)
        policy.residual = a_residual(kind)
        assert policy.correction(history).abs().max() > 0.1
        assert torch.equal(policy(history), plan)
        policy(history).square().sum().backward()
        for listening in (policy.first.weight.grad[:, -13:], policy.feedforward.weight.grad):
            assert listening.abs().max() > 0
        assert all(weight.grad is None for weight in policy.residual.parameters())
        stir(policy)
        heard = policy(history)
        policy.residual = None
        assert (policy(history) - heard).abs().max() > 1e-3

    def test_what_its_residual_tells_of_the_past_is_heard_once_it_has_learnt_to_listen(self, kind):
        policy = made(kind, torch.float64)
        source = World(Quadrotor(), period=PERIOD)
        network = FlightResidualNetwork(Quadrotor(), PERIOD, source.steps_along).double()
        policy.residual = Residual(network, torch.ones(13).double())
        calm = a_history(kind)
        pushed = History(calm.observations.clone(), calm.actions)
        pushed.observations[:, :-1, 3] -= torch.linspace(0.4, 0.1, LENGTH - 1).double()
        assert torch.equal(policy(pushed), policy(calm))
        with torch.no_grad():
            policy.disturbance_out.weight.fill_(0.1)
        assert (policy(pushed) - policy(calm)).abs().min() > 1e-3

    def test_weights_come_back_from_a_file_as_they_were(self, kind, tmp_path):
        policy, history = stir(made(kind), 3), a_history(kind, torch.float32)
        save_network(tmp_path / "policy.safetensors", policy, {"seed": 3})
        other = made(kind)
        assert not torch.equal(other(history), policy(history))
        assert load_network(tmp_path / "policy.safetensors", other) == {"seed": 3}
        assert torch.equal(other(history), policy(history))

    def test_the_weights_of_the_other_kind_are_refused(self, kind, tmp_path):
        save_network(tmp_path / "policy.safetensors", made(kind), {})
        other = made(KINDS[1 - KINDS.index(kind)])
        with pytest.raises(CheckpointError, match=f"holds a {type(made(kind)).__name__}, a {type(other).__name__} is"):
            load_network(tmp_path / "policy.safetensors", other)


def test_on_its_reference_at_the_right_speed_a_follower_sees_nothing_left_to_do():
    velocity = torch.tensor([[1.0, -2.0, 0.5]])
    state = torch.zeros(1, 13)
    state[:, 3:6], state[:, 6] = velocity, 1.0
    steps = PERIOD * torch.arange(1, 11)[:, None]
    goal = torch.cat((steps * velocity, velocity.expand(10, 3)), 1).flatten()[None]
    torch.testing.assert_close(FollowPolicy(PERIOD).aim(state, goal), torch.zeros(1, 60))


def test_a_follower_answers_alike_whatever_the_heading():
    policy, seen = stir(made("follow", torch.float64)), shown("follow")
    policy.residual = a_residual("follow")
    with torch.no_grad():
        policy.first.weight[:, -13:] = 0  # the residual's correction, whose axes are the world's
        policy.feedforward.weight.zero_()
    past = torch.randn(LENGTH, 1, 73, generator=seeded(2), dtype=torch.float64) * 0.02 + seen
    past[..., 13:] = seen[:, 13:]

    def turned(rows):
        half = torch.tensor(0.4, dtype=torch.float64)
        turn = torch.stack((half.cos(), *torch.zeros(2).double(), half.sin()))[None]
        matrix = rotation(turn)[0]
        out = rows.clone()
        for first in (0, 3, *range(13, 73, 3)):
            out[..., first : first + 3] = rows[..., first : first + 3] @ matrix.T
        w, x, y, z = rows[..., 6:10].unbind(-1)
        c, s = half.cos(), half.sin()
        out[..., 6:10] = torch.stack((c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w), -1)
        return out

    def plan(rows):
        history = History(rows.transpose(0, 1), torch.zeros(len(seen), LENGTH, 4).double())
        return policy(history)

    torch.testing.assert_close(plan(turned(past)), plan(past))
    left = turned(past)
    left[..., 13:] = past[..., 13:]
    assert (plan(left) - plan(past)).abs().max() > 0.1


def test_a_wing_that_flies_at_its_point_or_stands_in_it_sees_finite_numbers():
    state = torch.zeros(2, 13)
    state[:, 6] = 1.0
    state[0, 3] = 12.0
    goal = torch.tensor([[25.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    aim = ReachPolicy().aim(state, goal, rotation(state[:, 6:10]))
    torch.testing.assert_close(aim[0], torch.tensor([0.5, 1.0, *[0.0] * 8]))
    assert aim[1].isfinite().all()


def test_what_a_policy_is_shown_of_a_target_is_its_state_and_then_its_goal():
    seen = FlightTarget(Follow(waves(4)), Quadrotor()).reset(3, seeded())
    shown = see_goals(seen)
    assert torch.equal(shown[:, :13], seen.state)
    assert torch.equal(shown[:, 13:], seen.goal)
    with pytest.raises(TargetError, match="the target has none: give a quadrotor references"):
        see_goals(SyntheticTarget().reset(1, seeded()))
