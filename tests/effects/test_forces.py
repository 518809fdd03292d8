import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from scipy.integrate import solve_ivp

from tests.effects.test_effects import build, from_table, inputs, world_of
from tests.worlds import Mass, columns, energy_of, run
from visadapt.effects import (
    CartMass,
    ConstantForce,
    CoulombFriction,
    Effect,
    FrictionPatch,
    Gust,
    PeriodicForce,
    PoleDamping,
    PoleLength,
    PoleMass,
    QuadraticDrag,
    Spring,
    StribeckFriction,
    TrackTilt,
    ViscousFriction,
)
from visadapt.systems import CartPole
from visadapt.world import World

PERIOD = 0.05


def coast(effect, start, steps, substeps=4, command=0.0):
    """States (steps + 1, 4) of a mass of 2 kg."""
    world = World(Mass(), [effect.double()], PERIOD, "rk4", substeps).requires_grad_(False)
    return run(world, columns(*start), [columns(command)] * steps)[:, 0]


class TestForces:
    def test_a_positive_constant_force_pushes_towards_positive_x(self):
        state = columns(0, 0, 0, 0)
        end = run(world_of(ConstantForce(force=3.0).double(), system=Mass()), state, [columns(0.0)] * 4)[-1, 0]
        assert end[:2].tolist() == pytest.approx([0.5 * 1.5 * 0.2**2, 1.5 * 0.2])

    def test_a_constant_force_is_like_a_constant_command(self):
        state, actions = inputs(3)
        pushed = run(world_of(ConstantForce(force=3.0)), state, actions)
        torch.testing.assert_close(pushed, run(world_of(), state, actions + 3.0 / 30.0))

    def test_viscous_friction_lets_a_speed_die_away_exponentially(self):
        world = World(Mass(), [ViscousFriction(coefficient=5.0).double()], PERIOD, "rk4", 20)
        for start in (0.8, -0.8):
            seen = run(world, columns(0, start, 0, 0), [columns(0.0)] * 8)[:, 0, 1].tolist()
            expected = [start * math.exp(-5.0 / 2.0 * k * PERIOD) for k in range(9)]
            assert seen == pytest.approx(expected, rel=1e-7)

    @given(data=st.data())
    @settings(max_examples=20)
    def test_a_periodic_force_is_its_formula_and_acts_on_the_cart_alone(self, data):
        v = data.draw(from_table("periodic_force"))
        time = torch.linspace(0, 3, 7, dtype=torch.float64)
        effect = build("periodic_force", v)
        v = {key: float(value) for key, value in effect.state_dict().items()}
        load = effect.load(time, torch.zeros(7, 4, dtype=torch.float64), CartPole()).detach()
        for t, (force, torque) in zip(time.tolist(), load.tolist(), strict=True):
            expected = v["amplitude"] * math.cos(2 * math.pi * v["frequency"] * t + v["phase"]) + v["offset"]
            assert force == pytest.approx(expected, rel=1e-9, abs=1e-9)
            assert torque == 0.0

    def test_the_phase_of_a_periodic_force_counts_from_the_start_of_the_episode(self):
        # The impulse of 2 (sin t + 1) N over T is 2 (1 - cos T + T).
        effect = PeriodicForce(amplitude=2.0, frequency=1 / (2 * math.pi), phase=-math.pi / 2, offset=2.0)
        seen = run(World(Mass(), [effect], PERIOD, "rk4", 5), columns(0, 0, 0, 0), [columns(0.0)] * 60)[
            :, 0, 1
        ].tolist()
        for k in (1, 20, 60):
            elapsed = k * PERIOD
            assert seen[k] == pytest.approx((1 - math.cos(elapsed) + elapsed), abs=1e-6)


class TestGust:
    @pytest.mark.parametrize("start", [0.2, 0.2047, 0.2081, 0.2125])
    def test_it_is_a_push_from_start_to_end_whatever_the_steps_of_the_integrator(self, start):
        states = coast(Gust(start=start, end=start + 0.13, force=4.0), (0, 0, 0, 0), 12)
        assert states[4, 1] == pytest.approx(0.0, abs=1e-2)
        assert float(states[-1, 1]) == pytest.approx(2.0 * 0.13, abs=2e-4)
        assert float(states[-1, 0]) == pytest.approx(2.0 * 0.13 * (0.6 - start - 0.065), abs=2e-4)

    def test_one_that_ends_before_it_starts_is_none(self):
        assert not coast(Gust(start=0.3, end=0.1, force=4.0), (0, 0, 0, 0), 8).any()


class TestFrictionPatch:
    @pytest.mark.parametrize("speed", [0.8, -0.8])
    def test_crossing_it_costs_a_speed_of_coefficient_times_length_over_mass(self, speed):
        patch = FrictionPatch(start=-0.053, end=0.12, coefficient=3.0)
        states = coast(patch, (-0.4 * math.copysign(1, speed), speed, 0, 0), 24)
        assert abs(float(states[-1, 0])) > 0.2
        assert abs(float(states[-1, 1])) == pytest.approx(0.8 - 3.0 * 0.173 / 2.0, abs=2e-4)
        assert float(states[4, 1]) == pytest.approx(speed, abs=1e-6)

    def test_one_that_ends_before_it_starts_is_none(self):
        assert coast(FrictionPatch(start=0.3, end=0.1, coefficient=4.0), (0.2, 1.0, 0, 0), 8)[-1, 1] == 1.0


class TestQuadraticDrag:
    def test_a_push_ends_in_the_terminal_speed(self):
        # m v' = F - c v^2 has the solution w tanh(F t / (m w)) with w = sqrt(F / c).
        states = coast(QuadraticDrag(coefficient=5.0), (0, 0, 0, 0), 60, command=0.8)
        terminal = math.sqrt(0.8 / 5.0)
        expected = [terminal * math.tanh(0.8 * k * PERIOD / (2.0 * terminal)) for k in range(61)]
        assert states[:, 1].tolist() == pytest.approx(expected, abs=1e-6)
        assert float(states[-1, 1]) == pytest.approx(terminal, rel=0.01)

    def test_it_is_the_same_both_ways(self):
        there = coast(QuadraticDrag(coefficient=5.0), (0, 1.0, 0, 0), 5)
        torch.testing.assert_close(coast(QuadraticDrag(coefficient=5.0), (0, -1.0, 0, 0), 5), -there)


def test_a_spring_swings_about_its_rest_at_its_frequency():
    states = coast(Spring(stiffness=8.0, rest=0.25), (0.75, 0, 0, 0), 63, substeps=10)
    expected = [0.25 + 0.5 * math.cos(2.0 * k * PERIOD) for k in range(64)]
    assert states[:, 0].tolist() == pytest.approx(expected, abs=1e-6)


def test_pole_damping_takes_energy_at_the_pivot_alone():
    state = torch.tensor([[0.3, 0.5, 0.2, 1.5]], dtype=torch.float64)
    load = PoleDamping(coefficient=0.1).double().load(torch.zeros(1), state, CartPole())
    assert load[0].tolist() == pytest.approx([0.0, -0.15])
    world = World(CartPole(), [PoleDamping(coefficient=0.05).double()], 0.002)
    at, energy, work = world.start(state), [], 0.0
    for _ in range(200):
        energy.append(float(energy_of(CartPole(), at.state).detach()))
        rate = at.state[0, 3]
        at = world.step(at, torch.zeros(1, 1, dtype=torch.float64))
        work += 0.05 * float((rate.square() + at.state[0, 3].square()).detach()) / 2 * 0.002
    assert energy[0] - float(energy_of(CartPole(), at.state).detach()) == pytest.approx(work, rel=1e-4)


class TestTrackTilt:
    @pytest.mark.parametrize("angle", [0.3, -0.2, 0.01])
    def test_it_is_the_slope_of_the_potential_of_gravity(self, angle):
        system = CartPole(cart_mass=0.7, pole_mass=0.4, pole_half_length=0.3, gravity=9.81)

        def potential(x, theta, tilt):
            # The cart is x sin(tilt) up, the pole's centre l cos(theta - tilt) above it.
            height = system.pole_half_length * torch.cos(theta - tilt)
            return 9.81 * (1.1 * x * math.sin(tilt) + 0.4 * height)

        state = torch.tensor([[0.3, 0.5, 0.2, 1.5], [0.0, 0.0, -1.1, 0.0]], dtype=torch.float64)
        x, theta = (state[:, k].clone().requires_grad_() for k in (0, 2))
        difference = (potential(x, theta, 0.0) - potential(x, theta, angle)).sum()
        expected = torch.stack(torch.autograd.grad(difference, (x, theta)), 1)
        tilt = TrackTilt(angle=angle).double()
        torch.testing.assert_close(tilt.load(torch.zeros(2), state, system).detach(), expected, rtol=1e-6, atol=1e-7)

    def test_a_cart_held_against_it_balances_a_pole_that_is_vertical(self):
        hold = 1.1 * 9.8 * math.sin(0.1)
        world = world_of(TrackTilt(angle=0.1).double(), ConstantForce(force=hold).double()).requires_grad_(False)
        start = columns(0.2, 0, float(world.effects[0].angle), 0)
        torch.testing.assert_close(run(world, start, [columns(0.0)] * 4)[-1], start, rtol=0, atol=1e-6)

    def test_a_track_that_rises_towards_positive_x_lets_the_cart_roll_back(self):
        world = world_of(TrackTilt(angle=0.1)).requires_grad_(False)
        assert float(run(world, columns(0, 0, 0, 0), [columns(0.0)])[-1, 0, 1]) < -0.01


@pytest.mark.parametrize(
    ("effect", "field", "value"),
    [(CartMass, "cart_mass", 2.0), (PoleMass, "pole_mass", 0.2), (PoleLength, "pole_half_length", 1.0)],
)
class TestParameters:
    def test_twice_the_parameter_is_the_system_with_it(self, effect, field, value):
        state, actions = inputs(3)
        expected = run(world_of(system=CartPole(**{field: value})), state, actions)
        torch.testing.assert_close(run(world_of(effect(scale=2.0)), state, actions), expected)

    def test_a_load_knows_of_it(self, effect, field, value):
        state, actions = inputs(3)
        tilt = TrackTilt(angle=0.2)
        expected = run(world_of(tilt, system=CartPole(**{field: value})), state, actions)
        for effects in ((tilt, effect(scale=2.0)), (effect(scale=2.0), tilt)):
            torch.testing.assert_close(run(world_of(*effects), state, actions), expected)

    def test_two_of_them_multiply(self, effect, field, value):
        state, actions = inputs(3)
        twice = run(world_of(effect(scale=0.5), effect(scale=4.0)), state, actions)
        torch.testing.assert_close(twice, run(world_of(effect(scale=2.0)), state, actions))

    def test_an_impossible_one_is_an_error(self, effect, field, value):
        state, actions = inputs(2)
        with pytest.raises(ValueError, match=rf"cartpole: {field} must be positive, got tensor"):
            run(world_of(effect(scale=torch.tensor([1.0, -1.0]))), state, actions)

    def test_another_system_is_an_error(self, effect, field, value):
        with pytest.raises(TypeError, match=rf"{effect.name} acts on a cartpole, not on a mass"):
            run(World(Mass(), [effect(scale=2.0)]), *inputs(2))


def stick_slip(y, push, friction):
    """The state a period on of a cart-pole with exact dry friction, and whether it stuck at some time.

    `friction` is the largest one by the cart's speed. Phases of slip and stick are joined at their events.
    """
    cart, pole, l, g = 1.0, 0.1, 0.5, 9.8  # noqa: E741
    tolerance = {"rtol": 1e-8, "atol": 1e-10, "max_step": 0.02}

    def fall(angle):
        """The pole's angular acceleration on a cart that does not move."""
        return g * math.sin(angle) / (4 / 3 * l)

    def needed(y):
        """The friction that keeps the cart where it is."""
        return pole * l * (fall(y[2]) * math.cos(y[2]) - y[3] ** 2 * math.sin(y[2])) - push

    def stick(_, y):
        return [0.0, 0.0, y[3], fall(y[2])]

    def breaks(_, y):
        return abs(needed(y)) - friction(0.0)

    def slip(_, y):
        s, c = math.sin(y[2]), math.cos(y[2])
        inertia = [[cart + pole, pole * l * c], [pole * l * c, 4 / 3 * pole * l**2]]
        forces = [push - way * friction(y[1]) + pole * l * y[3] ** 2 * s, pole * g * l * s]
        a, alpha = np.linalg.solve(inertia, forces)
        return [y[1], a, y[3], alpha]

    def stops(_, y):
        return way * y[1]

    # solve_ivp reads these of its events.
    vars(breaks).update(terminal=True)
    vars(stops).update(terminal=True, direction=-1)
    t, y, stuck = 0.0, np.array(y, float), False
    while t < PERIOD:
        if y[1] == 0 and abs(needed(y)) < friction(0.0):
            stuck = True
            out = solve_ivp(stick, (t, PERIOD), y, events=breaks, **tolerance)
            t, y = out.t[-1], out.y[:, -1]
            if t == PERIOD:
                break
        way = float(np.sign(y[1] or -needed(y)))
        y[1] = y[1] or 1e-9 * way
        out = solve_ivp(slip, (t, PERIOD), y, events=stops, **tolerance)
        t, y = out.t[-1], out.y[:, -1]
        if len(out.t_events[0]):
            y[1] = 0.0
    return y, stuck


STRIBECK = [(0.5, 1.5, 0.05), (1.0, 1.3, 0.2), (0.263, 2.63, 0.1)]


def stribeck(force, breakaway, velocity):
    return lambda speed: force + (breakaway - force) * math.exp(-((speed / velocity) ** 2))


class TestDryFriction:
    @pytest.mark.parametrize(
        ("effect", "friction"),
        [
            *((CoulombFriction(force=force), stribeck(force, force, 1.0)) for force in (0.5, 2.0, 6.0)),
            *((StribeckFriction(force=f, breakaway=b, velocity=v), stribeck(f, b, v)) for f, b, v in STRIBECK),
        ],
        ids=lambda value: value.name if isinstance(value, Effect) else "",
    )
    def test_half_a_second_ahead_it_is_exact_stick_and_slip(self, effect, friction):
        generator, ahead = np.random.default_rng(0), 10
        states, actions, stuck, excitation = [np.array([0.1, 0.0, 0.03, 0.0])], [], 0, 0.0
        for k in range(120):
            excitation = 0.04 * generator.normal() if k % 4 == 0 else excitation
            actions.append(float(np.clip(states[-1] @ [0.05, 0.12, 1.6, 0.35] + excitation, -1, 1)))
            state, sticks = stick_slip(states[-1], 30.0 * actions[-1], friction)
            states.append(state)
            stuck += sticks
        assert stuck > 5

        true, count = torch.tensor(np.array(states)), 120 - ahead
        plan = torch.tensor(actions, dtype=torch.float64).unfold(0, ahead, 1)[:count].T[..., None]

        world = World(CartPole(), [effect.double()], PERIOD, "rk4", 4).requires_grad_(False)
        reached = run(world, true[:count], plan)[-1]
        error = (reached - true[ahead : ahead + count])[:, 0].square().mean().sqrt()
        assert error < 2e-4  # m: a fifth of the noise of good sensors


class TestCoulombFriction:
    def test_it_is_the_textbook_force_on_a_cart_that_moves(self):
        state = torch.zeros(4, 4, dtype=torch.float64)
        state[:, 1] = torch.tensor([0.05, -0.06, 0.0, 5.0])
        world = World(CartPole(), [CoulombFriction(force=6.0).double()])
        load = world.load(world.start(state))
        assert load[:, 0].tolist() == [-6.0, 6.0, 0.0, -6.0]
        assert not load[:, 1].any()

    def test_a_cart_comes_to_rest_and_sticks_while_the_pole_pulls_at_it(self):
        world = World(CartPole(), [CoulombFriction(force=torch.tensor([1.0, 6.0]))], PERIOD, "rk4", 4)
        # The pole, hanging, swings and pulls at the cart: less than 1 N.
        start = torch.tensor([[0.0, 0.3, math.pi, 0.0]]).repeat(2, 1)
        seen = run(world.requires_grad_(False), start, [columns(0.0)] * 12)
        assert not bool(seen[-4:, :, 1].any())
        torch.testing.assert_close(seen[-4:, :, 0], seen[-1:, :, 0].expand(4, -1), rtol=0, atol=1e-6)
        assert bool((seen[..., 1] >= 0).all())

    @pytest.mark.parametrize("speed", [0.02, -0.02, 0.3, 0.0])
    def test_gradients_agree_with_finite_differences_in_sliding_stopping_and_sticking(self, speed):
        world = World(CartPole(), [CoulombFriction(force=2.0).double()], PERIOD, "rk4", 4)
        state = torch.tensor([[0.1, speed, 0.02, 0.1]], dtype=torch.float64)

        def after(force, velocity):
            moved = state.clone()
            moved[:, 1] = velocity
            return world.with_values(force).step(world.start(moved), columns(0.12).double()).state

        force, velocity = torch.tensor([2.0]).double(), torch.tensor(speed).double()
        assert torch.autograd.gradcheck(
            after, (force.requires_grad_(), velocity.requires_grad_(speed != 0)), eps=1e-7, atol=1e-5
        )
