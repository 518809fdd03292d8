"""What rotors do to a quadrotor beside giving the thrust that is asked: drag, lift, and motors that lag."""

import math

import pytest
import torch

from visadapt.effects import Inertia, LinearDrag, MotorLag, RateDamping, RotorDrag, TranslationalLift, Wind
from visadapt.systems import FixedWing, Quadrotor
from visadapt.systems.rigid_body import ATTITUDE, from_angles
from visadapt.world import World


def moving(velocity=(0.0, 0.0, 0.0), angles=(0.0, 0.0, 0.0)):
    """A state (1, 13) with a velocity in world axes and roll, pitch and yaw, in float64."""
    state = torch.zeros(1, 13, dtype=torch.float64)
    state[:, 3:6] = torch.tensor(velocity)
    state[:, ATTITUDE] = from_angles(torch.tensor([angles], dtype=torch.float64))
    return state


def force(effects, state, system=None):
    """What effects push by (3,) in N, in world axes."""
    world = World(system or Quadrotor(), effects).requires_grad_(False)
    load = world.load(world.start(state))[0]
    assert load[3:].abs().max() == 0
    return load[:3].tolist()


DRAG = {"coefficient_x": 0.2, "coefficient_y": 0.3, "coefficient_z": 0.7}


class TestDragAndLift:
    def test_level_each_axis_has_its_own_drag(self):
        found = force([RotorDrag(**DRAG)], moving((2.0, -1.0, 0.5)))
        assert found == pytest.approx([-0.4, 0.3, -0.35], rel=1e-6)

    def test_drag_turns_with_the_body(self):
        # Turned to the left by 90 degrees, and then on its side, the axis of the rotors along the world's -x or so.
        yawed = force([RotorDrag(**DRAG)], moving((2.0, 0.0, 0.0), (0.0, 0.0, math.pi / 2)))
        assert yawed == pytest.approx([-0.6, 0.0, 0.0], abs=1e-6)
        on_its_side = force([RotorDrag(**DRAG)], moving((2.0, 0.0, 0.0), (0.0, math.pi / 2, 0.0)))
        assert on_its_side == pytest.approx([-1.4, 0.0, 0.0], abs=1e-6)

    def test_the_same_along_all_axes_it_is_linear_drag(self):
        state = moving((2.0, -1.0, 0.5), (0.4, -0.3, 1.0))
        alike = RotorDrag(coefficient_x=0.3, coefficient_y=0.3, coefficient_z=0.3)
        assert force([alike], state) == pytest.approx(force([LinearDrag(coefficient=0.3)], state), rel=1e-6)

    def test_air_across_the_rotors_lifts_and_air_along_their_axis_does_not(self):
        lift = TranslationalLift(coefficient=0.1)
        assert force([lift], moving((3.0, 4.0, -2.0))) == pytest.approx([0.0, 0.0, 2.5], rel=1e-6)
        # Pitched by 90 degrees the axis of the rotors is the world's x.
        assert force([lift], moving((5.0, 0.0, 0.0), (0.0, math.pi / 2, 0.0))) == pytest.approx([0, 0, 0], abs=1e-6)
        pitched = force([lift], moving((0.0, 0.0, 2.0), (0.0, math.pi / 2, 0.0)))
        assert pitched == pytest.approx([0.4, 0.0, 0.0], abs=1e-6)

    def test_both_are_nothing_at_the_wind_s_own_velocity(self):
        wind = Wind(velocity_x=2.0, velocity_y=-1.0, velocity_z=0.5, coefficient=0.0)
        carried = force([wind, RotorDrag(**DRAG), TranslationalLift(coefficient=0.1)], moving((2.0, -1.0, 0.5)))
        assert carried == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)


def test_damping_leaves_of_a_rate_what_the_loop_s_gain_holds_against_it():
    world = World(Quadrotor(), [RateDamping(rate_x=4.0, rate_y=0.0, rate_z=2.0)], 0.1, substeps=4).requires_grad_(False)
    at = world.start(moving())
    for _ in range(40):
        at = world.step(at, torch.tensor([[0.0, 0.6, 0.6, 0.6]], dtype=torch.float64))
    shares = (at.state[0, 10:] / 0.3).tolist()
    assert shares == pytest.approx([16.6 / 20.6, 1.0, 5.0 / 7.0], rel=1e-4)


def lagging(commands, period, tau, gain=16.6, damping=0.0, fine=2000):
    """A rate as a share of what 1 asks for, at the end of each period, by Euler's method in very small steps."""
    rate = torque = 0.0
    h, rates = period / fine, []
    for command in commands:
        for _ in range(fine):
            rate, torque = rate + h * (gain * torque - damping * rate), torque + h * (command - rate - torque) / tau
        rates.append(rate)
    return rates


class TestMotorLag:
    COMMANDS = (0.8, 0.8, -0.5, 0.0, 0.0, 1.0, 1.0)

    @pytest.mark.parametrize("tau", [0.002, 0.05, 0.25])
    def test_a_rate_follows_as_a_loop_around_a_lagging_torque_does(self, tau):
        """The loop of 16.6 1/s rings from a lag of 15 ms on."""
        world = World(Quadrotor(), [MotorLag(time_constant=tau).requires_grad_(False)], 0.1, substeps=40)
        at, rates = world.start(moving()), []
        for command in self.COMMANDS:
            at = world.step(at, torch.tensor([[0.0, command, 0.0, 0.0]], dtype=torch.float64))
            rates.append(float(at.state[0, 10]) / 0.5)
        assert rates == pytest.approx(lagging(self.COMMANDS, 0.1, tau), abs=0.01)

    def test_the_loop_that_lags_is_that_of_the_inertia_and_the_damping_that_there_are(self):
        alike = {"scale_x": 2.0, "scale_y": 1.0, "scale_z": 1.0}
        effects = [Inertia(**alike), RateDamping(rate_x=5.0, rate_y=0.0, rate_z=0.0), MotorLag(time_constant=0.05)]
        world = World(Quadrotor(), effects, 0.1, substeps=40).requires_grad_(False)
        at, rates = world.start(moving()), []
        for command in self.COMMANDS:
            at = world.step(at, torch.tensor([[0.0, command, 0.0, 0.0]], dtype=torch.float64))
            rates.append(float(at.state[0, 10]) / 0.5)
        assert rates == pytest.approx(lagging(self.COMMANDS, 0.1, 0.05, 16.6 / 2, 5.0 / 2), abs=0.01)

    def test_a_step_of_the_thrust_comes_late_by_the_time_constant(self):
        system, tau = Quadrotor(gravity=1e-9), 0.05
        speeds = []
        for effects in ([], [MotorLag(time_constant=tau).requires_grad_(False)]):
            world = World(system, effects, 0.1)
            at = world.start(moving())
            for _ in range(10):
                at = world.step(at, torch.tensor([[0.5, 0.0, 0.0, 0.0]], dtype=torch.float64))
            speeds.append(float(at.state[0, 5]))
        # From the middle of the range, where rotors start, by half of 7.55 m/s2, for 20 time constants.
        assert speeds[0] - speeds[1] == pytest.approx(0.5 * 7.55 * tau, rel=1e-5)

    def test_once_all_has_settled_a_disturbed_rate_is_that_without_lag(self):
        rates = []
        for effects in ([], [MotorLag(time_constant=0.05)]):
            world = World(Quadrotor(centre_x=0.001), effects, 0.1, substeps=2).requires_grad_(False)
            at = world.start(moving())
            for _ in range(30):
                at = world.step(at, torch.tensor([[0.0, 0.0, 0.6, 0.0]], dtype=torch.float64))
            rates.append(at.state[0, 10:])
        torch.testing.assert_close(rates[0], rates[1], rtol=0, atol=1e-6)

    def test_it_lags_no_wing(self):
        with pytest.raises(TypeError, match="motor_lag acts on a quadrotor, not on a fixed_wing"):
            World(FixedWing(), [MotorLag(time_constant=0.05)])
