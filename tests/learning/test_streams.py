"""Where recorded transitions and streams begin: at their own time, with the memory of their past, seen by sensors."""

import numpy as np
import pytest
import torch

from visadapt.effects import EFFECTS, ActuatorDelay, AngleOffset, ConstantForce, Dropout, MeasurementDelay, Residual
from visadapt.history import History
from visadapt.learning.grounding import gap
from visadapt.learning.plans import imagine
from visadapt.learning.streams import Streams
from visadapt.learning.transitions import Transitions
from visadapt.policies.networks import StateResidualNetwork
from visadapt.recordings import Episode
from visadapt.systems import CartPole
from visadapt.tasks.balance import PAPER_CARTPOLE, Balance
from visadapt.world import World

WIDE = Balance(PAPER_CARTPOLE, divergence=(1e9,) * 4, first_divergence=1.0, kick=(0.0,) * 4)

HIDDEN = {
    "actuator_delay": {"delay": 0.08},
    "actuator_lag": {"time_constant": 0.1},
    "actuator_backlash": {"width": 0.3},
    "periodic_force": {"amplitude": 2.0, "frequency": 0.7, "phase": 0.5, "offset": 0.5},
    "gust": {"start": 0.3, "end": 0.9, "force": 4.0},
}


def world_with(*effects):
    return World(CartPole(), effects).requires_grad_(False)


def episodes_of(world, lengths=(30, 12, 21), seed=0):
    """Episodes of true states under random commands, of these numbers of rows."""
    generator = torch.Generator().manual_seed(seed)
    made = []
    for rows in lengths:
        at = world.start(0.1 * torch.randn(1, 4, generator=generator))
        actions, states = 0.5 * torch.randn(rows, 1, 1, generator=generator), [at.state]
        for action in actions[:-1]:
            at = world.step(at, action)
            states.append(at.state)
        made.append(Episode(0.05 * np.arange(rows), actions[:, 0].numpy(), torch.cat(states).numpy()))
    return made


def streams_of(world, task=WIDE, observe=None, transitions=None, recorded=0.0, count=40):
    made = Streams(world, task, observe, transitions, count, 1000, recorded, torch.zeros(()))
    made.start(1.0, torch.Generator().manual_seed(1))
    return made


@pytest.mark.parametrize("name", HIDDEN)
def test_the_world_that_was_recorded_leaves_no_gap_in_any_window(name):
    world = world_with(EFFECTS[name](**HIDDEN[name]))
    transitions = Transitions.cut(episodes_of(world))
    assert gap(world, transitions).abs().max() < 1e-5
    assert gap(world_with(), transitions).abs().max() > 0.01


@pytest.mark.parametrize("name", HIDDEN)
def test_streams_that_start_in_a_recording_go_on_as_it_did(name):
    world = world_with(EFFECTS[name](**HIDDEN[name]))
    transitions = Transitions.cut(episodes_of(world))
    streams = streams_of(world, transitions=transitions, recorded=1.0)
    rows = (transitions.state[:, None] == streams.now.at.state).all(2).int().argmax(0)
    assert len(rows.unique()) > 15
    after = world.step(streams.now.at, transitions.action[rows]).state
    torch.testing.assert_close(after, transitions.next_state[rows], rtol=0, atol=1e-5)
    torch.testing.assert_close(streams.now.at.time, transitions.time[rows])


class TestTimeOfOtherStarts:
    def test_where_effects_depend_on_time_all_times_of_the_recording_are_met(self):
        world = world_with(EFFECTS["gust"](**HIDDEN["gust"]))
        transitions = Transitions.cut(episodes_of(world))
        time = streams_of(world, transitions=transitions).now.at.time
        assert float(time.max()) > 1.0
        assert len(time.unique()) > 10
        assert set(time.tolist()) <= set(transitions.time.tolist())

    @pytest.mark.parametrize("name", ["actuator_delay", "actuator_backlash"])
    def test_elsewhere_they_begin_at_zero(self, name):
        world = world_with(EFFECTS[name](**HIDDEN[name]))
        transitions = Transitions.cut(episodes_of(world))
        assert not streams_of(world, transitions=transitions).now.at.time.any()

    def test_without_a_recording_all_times_of_an_episode_are_met(self):
        time = streams_of(world_with(EFFECTS["gust"](start=8.0, end=9.0, force=4.0)), count=400).now.at.time
        assert 0.0 <= time.min() < 0.5
        assert 12.0 < time.max() < 12.5

    def test_without_a_recording_they_begin_at_zero_where_nothing_depends_on_time(self):
        assert not streams_of(world_with(ActuatorDelay(delay=0.08))).now.at.time.any()


class TestSensors:
    def test_a_policy_on_states_is_shown_what_the_sensors_measure(self):
        world = world_with(AngleOffset(offset=0.1))
        streams = streams_of(world)
        for _ in range(3):
            shown, state = streams.now.history.observations[:, -1], streams.now.at.state
            torch.testing.assert_close(shown, state + torch.tensor([0, 0, 0.1, 0]))
            action = torch.zeros(40, 1)
            streams.advance(world.step(streams.now.at, action), action, 1.0, torch.Generator().manual_seed(2))

    def test_late_measurements_stay_late_in_streams_and_recorded_ones_begin_with_their_past(self):
        delay = MeasurementDelay(delay=0.1)
        transitions = Transitions.cut(episodes_of(world_with()))
        world = world_with(delay)
        streams = streams_of(world, transitions=transitions, recorded=1.0)
        before = (transitions.state[:, None] == streams.now.at.state).all(2).int().argmax(0)
        late = transitions.time[before] > 1.5 * world.period
        action = torch.zeros(40, 1)
        streams.advance(world.step(streams.now.at, action), action, 1.0, torch.Generator().manual_seed(2))
        shown = streams.now.history.observations[:, -1]
        # Two periods late: a row after the start, that is the row before it.
        torch.testing.assert_close(shown[late], transitions.state[before - 1][late], rtol=0, atol=1e-5)

    def test_a_camera_shows_the_true_state(self):
        streams = streams_of(world_with(AngleOffset(offset=0.1)), observe=lambda state: 2 * state)
        torch.testing.assert_close(streams.now.history.observations[:, -1], 2 * streams.now.at.state)

    def test_lost_rows_repeat_the_last_one_at_about_the_rate_and_alike_for_a_seed(self):
        world = world_with(Dropout(rate=0.3))
        action, seen = torch.zeros(400, 1), []
        for _ in range(2):
            generator, streams = torch.Generator().manual_seed(2), streams_of(world, count=400)
            streams.advance(world.step(streams.now.at, action), action, 1.0, generator)
            seen.append(streams.now.history.observations)
        assert torch.equal(*seen)
        repeated = (seen[0][:, -1] == seen[0][:, -2]).all(1).float().mean()
        assert 0.2 < float(repeated) < 0.4

    def test_within_a_plan_a_residual_reads_what_the_sensors_measure(self):
        torch.manual_seed(0)
        network = StateResidualNetwork(4)
        with torch.no_grad():
            for weight in network.parameters():
                weight.copy_(0.3 * torch.randn_like(weight))
        sensors = [AngleOffset(offset=0.1), MeasurementDelay(delay=0.07)]
        effects = [Residual(network, torch.ones(4)), ConstantForce(force=1.0), ActuatorDelay(delay=0.03), *sensors]
        world = world_with(*effects)
        state = 0.1 * torch.randn(3, 4)
        plan = 0.5 * torch.randn(3, 6, 1)
        measured, at = world.measure(world.start(state))
        history = History.start(measured, 1)
        states, first = imagine(world, None, at, history, plan)
        for k in range(6):
            at = world.step(at, plan[:, k], history)
            torch.testing.assert_close(states[:, k], at.state)
            measured, at = world.measure(at)
            history = history.acting(plan[:, k]).observing(measured)
            if k == 0:
                torch.testing.assert_close(world.measure(first)[0], measured)
