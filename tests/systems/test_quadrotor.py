import numpy as np
import pytest
import torch

from tests.rigid_bodies import HEAVY, at_rest, fly, random_states
from visadapt.systems import Quadrotor
from visadapt.systems.rigid_body import ATTITUDE, POSITION, RATES, VELOCITY, from_angles
from visadapt.world import World

PARAMETERS = ("mass", "arm_length", "roll_gain", "yaw_gain", "min_thrust", "max_thrust", "max_rate", "gravity")


def hovering(system, steps, batch=1):
    commands = torch.zeros(steps, batch, 4, dtype=torch.float64)
    commands[..., 0] = system.hover()
    return commands


@pytest.mark.parametrize("system", [Quadrotor(), HEAVY])
def test_a_hover_stays_where_it_is(system):
    states = fly(system, at_rest(), hovering(system, 50), substeps=2)
    torch.testing.assert_close(states[-1], at_rest(), rtol=0, atol=1e-12)


def test_the_middle_command_nearly_hovers_as_in_the_paper():
    # A.1.1: an output in the middle of the range is 9.81; (2.21 + 17.31) / 2 is 9.76.
    assert Quadrotor().thrust(torch.tensor([[-1.0, 0, 0, 0], [0.0, 0, 0, 0], [1.0, 0, 0, 0]])).tolist() == (
        pytest.approx([2.21, 9.76, 17.31])
    )


def test_without_thrust_it_falls_freely_whatever_its_attitude():
    system = Quadrotor(min_thrust=0.0)
    start = random_states(4)
    start[:, RATES] = 0
    down = torch.tensor([-1.0, 0, 0, 0], dtype=torch.float64).expand(10, 4, 4)
    end = fly(system, start, down, substeps=1)[-1]
    gravity = torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64)
    torch.testing.assert_close(end[:, POSITION], start[:, POSITION] + start[:, VELOCITY] + gravity / 2)
    torch.testing.assert_close(end[:, VELOCITY], start[:, VELOCITY] + gravity)
    torch.testing.assert_close(end[:, ATTITUDE], start[:, ATTITUDE])


@pytest.mark.parametrize("command", [-1.0, 0.3, 1.0])
@pytest.mark.parametrize("system", [Quadrotor(), HEAVY])
def test_level_thrust_accelerates_upwards_whatever_the_mass(system, command):
    commands = torch.zeros(10, 1, 4, dtype=torch.float64)
    commands[..., 0] = command
    end = fly(system, at_rest(), commands, substeps=4)[-1, 0]
    acceleration = 2.21 + (command + 1) / 2 * (17.31 - 2.21) - system.gravity
    assert end[:6].tolist() == pytest.approx([0, 0, acceleration / 2, 0, 0, acceleration])


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("system", [Quadrotor(), HEAVY])
def test_a_step_of_a_rate_command_is_followed_as_the_loop_of_first_order_that_it_closes(system, axis):
    commands = hovering(system, 10)
    commands[..., 1 + axis] = -0.8
    states = fly(system, at_rest(), commands, period=0.05, substeps=16)[:, 0]
    gain = (system.roll_gain, system.roll_gain, system.yaw_gain)[axis]
    time = torch.arange(11, dtype=torch.float64) * 0.05
    asked = -0.8 * system.max_rate
    torch.testing.assert_close(states[:, 10 + axis], asked * (1 - torch.exp(-gain * time)), rtol=1e-6, atol=1e-9)
    # Turning about one axis: the angle is the integral of the rate.
    angle = asked * (time - (1 - torch.exp(-gain * time)) / gain)
    torch.testing.assert_close(states[:, 6], (angle / 2).cos(), rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(states[:, 7 + axis], (angle / 2).sin(), rtol=1e-7, atol=1e-7)


def test_axes_do_not_disturb_each_other_since_the_loop_undoes_the_gyroscopic_torque():
    commands = hovering(Quadrotor(), 5)
    commands[..., 1:] = torch.tensor([1.0, -0.6, 0.8], dtype=torch.float64)
    rates = fly(Quadrotor(), at_rest(), commands)[-1, 0, RATES]
    followed = 1 - np.exp(-0.5 * np.array([16.6, 16.6, 5.0]))
    assert rates.tolist() == pytest.approx((0.5 * np.array([1.0, -0.6, 0.8]) * followed).tolist(), rel=1e-6)


@pytest.mark.parametrize(
    ("angles", "direction"),
    [((0.3, 0.0, 0.0), (0, -1)), ((0.0, 0.3, 0.0), (1, 0)), ((0.0, 0.3, np.pi / 2), (0, 1))],
)
def test_a_tilt_accelerates_to_its_side(angles, direction):
    # REP 103: a positive roll dips the right side (-y), a positive pitch the nose (+x, turned by the yaw).
    state = at_rest()
    state[:, ATTITUDE] = from_angles(torch.tensor([angles], dtype=torch.float64))
    change = Quadrotor().derivative(state, hovering(Quadrotor(), 1)[0], torch.zeros(1, 6, dtype=torch.float64))
    pushed = 9.81 * np.sin(0.3)
    assert change[0, 3:5].tolist() == pytest.approx([pushed * d for d in direction], abs=1e-9)
    assert float(change[0, 5]) == pytest.approx(9.81 * (np.cos(0.3) - 1))


@pytest.mark.parametrize("system", [Quadrotor(), HEAVY])
def test_gradients_agree_with_finite_differences(system):
    inputs = [random_states(3), random_states(3, seed=1)[:, :4], random_states(3, seed=2)[:, :6]]
    assert torch.autograd.gradcheck(system.derivative, [value.requires_grad_() for value in inputs])


def test_gradients_through_a_step_of_the_world_agree_with_finite_differences():
    world = World(Quadrotor(), period=0.1, substeps=2)

    def step(state, command):
        return world.step(world.start(state), command).state

    # Within (-1, 1), where the world does not clip.
    command = random_states(2, seed=1)[:, :4].clamp(-0.9, 0.9)
    assert torch.autograd.gradcheck(step, (random_states(2).requires_grad_(), command.requires_grad_()))


def test_gradients_in_all_parameters_agree_with_finite_differences():
    state, command, load = random_states(2), random_states(2, seed=1)[:, :4], random_states(2, seed=2)[:, :6]

    def derivative(*values):
        return Quadrotor(**dict(zip(PARAMETERS, values, strict=True))).derivative(state, command, load)

    values = [torch.tensor([getattr(HEAVY, name)] * 2, dtype=torch.float64) for name in PARAMETERS]
    assert torch.autograd.gradcheck(derivative, [value.requires_grad_() for value in values])


@pytest.mark.parametrize("name", PARAMETERS)
def test_a_parameter_may_be_one_for_each_row(name):
    values = getattr(HEAVY, name) * torch.tensor([0.5, 1.0, 1.2], dtype=torch.float64)
    arguments = random_states(3), random_states(3, seed=1)[:, :4], random_states(3, seed=2)[:, :6]
    together = Quadrotor(**{name: values})
    for row, value in enumerate(values.tolist()):
        alone = Quadrotor(**{name: value})
        own = [argument[row : row + 1] for argument in arguments]
        torch.testing.assert_close(together.derivative(*arguments)[row], alone.derivative(*own)[0])
        assert float(torch.as_tensor(together.hover()).expand(3)[row]) == pytest.approx(alone.hover())
    assert getattr(together.to(torch.zeros(1)), name).dtype == torch.float32
    scalar = Quadrotor(**{name: values[1]}).derivative(*arguments)
    torch.testing.assert_close(scalar[1], together.derivative(*arguments)[1])


@pytest.mark.parametrize("name", PARAMETERS)
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan")])
def test_an_impossible_parameter_is_named_with_its_value(name, value):
    if name == "min_thrust" and value == 0:
        assert Quadrotor(min_thrust=0.0).min_thrust == 0  # rotors that may stop
        return
    right = "0 or positive" if name == "min_thrust" else "positive"
    with pytest.raises(ValueError, match=rf"quadrotor: {name} must be {right}, got {value}"):
        Quadrotor(**{name: value})
    with pytest.raises(ValueError, match=f"{name} must be {right}"):
        Quadrotor(**{name: torch.tensor([getattr(HEAVY, name), value])})


def test_a_range_of_thrust_that_is_empty_is_named():
    with pytest.raises(ValueError, match=r"max_thrust must exceed min_thrust, got 2.0 and 2.21"):
        Quadrotor(max_thrust=2.0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_and_device_follow_the_state(dtype):
    for device in ("cpu", "meta"):
        state = at_rest(2, dtype).to(device)
        change = Quadrotor().derivative(state, state[:, :4], state[:, :6])
        assert change.dtype == dtype
        assert change.device.type == device


def test_two_substeps_are_enough_for_the_commands_of_the_paper():
    # Commands that jump over their whole range every 0.1 s, for 2 s: far rougher than a policy's. The faster rate
    # loop (16.6 1/s) is what RK4 is coarse for: a step of 0.05 s is 0.83 of its time constant.
    generator = torch.Generator().manual_seed(0)
    commands = 2 * torch.rand(20, 64, 4, generator=generator, dtype=torch.float64) - 1
    coarse, fine = (fly(Quadrotor(), at_rest(64), commands, substeps=n) for n in (2, 12))
    away = (coarse - fine).abs()
    # Seen: 0.4 mm, 0.3 mm/s and 2 mrad/s at most, on flights of metres.
    assert fine[-1, :, POSITION].norm(dim=1).mean() > 1
    assert away[..., POSITION].max() < 1e-3
    assert away[..., VELOCITY].max() < 1e-3
    assert away[..., RATES].max() < 5e-3


def rotorpy_flight(commands, h):
    """Positions, velocities and rates (K + 1, 9) of rotorpy's quadrotor, its rate loop and rotors `h` s behind."""
    multirotor = pytest.importorskip("rotorpy.vehicles.multirotor")
    parameters = pytest.importorskip("rotorpy.vehicles.hummingbird_params").quad_params
    size = 1.0 * 0.2**2 / 12
    gains = np.array([16.6, 16.6, 5.0])
    inertia = size * np.array([4.5, 4.5, 7.0])
    arms = {name: place * 0.2 / 0.17 for name, place in parameters["rotor_pos"].items()}
    own = {"mass": 1.0, "rotor_pos": arms, "tau_m": h / 10, "k_w": gains, "rotor_speed_max": 2000.0}
    own |= dict(zip(("Ixx", "Iyy", "Izz"), inertia, strict=True))
    vehicle = multirotor.Multirotor(parameters | own, control_abstraction="cmd_ctbr", aero=False)
    hover = np.sqrt(9.81 / 4 / parameters["k_eta"])
    state = {name: np.zeros(3) for name in ("x", "v", "w", "wind")}
    state |= {"q": np.array([0.0, 0.0, 0.0, 1.0]), "rotor_speeds": np.full(4, hover)}
    rows = []
    for thrust, *rates in commands:
        for _ in range(round(0.1 / h)):
            # rotorpy's rate loop leaves the gyroscopic torque in, ours takes it out.
            gyroscopic = np.cross(state["w"], inertia * state["w"]) / inertia
            asked = {"cmd_thrust": 9.76 + 7.55 * thrust, "cmd_w": 0.5 * np.array(rates) + gyroscopic / gains}
            state = vehicle.step(state, asked, h)
        rows.append(np.concatenate((state["x"], state["v"], state["w"])))
    return np.stack(rows)


def test_trajectories_agree_with_those_of_rotorpy():
    generator = torch.Generator().manual_seed(3)
    commands = 1.6 * torch.rand(12, 4, generator=generator, dtype=torch.float64) - 0.8
    ours = fly(Quadrotor(), at_rest(), commands[:, None])[1:, 0]
    ours = torch.cat((ours[:, :6], ours[:, RATES]), 1).numpy()
    coarse, fine = (np.abs(rotorpy_flight(commands.tolist(), h) - ours).max(0) for h in (0.002, 0.001))
    assert np.abs(ours[-1]).max() > 1
    # rotorpy holds the torque for a step h, and its rotors follow h / 10 late: its rate loop is late by 0.6 h. A jump
    # of a rate by 0.8 rad/s is then off by 16.6 * 0.8 * 0.6 h, 8 mrad/s at h = 1 ms, a fifth of it at the next command.
    assert fine[6:].max() < 3e-3
    assert fine[3:6].max() < 1e-3
    assert fine[:3].max() < 5e-4
    # Nothing else separates the two: with half the lateness, half the difference is left.
    np.testing.assert_allclose(coarse / fine, 2, atol=0.5)
