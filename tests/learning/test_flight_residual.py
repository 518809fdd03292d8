"""What the vehicles' residual learns from a few hundred samples."""

import math

import numpy as np
import pytest
import torch

from tests.flying import PERIOD, seeded
from tests.scenes import stir
from visadapt.effects import ActuatorLag, LinearDrag, PeriodicForce, Residual
from visadapt.history import LENGTH, History
from visadapt.learning.grounding import GroundSettings, gap, ground, rescale
from visadapt.learning.plans import imagine
from visadapt.learning.transitions import Transitions
from visadapt.policies.networks import FlightResidualNetwork
from visadapt.recordings import Episode
from visadapt.systems import FixedWing, Quadrotor
from visadapt.systems.rigid_body import POSITION, VELOCITY
from visadapt.world import World

RATE = 0.3
SOURCE = World(Quadrotor(), period=PERIOD, substeps=2)
predict = SOURCE.steps_along


def a_network(with_history=False):
    return FlightResidualNetwork(Quadrotor(), PERIOD, predict if with_history else None)


def flights(effects, count, rows, seed=0):
    """Episodes of a quadrotor with effects, from random states under random commands around hovering."""
    generator = seeded(seed)
    world = World(Quadrotor(), effects, PERIOD, substeps=2).requires_grad_(False)
    state = 0.2 * torch.randn(count, 13, generator=generator)
    state[:, VELOCITY] *= 5
    state[:, 6] = 1.0
    at, states, actions = world.start(state), [state], []
    for _ in range(rows - 1):
        actions.append((0.2 * torch.randn(count, 4, generator=generator)).clamp(-1, 1))
        at = world.step(at, actions[-1])
        states.append(at.state)
    whole, done = torch.stack(states, 1).numpy(), torch.stack([*actions, torch.zeros(count, 4)], 1).numpy()
    return [Episode(np.arange(rows) * PERIOD, done[b], whole[b]) for b in range(count)]


def swaying(count, seed):
    """A force of 2 N along x that comes and goes, with another phase in each flight."""
    phase = math.pi * (2 * torch.rand(count, generator=seeded(seed)) - 1)
    return [PeriodicForce(amplitude=2.0, frequency=0.2, phase=phase, offset=0.0)]


def fitted(network, transitions):
    residual = Residual(network, torch.ones(13))
    rescale(residual, SOURCE, transitions)
    ground(residual, SOURCE, transitions, GroundSettings(ridges=(0.1,)), seeded())
    return residual


def left(residual, transitions):
    """Root mean squares (13,) of what remains of the gap."""
    with torch.no_grad():
        every = torch.arange(len(transitions))
        delta = residual.delta(transitions.history(every).acting(transitions.action))
    return (gap(SOURCE, transitions) - delta).square().mean(0).sqrt()


@pytest.fixture(scope="module")
def residual():
    transitions = Transitions.cut(flights([LinearDrag(coefficient=RATE)], 30, 11))
    assert len(transitions) == 300
    return fitted(a_network(), transitions)


class TestDrag:
    def test_it_finds_the_share_of_the_velocity_that_is_lost_in_a_period(self, residual):
        weight = residual.scale[:, None] * residual.network.head.weight
        lost = -(1 - math.exp(-RATE * PERIOD)) * torch.eye(3)
        torch.testing.assert_close(weight[VELOCITY, :3], lost, rtol=0.02, atol=5e-4)
        behind = -(PERIOD - (1 - math.exp(-RATE * PERIOD)) / RATE) * torch.eye(3)
        torch.testing.assert_close(weight[POSITION, :3], behind, rtol=0.02, atol=5e-5)

    def test_nothing_is_added_to_what_drag_does_not_change(self, residual):
        weight = residual.scale[:, None] * residual.network.head.weight
        assert weight[VELOCITY.stop :].abs().max() < 1e-4

    def test_on_flights_not_seen_nine_tenths_of_the_gap_are_closed(self, residual):
        transitions = Transitions.cut(flights([LinearDrag(coefficient=RATE)], 30, 11, seed=1))
        before, after = gap(SOURCE, transitions).square().mean(0).sqrt(), left(residual, transitions)
        assert (after[: VELOCITY.stop] < 0.1 * before[: VELOCITY.stop]).all()


class TestForceThatChanges:
    def test_with_a_history_it_is_followed_whatever_its_phase_and_without_one_it_is_not(self):
        transitions = Transitions.cut(flights(swaying(8, 0), 8, 51))
        unseen = Transitions.cut(flights(swaying(8, 1), 8, 51, seed=1))
        before = gap(SOURCE, unseen).square().mean(0).sqrt()[VELOCITY.start]
        seeing, blind = (
            left(fitted(a_network(history), transitions), unseen)[VELOCITY.start] for history in (True, False)
        )
        assert seeing < 0.25 * before
        assert blind > 0.8 * before

    def test_imagined_on_from_a_seventh_row_it_goes_on_for_seconds_as_it_does_in_truth(self):
        """Fed with what it says itself, the residual neither dies down nor runs away."""
        residual = fitted(a_network(True), Transitions.cut(flights(swaying(8, 0), 8, 51)))
        unseen = flights(swaying(8, 1), 8, 51, seed=1)
        transitions = Transitions.cut(unseen)
        rows = torch.arange(6, len(transitions), 50)
        plan = torch.stack([transitions.action[rows + k] for k in range(40)], 1)
        truth = torch.stack([transitions.next_state[rows + k] for k in range(40)], 1)
        off = []
        for effects in ([residual], []):
            world = World(Quadrotor(), effects, PERIOD, substeps=2)
            with torch.no_grad():
                states, _ = imagine(
                    world, lambda state: state, world.start(transitions.state[rows]), transitions.history(rows), plan
                )
            off.append((states - truth)[..., VELOCITY.start].square().mean().sqrt())
        assert off[0] < 0.02 * off[1]

    def test_before_a_flight_begins_stands_what_its_first_period_left_unexplained(self):
        force = PeriodicForce(amplitude=2.0, frequency=0.2, phase=0.5, offset=0.0)
        transitions = Transitions.cut(flights([force], 4, 4))
        network = a_network(True)

        def found(row):
            history = transitions.history(torch.arange(row, len(transitions), 3)).acting(torch.zeros(4, 4))
            return network.unexplained(predict, history.observations, history.actions).unflatten(1, (-1, 6))

        assert not found(0).any()
        assert (found(1)[..., 0] > 0.5).all()
        assert torch.equal(found(1), found(1)[:, -1:].expand(-1, LENGTH - 1, -1))
        assert torch.equal(found(2)[:, :-1], found(1)[:, 1:])

    def test_samples_whose_past_is_not_whole_are_not_learnt_from(self):
        network, transitions = a_network(True), Transitions.cut(flights(swaying(8, 0), 8, 11))
        fitted(network, transitions)
        seen = network.embed(transitions.history(torch.arange(len(transitions))).acting(transitions.action))
        assert network.has_full_history(seen).tolist() == ([False] * 4 + [True] * 6) * 8
        assert a_network().has_full_history(seen).all()

    def test_what_the_source_left_unexplained_is_the_force_over_the_mass_and_nothing_else(self):
        force = PeriodicForce(amplitude=2.0, frequency=0.2, phase=0.5, offset=0.0)
        transitions = Transitions.cut(flights([force], 4, LENGTH + 1))
        history = transitions.history(torch.arange(LENGTH - 1, len(transitions), LENGTH))
        states = torch.stack([transitions.state[k : k + LENGTH] for k in range(0, len(transitions), LENGTH)])
        actions = torch.stack([transitions.action[k : k + LENGTH] for k in range(0, len(transitions), LENGTH)])
        assert torch.equal(history.observations, states)
        found = a_network(True).unexplained(predict, states, actions).unflatten(1, (LENGTH - 1, 6))
        ends = 2 * (2 * math.pi * 0.2 * PERIOD * torch.arange(LENGTH) + 0.5).sin() / (2 * math.pi * 0.2)
        # In units of 0.2 m/s2 over a period.
        wanted = ends.diff() / (0.2 * PERIOD)
        torch.testing.assert_close(found[..., 0], wanted.expand(4, -1), rtol=2e-3, atol=2e-3)
        assert found[..., 1:].abs().max() < 1e-2

    def test_it_tells_how_much_pushes_and_how_fast_that_changes(self):
        force = PeriodicForce(amplitude=2.0, frequency=0.2, phase=0.5, offset=0.0)
        transitions = Transitions.cut(flights([force], 4, LENGTH + 1))
        rows = torch.arange(LENGTH - 1, len(transitions), LENGTH)
        estimate = a_network(True).disturbance(transitions.history(rows).acting(transitions.action[rows]))
        turn = 2 * math.pi * 0.2
        # In units of 2 m/s2 and 2 m/s3: half a period, and two periods, before the last row.
        now, middle = (0.5 + turn * PERIOD * (LENGTH - 1 - back) for back in (0.5, 2.0))
        torch.testing.assert_close(estimate[:, 0], torch.full((4,), math.cos(now)), rtol=0, atol=0.01)
        torch.testing.assert_close(estimate[:, 6], torch.full((4,), -turn * math.sin(middle)), rtol=0, atol=0.03)
        assert estimate[:, [1, 2, 3, 4, 5]].abs().max() < 0.01
        assert not a_network().disturbance(transitions.history(torch.arange(4))).any()


@pytest.mark.parametrize("with_history", [False, True])
class TestNetwork:
    def history(self, dtype=torch.float32, goal=0):
        states = torch.randn(3, LENGTH, 13 + goal, generator=seeded(), dtype=dtype)
        return History(states, 2 * torch.rand(3, LENGTH, 4, generator=seeded(1), dtype=dtype) - 1)

    def test_it_is_zero_at_first(self, with_history):
        assert torch.equal(a_network(with_history)(self.history()), torch.zeros(3, 13))

    def test_double_precision_stays_double_and_goals_are_not_read(self, with_history):
        network = stir(a_network(with_history).double())
        history = self.history(torch.float64, goal=60)
        own = History(history.observations[..., :13], history.actions)
        assert network(history).dtype == torch.float64
        assert torch.equal(network(history), network(own))

    def test_where_the_vehicle_is_does_not_matter(self, with_history):
        network, history = stir(a_network(with_history).double()), self.history(torch.float64)
        moved = history.observations.clone()
        moved[..., POSITION] += 10.0
        torch.testing.assert_close(network(History(moved, history.actions)), network(history))

    def test_older_rows_are_read_where_there_is_a_history(self, with_history):
        network, history = stir(a_network(with_history)), self.history()
        older = History(history.observations.clone(), history.actions.clone())
        older.observations[:, 0, VELOCITY] += 1.0
        older.actions[:, 0] += 0.5
        assert torch.equal(network(history), network(older)) != with_history

    def test_it_fits_a_wing_as_well(self, with_history):
        source = World(FixedWing(), period=0.05)
        back = source.steps_along if with_history else None
        assert FlightResidualNetwork(FixedWing(), 0.05, back)(self.history()).shape == (3, 13)


def test_what_a_named_lag_explains_is_not_left_over_whatever_the_commands_before():
    """A source that forgot its commands between two rows would blame the lag's memory on a disturbance."""
    source = World(Quadrotor(), [ActuatorLag(time_constant=0.08)], PERIOD, substeps=2).requires_grad_(False)
    network = FlightResidualNetwork(Quadrotor(), PERIOD, source.steps_along).double()
    state = torch.zeros(3, 13, dtype=torch.float64)
    state[:, 6] = 1.0
    at = source.start(state)
    states, actions = [at.state], 0.3 * torch.randn(LENGTH - 1, 3, 4, generator=seeded()).double()
    for action in actions:
        at = source.step(at, action)
        states.append(at.state)
    history = History(torch.stack(states, 1), torch.cat((actions, actions[-1:])).movedim(0, 1))
    assert float(network.disturbance(history).abs().max()) < 1e-9
