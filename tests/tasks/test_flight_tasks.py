import dataclasses
import math

import pytest
import torch

from tests.flying import PERIOD, push, seeded, straight, waves
from tests.scenes import stir
from visadapt.effects import LinearDrag, Residual
from visadapt.history import HORIZON, LENGTH, History
from visadapt.learning.plans import imagine
from visadapt.learning.streams import Streams
from visadapt.learning.transitions import Transitions
from visadapt.learning.tuning import TuneSettings, tune
from visadapt.policies import FollowPolicy, ReachPolicy
from visadapt.policies.networks import FlightResidualNetwork
from visadapt.systems import FixedWing, Quadrotor
from visadapt.systems.rigid_body import POSITION, RATES, VELOCITY
from visadapt.targets.rollout import run
from visadapt.targets.synthetic import FlightTarget
from visadapt.tasks.follow import Follow, FollowCost
from visadapt.tasks.reach import Reach
from visadapt.world import World

ROWS = 31


def identity(state):
    return state


def following(**changes):
    return Follow(waves(6, ROWS), **changes)


def reaching(**changes):
    return Reach(**changes)


def streams(task, world, batch, longest=1000, seed=0):
    made = Streams(world, task, identity, None, batch, longest, 0.0, torch.zeros(()))
    made.start(0.0, seeded(seed))
    return made


class TestFollowCost:
    """On straight references, on which rates are zero."""

    task = Follow(straight(rows=ROWS), FollowCost(position=2.0, velocity=3.0, turning=5.0, action=7.0))
    task_state = torch.tensor([[0, 4], [1, 11]])

    def on_it(self):
        which, row = self.task_state.unbind(1)
        rows = [self.task.states_on(which, row + k) for k in range(HORIZON + 1)]
        return rows[0], torch.stack(rows[1:], 1)

    def cost(self, states, plan=None):
        plan = torch.zeros(2, HORIZON, 4) if plan is None else plan
        return self.task.cost(states, plan, self.on_it()[0], self.task_state)

    def test_on_the_reference_it_is_zero_but_for_effort(self):
        _, states = self.on_it()
        torch.testing.assert_close(self.cost(states), torch.zeros(2), rtol=0, atol=1e-9)
        plan = torch.zeros(2, HORIZON, 4)
        plan[0, 3] = torch.tensor([0.5, -0.5, 1.0, 0.0])
        torch.testing.assert_close(self.cost(states, plan), torch.tensor([7 * 1.5, 0.0]))

    @pytest.mark.parametrize(("part", "weight"), [(POSITION, 2.0), (VELOCITY, 3.0), (RATES, 5.0)])
    def test_it_grows_with_the_square_of_how_far_off_each_row_is(self, part, weight):
        _, states = self.on_it()
        states[0, 2, part] += torch.tensor([0.3, -0.4, 0.0])
        states[0, 9, part] += torch.tensor([0.0, 0.0, 1.0])
        states[1, :, part] += torch.tensor([0.0, 0.2, 0.0])
        wanted = weight * torch.tensor([0.25 + 1.0, HORIZON * 0.04])
        torch.testing.assert_close(self.cost(states), wanted, rtol=1e-4, atol=1e-6)

    def test_on_a_curved_reference_what_it_turns_by_costs_nothing_and_what_is_missing_of_it_counts(self):
        task = following(plan_cost=self.task.plan_cost)
        which, rows = torch.tensor([[0], [4]]), torch.tensor([[3], [7]]) + torch.arange(HORIZON + 1)
        states, plan = task.states_on(which.expand_as(rows), rows), torch.zeros(2, HORIZON, 4)
        about = states[:, 0], torch.cat((which, rows[:, :1]), 1)
        torch.testing.assert_close(task.cost(states[:, 1:], plan, *about), torch.zeros(2), rtol=0, atol=1e-7)
        rates = states[:, 1:, RATES].clone()
        assert (rates.abs().amax((1, 2)) > 0.05).all()
        states[:, :, RATES] = 0.0
        torch.testing.assert_close(task.cost(states[:, 1:], plan, *about), 5.0 * rates.square().sum((1, 2)))

    def test_attitude_is_free(self):
        _, states = self.on_it()
        states[..., 6:10] = torch.randn(2, HORIZON, 4, generator=seeded())
        torch.testing.assert_close(self.cost(states), torch.zeros(2), rtol=0, atol=1e-9)

    def test_being_a_row_late_is_being_off_by_a_rows_way(self):
        which, row = self.task_state.unbind(1)
        late = torch.stack([self.task.states_on(which, row + k) for k in range(HORIZON)], 1)
        way = self.task.references.velocities[which, 0] * PERIOD
        torch.testing.assert_close(self.cost(late), 2.0 * HORIZON * way.square().sum(1), rtol=1e-4, atol=1e-6)


class TestReachCost:
    """The reference leads straight from here to the point, at 11.5 m/s."""

    task = reaching(along=2.0, across=3.0, rates=5.0, action=7.0)
    task_state = torch.tensor([[50.0, 4.0, -3.0], [50.0, 0.0, 0.0]], dtype=torch.float64)
    here = torch.tensor([[14.0, 4.0, 24.0], [20.0, 0.0, 0.0]], dtype=torch.float64)
    way = torch.tensor([[0.8, 0.0, -0.6], [1.0, 0.0, 0.0]], dtype=torch.float64)

    def on_it(self):
        now, states = torch.zeros(2, 13, dtype=torch.float64), torch.zeros(2, HORIZON, 13, dtype=torch.float64)
        now[:, POSITION] = self.here
        steps = 11.5 * 0.05 * torch.arange(1, HORIZON + 1, dtype=torch.float64)
        states[..., POSITION] = self.here[:, None] + steps[:, None] * self.way[:, None]
        states[..., VELOCITY] = 40.0  # speed is free
        return now, states

    def cost(self, states, plan=None):
        plan = torch.zeros(2, HORIZON, 4, dtype=torch.float64) if plan is None else plan
        return self.task.cost(states, plan, self.on_it()[0], self.task_state)

    def test_on_the_line_and_in_time_it_is_zero_but_for_effort(self):
        _, states = self.on_it()
        torch.testing.assert_close(self.cost(states), torch.zeros(2, dtype=torch.float64), rtol=0, atol=1e-12)
        found = self.cost(states, torch.full((2, HORIZON, 4), 0.5, dtype=torch.float64))
        torch.testing.assert_close(found, torch.full((2,), 7.0 * HORIZON, dtype=torch.float64))

    def test_being_late_or_early_weighs_less_than_being_aside(self):
        _, states = self.on_it()
        states[0, 1, POSITION] += 0.5 * self.way[0]
        states[0, 4, POSITION] -= 2.0 * self.way[0]
        states[1, 6, POSITION] += torch.tensor([0.0, 0.6, -0.8]).double()
        wanted = torch.tensor([2.0 * (0.25 + 4.0), 3.0], dtype=torch.float64)
        torch.testing.assert_close(self.cost(states), wanted)

    def test_both_at_once_and_rates_add_up(self):
        _, states = self.on_it()
        states[1, 3, POSITION] += torch.tensor([-2.0, 0.0, 1.5]).double()
        states[1, 5, RATES] = torch.tensor([0.1, 0.2, 0.2]).double()
        wanted = torch.tensor([0.0, 2.0 * 4.0 + 3.0 * 2.25 + 5.0 * 0.09], dtype=torch.float64)
        torch.testing.assert_close(self.cost(states), wanted)


class TestWhereStreamsStart:
    @pytest.mark.parametrize(("progress", "share"), [(0.0, 0.05), (0.25, 0.525), (0.5, 1.0), (1.0, 1.0)])
    def test_around_a_reference_as_far_off_as_the_curriculum_allows(self, progress, share):
        task = following()
        state, task_state = task.training_start(3000, progress, seeded())
        off = state - task.states_on(*task_state.unbind(1))
        torch.testing.assert_close(off[:, POSITION].std(0), torch.full((3,), 0.1 * share), rtol=0.06, atol=0)
        torch.testing.assert_close(off[:, VELOCITY].std(0), torch.full((3,), 0.2 * share), rtol=0.06, atol=0)
        assert not off[:, VELOCITY.stop :].any()

    def test_anywhere_on_any_reference_but_on_its_last_row_which_leads_nowhere(self):
        _, task_state = following().training_start(3000, 0.0, seeded())
        assert task_state[:, 0].unique().tolist() == list(range(6))
        assert task_state[:, 1].unique().tolist() == list(range(ROWS - 1))

    @pytest.mark.parametrize("progress", [0.0, 0.3, 1.0])
    def test_a_stream_does_not_stray_where_it_starts(self, progress):
        for task in (following(), reaching()):
            state, task_state = task.training_start(1000, progress, seeded())
            assert int(task.diverged(state, task_state, progress).sum()) < 10

    def test_half_of_the_wings_start_in_trim_and_the_others_near_the_line_to_the_point(self):
        task = reaching()
        state, task_state = task.training_start(4000, 0.0, seeded())
        trimmed = task.evaluation_start(1, seeded())[0]
        at_start = (state == trimmed).all(1)
        assert 0.47 < float(at_start.float().mean()) < 0.53
        off, to = state[~at_start] - trimmed, task_state[~at_start]
        share = off[:, :1] / to[:, :1]
        assert float(share.max()) > 0.98
        torch.testing.assert_close(share.mean(), torch.tensor(0.5), rtol=0.05, atol=0)
        aside = off[:, 1:3] - share * to[:, 1:]
        torch.testing.assert_close(aside.std(0), torch.full((2,), 0.5), rtol=0.07, atol=0)
        torch.testing.assert_close(off[:, VELOCITY].std(0), torch.full((3,), 0.5), rtol=0.07, atol=0)
        torch.testing.assert_close(off[:, RATES].std(0), torch.full((3,), 0.1), rtol=0.07, atol=0)
        assert not off[:, 6:10].any()


class TestStreams:
    WORLD = World(Quadrotor(), period=PERIOD)

    def step(self, made, off, progress):
        """One step without a command from states that are `off` (B, 3) m from where they were."""
        state = made.now.at.state.clone()
        state[:, POSITION] += off
        at = self.WORLD.step(self.WORLD.start(state), torch.zeros(len(state), 4))
        before = made.now.task_state.clone()
        made.advance(at, torch.zeros(len(state), 4), progress, seeded(3))
        return before

    def middle(self, batch=6):
        """Streams of one age amid their references."""
        made = streams(following(), self.WORLD, batch)
        made.age[:] = 7
        task_state = torch.stack((torch.arange(batch), torch.full((batch,), 12)), 1)
        at = self.WORLD.start(made.task.states_on(*task_state.unbind(1)))
        made.now = dataclasses.replace(made.now, at=at, task_state=task_state)
        return made

    @pytest.mark.parametrize(("progress", "far"), [(0.0, 0.1), (0.25, 1.05), (0.5, 2.0), (1.0, 2.0)])
    def test_one_that_strays_beyond_what_the_curriculum_allows_starts_anew(self, progress, far):
        made, off = self.middle(), torch.zeros(6, 3)
        off[1, 0], off[3, 2], off[4, 1] = 0.8 * far, 1.2 * far, math.nan
        before = self.step(made, off, progress)
        assert made.age.tolist() == [8, 8, 8, 0, 0, 8]
        kept = torch.tensor([0, 1, 2, 5])
        assert torch.equal(made.now.task_state[kept], before[kept] + torch.tensor([0, 1]))
        assert made.now.at.state.isfinite().all()
        assert not made.task.diverged(made.now.at.state, made.now.task_state, 1.0).any()
        # What the policy is shown goes with the task state: of those that go on and of those that begin.
        assert torch.equal(made.now.history.observations[:, -1, :13], made.now.at.state)
        assert torch.equal(made.now.history.observations[:, -1, 13:], made.task.goal(made.now.task_state))
        assert torch.equal(made.now.history.observations[3, 0], made.now.history.observations[3, -1])

    def test_one_at_the_end_of_its_reference_starts_anew(self):
        made = self.middle()
        made.now.task_state[2, 1] = ROWS - 2
        made.now.at.state[2] = made.task.states_on(*made.now.task_state[2:3].unbind(1))[0]
        self.step(made, torch.zeros(6, 3), 1.0)
        assert made.age.tolist() == [8, 8, 0, 8, 8, 8]

    def test_one_that_has_gone_on_for_long_enough_starts_anew(self):
        made = self.middle()
        made.longest = 20
        made.age[5] = 19
        self.step(made, torch.zeros(6, 3), 1.0)
        assert made.age.tolist() == [8, 8, 8, 8, 8, 0]

    def test_a_wing_that_has_passed_its_point_or_flies_far_from_the_line_starts_anew(self):
        world = World(FixedWing(), period=0.05)
        made = streams(reaching(), world, 5)
        made.age[:] = 7
        state, task_state = made.task.evaluation_start(5, seeded())
        made.now = dataclasses.replace(made.now, task_state=task_state)
        state[:, POSITION] = 0.5 * task_state
        state[1, POSITION] = task_state[1] + torch.tensor([0.1, 0.0, 0.0])
        state[2, POSITION] += torch.tensor([0.0, 9.0, 0.0])
        state[3, POSITION] += torch.tensor([0.0, 0.0, 6.0])
        at = world.step(world.start(state), torch.zeros(5, 4))
        made.advance(at, torch.zeros(5, 4), 0.0, seeded(3))
        assert made.age.tolist() == [8, 0, 0, 8, 8]
        assert torch.equal(made.now.task_state[[0, 3, 4]], task_state[[0, 3, 4]])
        assert torch.equal(made.now.history.observations[:, -1, 13:], made.now.task_state)

    @pytest.mark.parametrize("spread", [(0.0, 0.0), (0.3, 0.8)])
    def test_recorded_starts_are_as_far_off_another_reference_but_for_the_spread_with_the_past_they_had(self, spread):
        """What the source leaves unexplained stays as it was recorded: without air a vehicle flies alike anywhere."""
        task = following(first_divergence=1.0, start_spread=spread)
        target = FlightTarget(task, Quadrotor(), push(2.0))
        torch.manual_seed(0)
        flown = run(target, FollowPolicy(PERIOD), 2, 12, seeded(4))
        transitions = Transitions.cut([each.episode for each in flown])
        made = Streams(self.WORLD, task, identity, transitions, 40, 1000, 1.0, torch.zeros(()))
        made.start(0.0, seeded(5))
        network = FlightResidualNetwork(Quadrotor(), PERIOD, self.WORLD.steps_along)

        def unexplained(history):
            return network.unexplained(network.predict, history.observations[..., :13], history.actions)

        def off(state, task_state):
            return state[..., : VELOCITY.stop] - task.states_on(*task_state.long().unbind(-1))[..., : VELOCITY.stop]

        now, found, further = made.now, set(), []
        every = transitions.history(torch.arange(len(transitions)))
        for b in range(40):
            alike = (every.actions - now.history.actions[b]).abs().amax((1, 2)) == 0
            alike &= (transitions.state - now.at.state[b])[:, VELOCITY.stop :].abs().amax(1) == 0
            row = int(alike.nonzero()[0])
            found.add(row)
            here, there = off(now.at.state[b : b + 1], now.task_state[b : b + 1]), transitions.state[row : row + 1]
            further.append(here - off(there, transitions.task_states[transitions.rows[row, -1:]]))
            past = unexplained(transitions.history(torch.tensor([row])))
            torch.testing.assert_close(unexplained(now.history[b : b + 1]), past, rtol=0, atol=2e-3)
        added = torch.cat(further)
        assert (added.abs() <= 1e-5 + 5 * torch.tensor(spread).repeat_interleave(3)).all()
        metres, speed = added.square().mean(0).sqrt().split(3)
        torch.testing.assert_close(metres, torch.full((3,), spread[0]), rtol=0.3, atol=1e-5)
        torch.testing.assert_close(speed, torch.full((3,), spread[1]), rtol=0.3, atol=1e-5)
        assert len(found) > 12
        assert set(now.task_state[:, 0].tolist()) - set(target.first[:, 0].tolist())
        assert torch.equal(now.history.observations[:, -1, :13], now.at.state)
        assert torch.equal(now.history.observations[:, -1, 13:], task.goal(now.task_state))

    def test_recorded_starts_of_a_wing_are_as_they_were_recorded_with_all_that_it_was_shown(self):
        task = reaching()
        target = FlightTarget(task, FixedWing(), push(2.0))
        torch.manual_seed(0)
        flown = run(target, ReachPolicy(), 2, 12, seeded(4))
        transitions = Transitions.cut([each.episode for each in flown])
        made = Streams(World(FixedWing(), period=0.05), task, identity, transitions, 20, 1000, 1.0, torch.zeros(()))
        made.start(0.0, seeded(5))
        for b in range(20):
            # Both flights begin in the same state: their points tell them apart.
            there = (transitions.task_states[transitions.rows[:, -1]] == made.now.task_state[b]).all(1)
            row = int(((transitions.state == made.now.at.state[b]).all(1) & there).nonzero()[0])
            seen = transitions.history(torch.tensor([row])).observations[0]
            assert torch.equal(made.now.history.observations[b, :, :13], seen)
            assert torch.equal(made.now.history.observations[b, :, 13:], made.now.task_state[b].expand(LENGTH, -1))
            assert torch.equal(made.now.history.actions[b], transitions.history(torch.tensor([row])).actions[0])

    def test_tuned_along_references_the_cost_of_a_plan_falls(self):
        torch.manual_seed(0)
        task, policy = following(), FollowPolicy(PERIOD)
        state, task_state = task.training_start(64, 0.3, seeded(9))

        def show(at):
            return task.show(at, task_state)

        @torch.no_grad()
        def cost():
            history = History.start(show(state), 4)
            plan = policy(history)
            states, _ = imagine(self.WORLD, show, self.WORLD.start(state), history, plan)
            return float(task.cost(states, plan, state, task_state).mean())

        before = cost()
        settings = TuneSettings(task, 15, 64, learning_rate=1e-2, longest=5, observation_noise=0.0)
        tune(policy, self.WORLD, identity, settings, seeded())
        assert cost() < 0.6 * before


class Imagined:
    """A vehicle with a drag, and a residual that looks back, in double precision."""

    def __init__(self, task, system, period, policy):
        self.task = task
        source = World(system, period=period)
        network = FlightResidualNetwork(system, period, source.steps_along)
        self.residual = Residual(stir(network.double(), 1), torch.full((13,), 0.02)).double()
        self.world = World(system, [self.residual, LinearDrag(coefficient=0.3)], period).requires_grad_(False)
        state, self.task_state = task.training_start(3, 1.0, seeded(2))
        self.task_state = self.task_state.double() if self.task_state.is_floating_point() else self.task_state
        self.at = self.world.start(state.double())
        self.history = History.start(self.show(state.double()), 4)
        self.policy = stir(policy.double(), 2)
        self.policy.residual = self.residual

    def show(self, state):
        return self.task.show(state, self.task_state)

    def cost(self, plan):
        states, _ = imagine(self.world, self.show, self.at, self.history, plan)
        return self.task.cost(states, plan, self.at.state, self.task_state).sum()


def along_reference():
    task = Follow(waves(6, ROWS, dtype=torch.float64))
    return Imagined(task, Quadrotor(), PERIOD, FollowPolicy(PERIOD))


def to_target():
    return Imagined(reaching(), FixedWing(), 0.05, ReachPolicy())


@pytest.mark.parametrize("made", [along_reference, to_target])
class TestGradient:
    """Against central differences."""

    @pytest.mark.parametrize("step", [0, 4, 9])
    def test_along_a_planned_action_through_physics_and_residual(self, made, step):
        imagined, generator = made(), seeded(3)
        plan = 0.6 * (2 * torch.rand(3, HORIZON, 4, generator=generator, dtype=torch.float64) - 1)
        direction = torch.zeros_like(plan)
        direction[:, step] = torch.randn(3, 4, generator=generator, dtype=torch.float64)
        asked = plan.clone().requires_grad_()
        imagined.cost(asked).backward()
        with torch.no_grad():
            ahead, back = (imagined.cost(plan + size * direction) for size in (1e-6, -1e-6))
        found = float((asked.grad * direction).sum())
        assert abs(found) > 1e-3
        assert found == pytest.approx(float((ahead - back) / 2e-6), rel=1e-5)

    def test_along_the_policys_weights(self, made):
        imagined = made()
        policy = imagined.policy
        weights = [weight for weight in policy.parameters() if weight.requires_grad]
        assert len(weights) == 12
        generator = seeded(7)
        ways = [1e-2 * torch.randn(weight.shape, generator=generator, dtype=torch.float64) for weight in weights]
        imagined.cost(policy(imagined.history)).backward()
        found = sum(float((weight.grad * way).sum()) for weight, way in zip(weights, ways, strict=True))
        costs = []
        with torch.no_grad():
            kept = [weight.clone() for weight in weights]
            for size in (1e-5, -1e-5):
                for weight, was, way in zip(weights, kept, ways, strict=True):
                    weight.copy_(was + size * way)
                costs.append(float(imagined.cost(policy(imagined.history))))
        assert abs(found) > 1e-3
        assert found == pytest.approx((costs[0] - costs[1]) / 2e-5, rel=1e-4)
