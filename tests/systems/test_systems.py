import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from tests.worlds import energy_of
from visadapt.systems import SYSTEMS, CartPole, FixedWing, Quadrotor, System
from visadapt.systems.integrators import rk4
from visadapt.world import World

HEAVY = CartPole(cart_mass=0.7, pole_mass=0.4, pole_half_length=0.3, max_force=12.0, gravity=9.81)


def mass_matrix_solution(system, state, command, force, torque, times):
    """States at `times` from the Lagrange equations M(q) q'' = Q, solved apart from the code under test.

    The pole is uniform, of half-length l, so its moment of inertia about its centre is m l^2 / 3; its centre
    is at (x + l sin theta, l cos theta).
    """
    m, l, g = system.pole_mass, system.pole_half_length, system.gravity  # noqa: E741

    def derivative(_, y):
        _, v, angle, w = y
        s, c = np.sin(angle), np.cos(angle)
        inertia = [[system.cart_mass + m, m * l * c], [m * l * c, m * l**2 / 3 + m * l**2]]
        forces = [system.max_force * command + force + m * l * w**2 * s, m * g * l * s + torque]
        a, alpha = np.linalg.solve(inertia, forces)
        return [v, a, w, alpha]

    return solve_ivp(derivative, (0, times[-1]), state, "DOP853", times, rtol=1e-11, atol=1e-12).y.T


def derivative_of(system, state, command=0.0, load=(0.0, 0.0)):
    as_row = [torch.as_tensor(values, dtype=torch.float64)[None] for values in (state, [command], load)]
    return system.derivative(*as_row)[0]


@pytest.mark.parametrize("system", [CartPole(), HEAVY])
def test_energy_is_conserved_without_command_and_load(system):
    world = World(system, period=0.05, integrator="rk4", substeps=60)
    state = torch.tensor([[0.1, -0.3, 0.2, 0.4], [0.0, 1.0, 2.5, -6.0]], dtype=torch.float64)
    at = world.start(state)
    for _ in range(40):
        at = world.step(at, torch.zeros(2, 1, dtype=torch.float64))
    assert (at.state - state).abs().max() > 1
    torch.testing.assert_close(energy_of(system, at.state), energy_of(system, state), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("system", [CartPole(), HEAVY])
@pytest.mark.parametrize(
    ("command", "force", "torque"), [(0.0, 0.0, 0.0), (0.4, 0.0, 0.0), (0.0, -3.0, 0.0), (-0.2, 1.5, 0.3)]
)
def test_motion_agrees_with_the_lagrange_equations_solved_apart(system, command, force, torque):
    start = [0.1, -0.5, 0.3, 1.0]
    times = np.linspace(0, 1, 11)
    expected = mass_matrix_solution(system, start, command, force, torque, times)
    assert np.abs(expected[-1] - start).max() > 0.5

    u, load = torch.tensor([[command]], dtype=torch.float64), torch.tensor([[force, torque]], dtype=torch.float64)
    time, state = torch.zeros(1, dtype=torch.float64), torch.tensor([start], dtype=torch.float64)
    for row in expected[1:]:
        for _ in range(50):
            state = rk4(lambda _, s: system.derivative(s, u, load), time, state, 0.002)
        np.testing.assert_allclose(state[0], row, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("system", [CartPole(), HEAVY])
def test_a_hanging_pole_swings_at_the_small_angle_frequency(system):
    # Linearised at theta = pi with the cart free: w^2 = g / (l (4/3 - m / (M + m))).
    share = system.pole_mass / (system.cart_mass + system.pole_mass)
    frequency = math.sqrt(system.gravity / (system.pole_half_length * (4 / 3 - share)))
    turn = 2 * math.pi / frequency
    world = World(system, period=turn / 4, substeps=200)
    swing = 1e-4
    at = world.start(torch.tensor([[0.0, 0.0, math.pi + swing, 0.0]], dtype=torch.float64))
    seen = []
    for _ in range(4):
        at = world.step(at, torch.zeros(1, 1, dtype=torch.float64))
        seen.append(float(at.state[0, 2]) - math.pi)
    assert seen == pytest.approx([0.0, -swing, 0.0, swing], abs=swing * 1e-5)


def test_positive_command_and_force_push_towards_positive_x_and_the_pole_lags():
    for acting in (derivative_of(CartPole(), [0.0] * 4, 0.5), derivative_of(CartPole(), [0.0] * 4, 0.0, (15.0, 0.0))):
        # By hand: a = F / (M + m - 3/4 m), alpha = -3/4 a / l at the upright.
        acceleration = 15.0 / (1.1 - 0.075)
        assert acting.tolist() == pytest.approx([0.0, acceleration, 0.0, -0.75 * acceleration / 0.5])


def test_a_pole_that_leans_falls_further_and_a_positive_torque_turns_it_towards_positive_angles():
    assert derivative_of(CartPole(), [0.0, 0.0, 0.1, 0.0])[3] > 0
    assert derivative_of(CartPole(), [0.0, 0.0, -0.1, 0.0])[3] < 0
    assert derivative_of(CartPole(), [0.0] * 4, 0.0, (0.0, 0.2))[3] > 0


def test_the_equations_are_mirror_symmetric_and_do_not_know_where_the_cart_is():
    state, load = [0.4, 1.0, 0.3, -2.0], (2.0, 0.1)
    mirrored = derivative_of(HEAVY, [-v for v in state], -0.3, (-2.0, -0.1))
    torch.testing.assert_close(mirrored, -derivative_of(HEAVY, state, 0.3, load))
    torch.testing.assert_close(
        derivative_of(HEAVY, [9.0, *state[1:]], 0.3, load), derivative_of(HEAVY, state, 0.3, load)
    )


@pytest.mark.parametrize("system", [CartPole(), HEAVY])
def test_gradients_agree_with_finite_differences(system):
    generator = torch.Generator().manual_seed(0)
    inputs = [torch.randn(3, n, generator=generator, dtype=torch.float64) for n in (4, 1, 2)]
    assert torch.autograd.gradcheck(system.derivative, [value.requires_grad_() for value in inputs])


def test_the_motors_load_moves_the_system_as_the_command_does():
    generator = torch.Generator().manual_seed(0)
    system = CartPole(max_force=torch.tensor([5.0, 30.0, 12.0], dtype=torch.float64))
    state, command, none = (torch.randn(3, n, generator=generator, dtype=torch.float64) for n in (4, 1, 2))
    none *= 0
    load = system.motor_loads(state, command)
    torch.testing.assert_close(system.derivative(state, 0 * command, load), system.derivative(state, command, none))
    torch.testing.assert_close(load, System.motor_loads(system, state, command))


@pytest.mark.parametrize("name", ["cart_mass", "pole_mass", "pole_half_length", "max_force", "gravity"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan")])
def test_an_impossible_parameter_is_named_with_its_value(name, value):
    with pytest.raises(ValueError, match=f"{name} must be positive, got {value}"):
        CartPole(**{name: value})


@pytest.mark.parametrize(("kind", "name"), [(CartPole, "cart_mass"), (FixedWing, "lift_zero"), (Quadrotor, "payload")])
def test_an_infinite_parameter_is_named(kind, name):
    with pytest.raises(ValueError, match=f"{kind.name}: {name} must be finite, got inf"):
        kind(**{name: math.inf})


@pytest.mark.parametrize("name", ["cart_mass", "pole_mass", "pole_half_length", "max_force", "gravity"])
def test_a_parameter_may_be_one_for_each_row(name):
    values = torch.tensor([0.5, 2.0], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    arguments = [torch.randn(2, n, generator=generator, dtype=torch.float64) for n in (4, 1, 2)]
    together = CartPole(**{name: values})
    for row, value in enumerate(values.tolist()):
        alone = CartPole(**{name: value})
        own = [argument[row : row + 1] for argument in arguments]
        torch.testing.assert_close(together.derivative(*arguments)[row], alone.derivative(*own)[0])
        torch.testing.assert_close(energy_of(together, arguments[0])[row], energy_of(alone, own[0])[0])
    assert getattr(together.to(torch.zeros(1)), name).dtype == torch.float32
    with pytest.raises(ValueError, match=f"{name} must be positive"):
        CartPole(**{name: torch.tensor([1.0, 0.0])})


@pytest.mark.parametrize("system", SYSTEMS.values())
def test_every_system_says_what_its_variables_are(system):
    for variable in (*system.states, *system.actions, *system.loads):
        assert variable.name
        assert variable.unit
        assert variable.low < variable.high
    assert [system.index(variable.name) for variable in system.states] == list(range(len(system.states)))
    first, second = (variable.name for variable in system.states[:2])
    with pytest.raises(KeyError, match=f"{system.name} has no state 'speed'; its states are {first}, {second}"):
        system.index("speed")
