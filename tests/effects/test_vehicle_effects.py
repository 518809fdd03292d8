import math
from dataclasses import replace

import pytest
import torch

from visadapt.effects import (
    BatterySag,
    CenterOfMassOffset,
    ConstantForce,
    ControlEffectiveness,
    Drag,
    GroundEffect,
    Inertia,
    LiftSlope,
    LinearDrag,
    Mass,
    Payload,
    PeriodicForce,
    PeriodicWind,
    QuadraticDrag,
    RotorEfficiency,
    ThrustGain,
    TrimOffset,
    ViscousFriction,
    Wind,
)
from visadapt.systems import CartPole, FixedWing, Quadrotor
from visadapt.world import World


def flying(batch=3, seed=0):
    """States (batch, 13) of a vehicle under way, in float64."""
    generator = torch.Generator().manual_seed(seed)
    state = 0.3 * torch.randn(batch, 13, generator=generator, dtype=torch.float64)
    state[:, 3] += 5.0
    state[:, 6] += 1.0
    return state


def level(batch=1, velocity=(0.0, 0.0, 0.0), height=10.0):
    """States (batch, 13) of a vehicle that is level and does not turn, in float64."""
    state = torch.zeros(batch, 13, dtype=torch.float64)
    state[:, 2], state[:, 3:6], state[:, 6] = height, torch.tensor(velocity), 1.0
    return state


def rates_of_change(effects, system, state, command=None, time=0.0):
    """What a vehicle's velocity and rates (B, 6) change by in a second, in world and in body axes."""
    world = World(system, effects).requires_grad_(False)
    at = replace(world.start(state), time=torch.full((len(state),), time, dtype=state.dtype))
    command = torch.zeros(len(state), 4, dtype=state.dtype) if command is None else command
    change = world.system_at(at).derivative(state, command, world.load(at))
    return torch.cat((change[:, 3:6], change[:, 10:]), 1)


def pull(effects, system, state, command=None, time=0.0):
    """What effects add to `rates_of_change` (B, 6)."""
    return rates_of_change(effects, system, state, command, time) - rates_of_change([], system, state, command)


def thrust_command(force, system):
    """The command (1, 4) that asks for a force of so many newtons."""
    middle, half = (system.max_thrust + system.min_thrust) / 2, (system.max_thrust - system.min_thrust) / 2
    return torch.tensor([[(force / system.mass - middle) / half, 0.0, 0.0, 0.0]], dtype=torch.float64)


@pytest.mark.parametrize("vehicle", [Quadrotor(), Quadrotor(mass=2.0), FixedWing()], ids=lambda v: f"{v.name}{v.mass}")
class TestForcesOnBoth:
    def test_linear_drag_is_the_papers_with_coefficient_r_times_mass(self, vehicle):
        state = flying()
        added = pull([LinearDrag(coefficient=0.3 * vehicle.mass)], vehicle, state)
        torch.testing.assert_close(added[:, :3], -0.3 * state[:, 3:6], rtol=1e-6, atol=1e-7)
        assert added[:, 3:].abs().max() < 1e-12

    def test_two_cos_t_pushes_along_the_worlds_x(self, vehicle):
        force = PeriodicForce(amplitude=2.0, frequency=1 / (2 * math.pi), phase=0.0, offset=0.0)
        expected = torch.zeros(3, 6, dtype=torch.float64)
        for time in (0.0, 0.7, 3.0):
            expected[:, 0] = 2 * math.cos(time) / vehicle.mass
            torch.testing.assert_close(pull([force], vehicle, flying(), time=time), expected, rtol=1e-6, atol=1e-6)

    def test_a_constant_force_pushes_along_the_worlds_x(self, vehicle):
        added = pull([ConstantForce(force=1.5)], vehicle, flying())
        torch.testing.assert_close(added[:, 0], torch.full((3,), 1.5 / vehicle.mass, dtype=torch.float64))
        assert added[:, 1:].abs().max() < 1e-12

    def test_quadratic_drag_is_along_the_velocity_and_grows_with_its_square(self, vehicle):
        state = level(velocity=(3.0, 0.0, -4.0))
        added = pull([QuadraticDrag(coefficient=0.2)], vehicle, state)[0]
        expected = [-0.2 * 5 * 3 / vehicle.mass, 0.0, 0.2 * 5 * 4 / vehicle.mass, 0.0, 0.0, 0.0]
        assert added.tolist() == pytest.approx(expected, rel=1e-6, abs=1e-9)

    def test_all_drags_feel_the_wind_and_none_is_left_at_its_speed(self, vehicle):
        state, wind = (
            level(velocity=(4.0, 1.0, -2.0)),
            Wind(velocity_x=4.0, velocity_y=1.0, velocity_z=-2.0, coefficient=1.0),
        )
        drags = [LinearDrag(coefficient=0.5), QuadraticDrag(coefficient=0.5)]
        calm = rates_of_change([wind], vehicle, state)
        torch.testing.assert_close(rates_of_change([wind, *drags], vehicle, state), calm)

    def test_periodic_wind_is_wind_at_every_instant(self, vehicle):
        periodic = PeriodicWind(amplitude=3.0, frequency=0.4, phase=0.5, direction=0.6, coefficient=0.3)
        for time in (0.0, 1.1):
            speed = 3.0 * math.cos(2 * math.pi * 0.4 * time + 0.5)
            steady = Wind(
                velocity_x=speed * math.cos(0.6), velocity_y=speed * math.sin(0.6), velocity_z=0.0, coefficient=0.3
            )
            expected = pull([steady], vehicle, flying())
            torch.testing.assert_close(pull([periodic], vehicle, flying(), time=time), expected, rtol=1e-5, atol=1e-5)

    def test_two_winds_add(self, vehicle):
        one, two = (Wind(velocity_x=1.0, velocity_y=k, velocity_z=-k, coefficient=0.1) for k in (1.0, 2.0))
        both = Wind(velocity_x=2.0, velocity_y=3.0, velocity_z=-3.0, coefficient=0.2)
        torch.testing.assert_close(
            pull([one, two], vehicle, flying()), pull([both], vehicle, flying()), rtol=1e-5, atol=1e-5
        )

    def test_an_effect_of_a_cart_does_not_fit(self, vehicle):
        with pytest.raises(TypeError, match=f"viscous_friction acts on a cartpole, not on a {vehicle.name}"):
            pull([ViscousFriction(coefficient=1.0)], vehicle, flying())


def test_an_effect_of_a_vehicle_says_what_it_acts_on():
    with pytest.raises(TypeError, match="linear_drag acts on a quadrotor or a fixed_wing, not on a cartpole"):
        World(CartPole(), [LinearDrag(coefficient=1.0)])


class TestQuadrotor:
    @pytest.mark.parametrize(
        ("drag", "speed"),
        [(LinearDrag(coefficient=0.4), 6 / 0.4), (QuadraticDrag(coefficient=0.4), math.sqrt(6 / 0.4))],
    )
    def test_it_falls_at_its_terminal_velocity(self, drag, speed):
        """Where drag carries the 6 N that thrust leaves of the weight."""
        system = Quadrotor()
        state, command = level(velocity=(0.0, 0.0, -speed)), thrust_command(9.81 - 6.0, system)
        assert rates_of_change([drag], system, state, command)[0].tolist() == pytest.approx([0.0] * 6, abs=1e-5)
        world = World(system, [drag.requires_grad_(False)], period=0.1)
        at = world.start(level())
        for _ in range(300):
            at = world.step(at, command)
        assert float(at.state[0, 5]) == pytest.approx(-speed, rel=1e-4)

    def test_a_payload_sags_at_the_hover_thrust_and_needs_more_in_proportion_to_the_mass(self):
        system, payload = Quadrotor(mass=1.5), Payload(mass=0.3)
        hover = thrust_command(1.5 * 9.81, system)
        sag = rates_of_change([payload], system, level(), hover)[0]
        assert sag.tolist() == pytest.approx([0, 0, -9.81 * 0.3 / 1.8, 0, 0, 0], abs=1e-5)
        more = thrust_command(1.8 * 9.81, system)
        assert rates_of_change([payload], system, level(), more)[0].tolist() == pytest.approx([0] * 6, abs=1e-5)
        loaded = World(system, [payload.requires_grad_(False)]).altered(level())
        assert isinstance(loaded, Quadrotor)
        assert float(loaded.hover()) == pytest.approx(float(more[0, 0]), rel=1e-5)

    def test_a_payload_turns_as_before_and_cannot_be_told_from_less_thrust(self):
        system, state = Quadrotor(), flying()
        command = 0.5 * torch.randn(3, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        payload = rates_of_change([Payload(mass=0.25)], system, state, command)
        torch.testing.assert_close(payload, rates_of_change([ThrustGain(scale=0.8)], system, state, command))
        torch.testing.assert_close(payload[:, 3:], rates_of_change([], system, state, command)[:, 3:])

    @pytest.mark.parametrize("rotor", [1, 2, 3, 4])
    def test_a_rotor_at_half_thrust_loses_an_eighth_and_turns_about_its_own_corner(self, rotor):
        system = Quadrotor(mass=1.2)
        lost = 0.5 * 1.2 * 9.81 / 4
        # Of rotors at (x, y) that pull up, the torque about the centre is (y, -x) times the thrust; 1 and 3 turn alike.
        x, y = {1: (1, 1), 2: (1, -1), 3: (-1, -1), 4: (-1, 1)}[rotor]
        reach, turn = 0.2 / math.sqrt(2), 0.016 if rotor in (1, 3) else -0.016
        torque = [-lost * y * reach, lost * x * reach, -lost * turn]
        inertia = [1.2 * 0.2**2 / 12 * k for k in (4.5, 4.5, 7.0)]
        effect = RotorEfficiency(**{f"scale_{k}": 0.5 if k == rotor else 1.0 for k in (1, 2, 3, 4)})
        added = pull([effect], system, level(), thrust_command(1.2 * 9.81, system))[0].tolist()
        turned = [t / j for t, j in zip(torque, inertia, strict=True)]
        assert added == pytest.approx([0.0, 0.0, -lost / 1.2, *turned], rel=1e-5, abs=1e-9)

    def test_rotors_that_all_lose_the_same_lose_it_of_every_torque_too(self):
        system, state, command = Quadrotor(gravity=1e-9), level(2), torch.tensor([[0.1, 0.5, -0.3, 0.8]] * 2).double()
        weaker = rates_of_change([RotorEfficiency(**{f"scale_{k}": 0.7 for k in (1, 2, 3, 4)})], system, state, command)
        torch.testing.assert_close(weaker, 0.7 * rates_of_change([], system, state, command), rtol=1e-5, atol=1e-6)

    def test_a_centre_of_mass_ahead_drops_the_nose_and_one_on_the_left_the_left_side(self):
        system = Quadrotor()
        added = pull([CenterOfMassOffset(x=0.02, y=0.03)], system, level(), thrust_command(8.0, system))[0].tolist()
        inertia = 0.2**2 / 12 * 4.5
        # Left is +y, so that side drops by a negative roll; a positive pitch drops the nose.
        assert added == pytest.approx([0, 0, 0, -0.03 * 8.0 / inertia, 0.02 * 8.0 / inertia, 0], rel=1e-5, abs=1e-9)

    def test_a_greater_inertia_makes_the_rate_loop_slower_in_proportion(self):
        state, command = level(), torch.tensor([[0.0, 1.0, -1.0, 1.0]], dtype=torch.float64)
        system = Quadrotor()
        turned = rates_of_change([Inertia(scale_x=2.0, scale_y=4.0, scale_z=0.5)], system, state, command)[0, 3:]
        assert turned.tolist() == pytest.approx([0.5 * 16.6 / 2, -0.5 * 16.6 / 4, 0.5 * 5.0 / 0.5], rel=1e-6)

    def test_a_gyroscopic_torque_is_that_of_the_true_inertia_less_what_the_loop_undoes(self):
        state = level()
        state[:, 10:] = torch.tensor([1.0, 2.0, 3.0])
        known = 0.2**2 / 12 * torch.tensor([4.5, 4.5, 7.0], dtype=torch.float64)
        true = known * torch.tensor([2.0, 1.0, 1.0])
        rates = state[0, 10:]
        torque = -known * torch.tensor([16.6, 16.6, 5.0]) * rates + torch.linalg.cross(rates, (known - true) * rates)
        turned = rates_of_change([Inertia(scale_x=2.0, scale_y=1.0, scale_z=1.0)], Quadrotor(), state)[0, 3:]
        torch.testing.assert_close(turned, torque / true, rtol=1e-6, atol=1e-6)

    def test_a_battery_sags_exponentially_also_between_commands(self):
        system, rate = Quadrotor(gravity=1e-9), 0.2
        world = World(system, [BatterySag(rate=rate).requires_grad_(False)], period=0.5)
        at = world.start(level())
        for _ in range(6):
            at = world.step(at, thrust_command(5.0, system))
        # The integral of 5 exp(-rate t) over 3 s.
        assert float(at.state[0, 5]) == pytest.approx(5.0 * (1 - math.exp(-rate * 3.0)) / rate, rel=1e-6)

    @pytest.mark.parametrize("height", [1.0, 1.5, 3.0, 20.0])
    def test_the_ground_lifts_by_cheeseman_and_bennetts_ratio(self, height):
        system, radius = Quadrotor(), 0.5
        effect = GroundEffect(radius=radius, ground=-1.0)
        added = pull([effect], system, level(height=height - 1.0), thrust_command(6.0, system))[0]
        ratio = 1 / (1 - (radius / (4 * height)) ** 2)
        assert float(added[2]) == pytest.approx(6.0 * (ratio - 1), rel=1e-3)
        assert added[3:].abs().max() < 1e-9

    def test_the_ground_lifts_ever_more_on_the_way_down_and_by_a_third_at_most(self):
        heights = torch.linspace(-1.0, 2.0, 301, dtype=torch.float64)
        state = level(len(heights))
        state[:, 2] = heights.requires_grad_()
        command = thrust_command(6.0, Quadrotor()).expand(len(heights), -1)
        lift = pull([GroundEffect(radius=0.4, ground=0.0)], Quadrotor(), state, command)[:, 2]
        assert (lift.diff() <= 1e-12).all()
        assert float(lift[0].detach()) == pytest.approx(2.0, rel=1e-5)
        assert torch.autograd.grad(lift.sum(), heights)[0].isfinite().all()

    def test_thrust_gain_multiplies_the_thrust_and_no_torque(self):
        system, state, command = Quadrotor(gravity=1e-9), level(), torch.tensor([[0.2, 0.5, -0.5, 1.0]]).double()
        factors = torch.tensor([1.3] * 3 + [1.0] * 3, dtype=torch.float64)
        gained = rates_of_change([ThrustGain(scale=1.3)], system, state, command)
        torch.testing.assert_close(gained, factors * rates_of_change([], system, state, command), rtol=1e-6, atol=1e-6)


class TestFixedWing:
    def test_wind_from_ahead_acts_as_that_much_more_airspeed_does(self):
        wing, state = FixedWing(), level(velocity=(9.0, 0.0, 0.0))
        wind = Wind(velocity_x=-3.0, velocity_y=0.0, velocity_z=0.0, coefficient=0.0)
        torch.testing.assert_close(
            rates_of_change([wind], wing, state), rates_of_change([], wing, level(velocity=(12.0, 0.0, 0.0)))
        )
        assert pull([wind], wing, state)[0, 2] > 1

    def test_in_steady_wind_it_flies_as_in_calm_air_but_is_carried_along(self):
        wing = FixedWing()
        carried = torch.tensor([2.0, -1.0, 0.5], dtype=torch.float64)
        state, command = wing.trim(torch.tensor([11.5], dtype=torch.float64))
        command = command + 0.1
        blown = state.clone()
        blown[:, 3:6] += carried
        wind = Wind(velocity_x=2.0, velocity_y=-1.0, velocity_z=0.5, coefficient=0.0)
        worlds = World(wing, [wind], 0.05), World(wing, (), 0.05)
        at, calm = (world.start(s) for world, s in zip(worlds, (blown, state), strict=True))
        for _ in range(20):
            at, calm = (world.step(a, command) for world, a in zip(worlds, (at, calm), strict=True))
        expected = calm.state.clone()
        expected[:, :3] += carried
        expected[:, 3:6] += carried
        torch.testing.assert_close(at.state, expected)

    def test_thrust_gain_adds_to_the_thrust_alone(self):
        wing, state = FixedWing(), level(velocity=(11.0, 0.0, 0.0))
        added = pull([ThrustGain(scale=1.5)], wing, state, torch.full((1, 4), 0.2, dtype=torch.float64))[0]
        assert added.tolist() == pytest.approx([0.5 * 7.0 * 0.6 / wing.mass, 0, 0, 0, 0, 0], rel=1e-6, abs=1e-9)

    def test_lift_slope_and_drag_are_those_of_the_coefficients(self):
        """Level, sinking at an angle of attack of 0.1, where lift and drag are turned by it."""
        wing, speed, attack = FixedWing(), 11.0, 0.1
        state = level(velocity=(speed * math.cos(attack), 0.0, -speed * math.sin(attack)))
        pressure = 0.5 * 1.225 * speed**2 * 0.276 / wing.mass
        lift, drag = pressure * 0.5 * 4.5321 * attack, pressure * 2.0 * 0.0765
        assert pull([LiftSlope(scale=1.5)], wing, state)[0].tolist() == pytest.approx(
            [lift * math.sin(attack), 0, lift * math.cos(attack), 0, 0, 0], rel=1e-5, abs=1e-9
        )
        assert pull([Drag(scale=3.0)], wing, state)[0].tolist() == pytest.approx(
            [-drag * math.cos(attack), 0, drag * math.sin(attack), 0, 0, 0], rel=1e-5, abs=1e-9
        )

    def test_a_heavier_wing_accelerates_less_and_weighs_as_much_more(self):
        wing, state = FixedWing(), flying()
        weight = torch.tensor([0.0, 0.0, -9.81, 0.0, 0.0, 0.0], dtype=torch.float64)
        factors = torch.tensor([0.5] * 3 + [1.0] * 3, dtype=torch.float64)
        light = rates_of_change([], wing, state) - weight
        torch.testing.assert_close(rates_of_change([Mass(scale=2.0)], wing, state), weight + factors * light)

    def test_an_effectiveness_is_a_gain_and_a_trim_an_offset_on_the_angles_of_the_surfaces(self):
        wing, state = FixedWing(side_aileron=0.1), level(velocity=(11.0, 0.5, -0.3))
        asked = torch.tensor([[0.2, 0.3, -0.4, 0.5]], dtype=torch.float64)
        gains, offsets = torch.tensor([1.0, 0.5, 1.5, 0.2]).double(), torch.tensor([0.0, 0.05, -0.02, 0.1]).double()
        most = torch.tensor([1.0, wing.max_elevator, wing.max_aileron, wing.max_rudder], dtype=torch.float64)
        effects = [
            TrimOffset(elevator=0.05, aileron=-0.02, rudder=0.1),
            ControlEffectiveness(scale_elevator=0.5, scale_aileron=1.5, scale_rudder=0.2),
        ]
        expected = rates_of_change([], wing, state, gains * asked + offsets / most)
        for order in (effects, effects[::-1]):
            torch.testing.assert_close(rates_of_change(order, wing, state, asked), expected, rtol=1e-5, atol=1e-5)
