import math
from dataclasses import fields, replace

import pytest
import torch

from tests.wings import LOPSIDED, double, state_of
from visadapt.systems import FixedWing
from visadapt.world import World

NAMES = [field.name for field in fields(FixedWing)]


@pytest.mark.parametrize("wing", [FixedWing(), LOPSIDED, FixedWing(mass=double([0.9, 1.01, 1.2]))])
def test_trimmed_flight_stays_level_for_ten_seconds(wing):
    speeds = double([9.5, 11.5, 15.0])
    state, command = wing.trim(speeds)
    assert command.abs().max() <= 1
    world = World(wing, period=0.05, integrator="rk4")
    at = world.start(state)
    for _ in range(200):
        at = world.step(at, command)
    torch.testing.assert_close(at.state[:, 0], 10 * speeds)
    torch.testing.assert_close(at.state[:, 1:], state[:, 1:], rtol=0, atol=1e-6)


def test_in_wind_the_airspeed_is_what_was_asked_for():
    wing, still = FixedWing(wind_x=3.0, wind_y=-2.0), FixedWing()
    (state, command), (calm, held) = (each.trim(torch.tensor([12])) for each in (wing, still))
    torch.testing.assert_close(state - calm, torch.tensor([[0.0, 0, 0, 3, -2, 0, 0, 0, 0, 0, 0, 0, 0]]))
    torch.testing.assert_close(command, held)
    at = World(wing, period=0.05).step(World(wing, period=0.05).start(state), command)
    torch.testing.assert_close(at.state[:, 3:], state[:, 3:], rtol=0, atol=1e-5)


def test_trim_at_the_start_speed_of_the_paper():
    state, command = FixedWing().trim(torch.tensor([11.5]))
    assert state.dtype == command.dtype == torch.float32
    # By hand, without what thrust carries of the weight: C_m = 0 and lift = weight give 0.58 deg and 0.76 deg.
    attack = 2 * math.asin(-float(state[0, 8]))
    assert math.degrees(attack) == pytest.approx(0.58, abs=0.03)
    assert 20 * float(command[0, 1]) == pytest.approx(0.76, abs=0.1)
    drag = 0.5 * 1.225 * 11.5**2 * 0.276 * (0.0765 + 0.3346 * attack + 0.004 * math.radians(0.8))
    assert 3.5 * (float(command[0, 0]) + 1) == pytest.approx(drag / math.cos(attack), rel=1e-3)


@pytest.mark.parametrize("speed", [0.0, 3.0, 8.0, 40.0, float("nan")])
def test_a_speed_that_cannot_be_flown_level_is_named(speed):
    with pytest.raises(ValueError, match=f"no level flight within the commands at {speed:g} m/s"):
        FixedWing().trim(torch.tensor([11.5, speed]))


@pytest.mark.parametrize("elevator", [-0.5, 0.0, 0.4])
def test_without_thrust_it_glides_at_drag_over_lift(elevator):
    wing = FixedWing()
    deflection = elevator * wing.max_elevator
    attack = -(wing.pitch_zero + wing.pitch_elevator * deflection) / wing.pitch_attack
    lift = wing.lift_zero + wing.lift_attack * attack + wing.lift_elevator * deflection
    drag = wing.drag_zero + wing.drag_attack * attack + wing.drag_elevator * deflection
    weight = wing.mass * wing.gravity
    speed = math.sqrt(2 * weight / (wing.air_density * wing.wing_area * math.hypot(lift, drag)))
    descent = math.atan2(drag, lift)
    state = state_of((speed * math.cos(descent), 0.0, -speed * math.sin(descent)), (0.0, descent - attack, 0.0))
    change = wing.derivative(state, double([[-1.0, elevator, 0.0, 0.0]]), torch.zeros(1, 6, dtype=torch.float64))
    torch.testing.assert_close(change[0, 3:], torch.zeros(10, dtype=torch.float64), rtol=0, atol=1e-12)


def test_each_command_acts_as_the_docstring_says():
    wing = FixedWing()
    state, trimmed = wing.trim(double([11.5]))
    more = trimmed + 0.1 * torch.eye(4, dtype=torch.float64)
    changes = wing.derivative(state.expand(4, -1), more, torch.zeros(4, 6, dtype=torch.float64))
    thrust, elevator, aileron, rudder = changes
    assert float(thrust[3]) == pytest.approx(0.05 * 7.0 / 1.01, rel=1e-3)
    assert elevator[11] > 0, "nose down"
    assert aileron[10] < 0, "left wing down"
    assert rudder[12] > 0, "nose to the left"
    at = World(wing, period=0.05).start(state)
    for _ in range(40):
        at = World(wing, period=0.05).step(at, trimmed + double([[0.0, 0.0, 0.1, 0.0]]))
    assert at.state[0, 1] > 0.1, "a bank to the left turns to the left"


def random_states(n):
    generator = torch.Generator().manual_seed(0)
    state = torch.randn(n, 13, generator=generator, dtype=torch.float64)
    state[:, 3:6] *= 6
    return state, torch.rand(n, 4, generator=generator, dtype=torch.float64) * 2 - 1


def test_left_and_right_are_mirror_images():
    def mirrored(values):
        return values * double([1, -1, 1, 1, -1, 1, 1, -1, 1, -1, -1, 1, -1])

    wing = FixedWing()
    state, command = random_states(32)
    load = torch.randn(32, 6, dtype=torch.float64)
    change = wing.derivative(state, command, load)
    other = wing.derivative(mirrored(state), command * double([1, 1, -1, -1]), load * double([1, -1, 1, -1, 1, -1]))
    torch.testing.assert_close(other, mirrored(change))


def test_air_takes_power_out_in_every_direction_of_flight():
    wing = FixedWing()
    state, _ = random_states(500)
    velocity, still = state[:, 3:6], torch.zeros(500, 3, dtype=torch.float64)
    coasting = double([[-1.0, 0.0, 0.0, 0.0]]).expand(500, 4)
    force, _ = wing.wrench(velocity, still, coasting)
    assert ((force * velocity).sum(1) < 0).all()


def test_energy_falls_in_a_glide():
    wing = FixedWing()
    generator = torch.Generator().manual_seed(1)
    angles = torch.rand(32, 3, generator=generator, dtype=torch.float64) - 0.5
    state = torch.cat([state_of((12.0, 0.0, 0.0), row) for row in angles])
    inertia = wing.inertia(state)

    def energy(state):
        velocity, rates = state[:, 3:6], state[:, 10:]
        kinetic = wing.mass * velocity.square().sum(1) + (rates * (rates @ inertia)).sum(1)
        return kinetic / 2 + wing.mass * wing.gravity * state[:, 2]

    world = World(wing, period=0.05)
    at = world.start(state)
    for _ in range(60):
        before = energy(at.state)
        at = world.step(at, double([[-1.0, 0.0, 0.0, 0.0]]).expand(32, 4))
        assert (energy(at.state) < before).all()


def test_flight_stays_bounded_whatever_the_commands():
    wing = FixedWing()
    world = World(wing, period=0.05, substeps=4)
    generator = torch.Generator().manual_seed(0)
    state, _ = wing.trim(torch.full((64,), 11.5))
    at = world.start(state)
    for _ in range(5):
        command = torch.rand(64, 4, generator=generator) * 2 - 1
        for _ in range(20):
            at = world.step(at, command)
    assert at.state[:, 3:6].norm(dim=1).max() < 100
    assert at.state[:, 10:].abs().max() < 30


@pytest.mark.parametrize("wing", [FixedWing(), LOPSIDED])
def test_gradients_agree_with_finite_differences(wing):
    state, command = random_states(4)
    inputs = (state, command, torch.randn(4, 6, dtype=torch.float64))
    assert torch.autograd.gradcheck(wing.derivative, [value.requires_grad_() for value in inputs])


def test_gradients_in_all_parameters_agree_with_finite_differences():
    state, command = random_states(2)
    state[0] = state_of((11.0, 0.5, -0.3), (0.1, 0.0, 0.0), (0.1, 0.2, -0.1))[0]
    values = double([getattr(LOPSIDED, name) for name in NAMES]).requires_grad_()

    def derivative(values):
        wing = FixedWing(**dict(zip(NAMES, values.unbind(), strict=True)))
        return wing.derivative(state, command, torch.zeros(2, 6, dtype=torch.float64))

    assert torch.autograd.gradcheck(derivative, values)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_values_and_gradients_are_finite_at_rest_and_in_flight_along_each_axis(dtype):
    speeds = (0.0, 1e-30, 1e-20, 1e-7, 10.0)
    velocities = [[sign * s * (axis == i) for i in range(3)] for s in speeds for axis in range(3) for sign in (1, -1)]
    state = torch.cat([state_of(velocity, rates=(1.0, 2.0, 3.0)) for velocity in velocities]).to(dtype)
    state = state.requires_grad_()
    command = torch.full((len(state), 4), 0.5, dtype=dtype, requires_grad=True)
    change = FixedWing().derivative(state, command, torch.zeros(len(state), 6, dtype=dtype))
    assert change.dtype == dtype
    assert change.isfinite().all()
    for gradient in torch.autograd.grad(change.square().sum(), (state, command)):
        assert gradient.isfinite().all()


@pytest.mark.parametrize("name", NAMES)
def test_a_parameter_may_be_one_for_each_row(name):
    default = getattr(FixedWing(), name)
    values = double([0.9 * default - 0.001, 1.1 * default + 0.001])
    state, command = random_states(2)
    state[:, 3:6] = double([[11.0, 0.5, 0.3], [9.0, 0.2, -0.9]])
    state[:, 6:10] = double([1.0, 0.02, 0.01, 0.03])
    load = torch.ones(2, 6, dtype=torch.float64)
    together = FixedWing(**{name: values})
    change = together.derivative(state, command, load)
    for row, value in enumerate(values.tolist()):
        for alone in (FixedWing(**{name: value}), FixedWing(**{name: double(value)})):
            own = (part[row : row + 1] for part in (state, command, load))
            torch.testing.assert_close(change[row], alone.derivative(*own)[0])
    if name != "linear_range":
        assert (change - FixedWing().derivative(state, command, load)).abs().amax(1).min() > 0
    assert getattr(together.to(torch.zeros(1)), name).dtype == torch.float32


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan")])
@pytest.mark.parametrize("name", ["mass", "inertia_x", "span", "chord", "air_density", "max_rudder", "linear_range"])
def test_an_impossible_parameter_is_named_with_its_value(name, value):
    with pytest.raises(ValueError, match=f"{name} must be positive, got {value}"):
        FixedWing(**{name: value})
    with pytest.raises(ValueError, match=f"{name} must be positive, got tensor"):
        replace(FixedWing(), **{name: torch.tensor([1.0, value])})


@pytest.mark.parametrize("name", ["lift_zero", "yaw_rudder", "inertia_xz"])
def test_a_coefficient_must_be_finite(name):
    with pytest.raises(ValueError, match=f"{name} must be finite, got nan"):
        FixedWing(**{name: float("nan")})


def test_a_product_of_inertia_that_no_body_has_is_refused():
    with pytest.raises(ValueError, match="inertia_xz must be smaller than the geometric mean"):
        FixedWing(inertia_xz=0.07)
