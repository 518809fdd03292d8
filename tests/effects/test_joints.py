"""The effects of a system of one's own: which there are, in which units, and that each does what it says."""

from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch

from experiments.furuta import Furuta
from tests.own_systems import Pendulum, Rover, Winch
from tests.worlds import columns
from visadapt.effects import EFFECTS
from visadapt.effects.catalogue import catalogue, catalogue_text, twins
from visadapt.systems import CartPole, System, Variable
from visadapt.world import World

FURUTA = Furuta()
BY_NAME = {effect.name: effect for effect in catalogue(FURUTA)}
STATE = columns(0.3, 1.2, 2.0, -3.0)
LOADS = [
    ("arm_axis.viscous_friction", {"coefficient": 1e-3}, "N m s/rad", [-2e-3, 0]),
    ("hinge.viscous_friction", {"coefficient": 1e-3}, "N m s/rad", [0, 3e-3]),
    ("hinge.quadratic_drag", {"coefficient": 1e-4}, "N m s2/rad2", [0, 9e-4]),
    ("arm_axis.spring", {"stiffness": 0.01, "rest": 0.1}, "N m/rad", [-2e-3, 0]),
    ("hinge.constant_load", {"torque": 2e-3}, "N m", [0, 2e-3]),
    ("hinge.push", {"start": 1.0, "end": 2.0, "torque": 2e-3}, "s", [0, 2e-3]),
    ("arm_axis.periodic_load", {"amplitude": 1e-3, "frequency": 0.5, "phase": 0.0, "offset": 0.0}, "N m", [0, 0]),
    ("arm_axis.coulomb_friction", {"torque": 3e-3}, "N m", [-3e-3, 0]),
    ("hinge.directional_friction", {"forward": 1e-3, "backward": 2e-3}, "N m", [0, 2e-3]),
    ("hinge.stribeck_friction", {"torque": 1e-3, "breakaway": 3e-3, "velocity": 0.1}, "N m", [0, 1e-3]),
]


@pytest.mark.parametrize(("name", "values", "unit", "expected"), LOADS)
def test_the_load_of_a_joint_acts_on_it_alone(name, values, unit, expected):
    effect = BY_NAME[name](**values)
    assert effect.table[0].unit == unit
    at = World(FURUTA, [effect]).start(STATE, torch.full((1,), 1.5, dtype=torch.float64))
    load = World(FURUTA, [effect]).load(at)[0]
    torch.testing.assert_close(load, torch.tensor(expected, dtype=torch.float64), rtol=1e-6, atol=1e-9)


def test_cogging_returns_in_every_turn_of_a_joint_that_turns():
    named = {effect.name: effect for effect in catalogue(Winch())}
    world = World(Winch(), [named["axis.cogging"](torque=0.02, waves=6.0, phase=0.4)])
    drum = torch.tensor([0.3, 0.3 + 2 * torch.pi], dtype=torch.float64)
    load = world.load(world.start(torch.stack((drum, torch.zeros_like(drum)), 1)))[:, 0]
    torch.testing.assert_close(load, 0.02 * (6 * drum + 0.4).cos(), rtol=1e-6, atol=1e-8)
    assert load[0].item() == pytest.approx(load[1].item(), abs=1e-7)
    assert "joint.cogging" not in {effect.name for effect in catalogue(Pendulum())}  # it swings


def test_an_eccentric_sensor_reads_the_rate_of_its_error_too():
    named = {effect.name: effect for effect in catalogue(Winch())}
    world = World(Winch(), [named["drum.sensor_eccentricity"](amplitude=0.05, waves=1.0, phase=0.4)])
    drum, step = torch.tensor([0.3, 2.0], dtype=torch.float64), 1e-6
    readings = [world.measure(world.start(torch.stack((at, 3 + 0 * at), 1)))[0] for at in (drum, drum + 3 * step)]
    torch.testing.assert_close(readings[0][:, 0], drum + 0.05 * (drum + 0.4).cos(), rtol=1e-6, atol=1e-8)
    torch.testing.assert_close((readings[1][:, 0] - readings[0][:, 0]) / step, readings[0][:, 1], rtol=1e-5, atol=1e-6)
    assert "angle.sensor_eccentricity" not in {effect.name for effect in catalogue(Pendulum())}  # it swings


def test_added_inertia_is_that_of_a_heavier_arm():
    added = BY_NAME["arm_axis.added_inertia"](inertia=1e-4)
    command, load = columns(2.0), columns(1e-3, -1e-3)
    heavier = replace(FURUTA, arm_inertia=FURUTA.arm_inertia + 1e-4)
    found = World(FURUTA, [added, BY_NAME["hinge.added_inertia"](inertia=0.0)]).altered(STATE)
    torch.testing.assert_close(
        found.derivative(STATE, command, load), heavier.derivative(STATE, command, load), rtol=1e-6, atol=1e-6
    )
    twice = World(FURUTA, [BY_NAME["arm_axis.added_inertia"](inertia=5e-5) for _ in range(2)]).altered(STATE)
    torch.testing.assert_close(
        twice.derivative(STATE, command, load), heavier.derivative(STATE, command, load), rtol=1e-6, atol=1e-6
    )
    scaled: Any = World(FURUTA, [added, BY_NAME["half_length.scale"](scale=2.0)]).altered(STATE)
    assert scaled.half_length.item() == pytest.approx(0.129)


def test_a_drift_carries_what_belongs_to_no_joint():
    rover = Rover()
    named = {effect.name: effect for effect in catalogue(rover)}
    assert [name for name in named if name.endswith(".drift")] == ["x.drift", "y.drift"]
    assert named["x.drift"].table[0].unit == "m/s"
    drifts = named["x.drift"](rate=torch.tensor([0.3, 0.1])), named["y.drift"](rate=-0.1)
    heavier, torques = named["forward.added_inertia"](inertia=2.0), columns(1.0, 0.7).repeat(2, 1)
    paths = []
    for effects in ([heavier], [*drifts, heavier]):
        world = World(rover, effects, 0.05)
        at = world.start(torch.zeros(2, 5, dtype=torch.float64))
        for _ in range(20):
            at = world.step(at, torques)
        paths.append(at.state)
    carried = torch.tensor([[0.3, -0.1, 0, 0, 0], [0.1, -0.1, 0, 0, 0]], dtype=torch.float64)
    torch.testing.assert_close(paths[1] - paths[0], carried, rtol=1e-6, atol=1e-8)
    (slope,) = torch.autograd.grad(paths[1][:, 0].sum(), list(drifts[0].parameters()))
    torch.testing.assert_close(slope.double(), torch.ones(2, dtype=torch.float64), rtol=1e-6, atol=1e-6)


def test_a_command_that_is_the_rate_of_a_state_has_the_bias_that_is_its_drift():
    class TurnedRobot(System):
        name = "turned_robot"
        states = (
            Variable("x", "m", -5, 5),
            Variable("y", "m", -5, 5),
            Variable("yaw", "rad", -4, 4),
            *Rover.states[3:4],
        )
        actions = (Variable("turn", "rad/s", -1, 1), Variable("pull", "m/s2", -1, 1))
        loads = (Variable("forward", "N/kg", -1, 1),)
        coordinates = ((None, 3),)

        def derivative(self, state, command, load):
            yaw, speed = state[:, 2], state[:, 3]
            turn, pull = command.unbind(1)
            return torch.stack((speed * yaw.cos(), speed * yaw.sin(), turn, pull + load[:, 0] - speed), 1)

    robot = dataclass(frozen=True)(TurnedRobot)()
    named = {effect.name: effect for effect in catalogue(robot)}
    assert twins(named["turn.actuator_bias"], named.values(), robot) == [named["yaw.drift"]]
    assert "switch the actuator off" in named["turn.actuator_bias"].settled_by["yaw.drift"]


def test_a_parameter_is_scaled_by_a_factor_for_each_row():
    factors = torch.tensor([1.0, 2.0])
    altered: Any = World(FURUTA, [BY_NAME["resistance.scale"](scale=factors)]).altered(STATE)
    assert altered.resistance.tolist() == pytest.approx([8.4, 16.8])
    assert "gravity.scale" not in BY_NAME


def test_a_command_is_limited_to_its_range_and_has_effects_in_its_unit():
    saturation = BY_NAME["voltage.actuator_saturation"]
    (limit,) = saturation.table
    assert (limit.unit, limit.high, limit.neutral) == ("V", 10.0, 10.0)
    volts = columns(-30.0, 4.0, 30.0)[..., None]
    assert World(FURUTA).actuate(volts)[0, :, 0, 0].tolist() == [-10, 4, 10]
    assert World(FURUTA, [saturation(limit=3.0)]).actuate(volts)[0, :, 0, 0].tolist() == [-3, 3, 3]
    assert World(CartPole()).actuate(volts)[0, :, 0, 0].tolist() == [-1, 1, 1]


def test_of_two_commands_an_effect_changes_its_own():
    @dataclass(frozen=True)
    class Two(Pendulum):
        name = "two_motors"
        actions = tuple(replace(Pendulum.actions[0], name=name) for name in ("upper", "lower"))

    system = Two()
    effects = {effect.name: effect for effect in catalogue(system)}
    commands = torch.tensor([[[1.0, 1.0], [2.0, -1.0]]])
    delayed = World(system, [effects["lower.actuator_delay"](delay=0.05)]).actuate(commands)
    assert delayed.flatten().tolist() == pytest.approx([1, 0, 2, 1], abs=1e-5)
    both = World(system, [effects["commands.actuator_delay"](delay=0.05)]).actuate(commands)
    assert both.flatten().tolist() == pytest.approx([0, 0, 1, 1], abs=1e-5)
    assert [e.name for e in twins(effects["commands.actuator_delay"], effects.values(), system)] == [
        "sensors.measurement_delay"
    ]


def test_sensors_of_an_angle_scale_its_rate_too_and_an_offset_does_not():
    world = World(FURUTA, [BY_NAME["arm.sensor_scale"](scale=2.0), BY_NAME["pendulum.sensor_offset"](offset=0.1)])
    assert world.reading(STATE)[0].tolist() == pytest.approx([0.6, 1.3, 4.0, -3.0])


@pytest.mark.parametrize(("effect", "column"), [("arm.position_scale", 0), ("arm_rate.sensor_scale", 2)])
def test_an_angle_and_its_rate_may_have_a_scale_of_their_own(effect, column):
    read = World(FURUTA, [BY_NAME[effect](scale=2.0)]).reading(STATE)[0]
    expected = STATE[0].clone()
    expected[column] *= 2
    assert read.tolist() == pytest.approx(expected.tolist())


@pytest.mark.parametrize("turned", [1, -1])
def test_a_scale_acts_before_an_offset_whichever_is_named_first(turned):
    effects = [BY_NAME["arm.sensor_scale"](scale=2.0), BY_NAME["arm.sensor_offset"](offset=0.1)]
    assert World(FURUTA, effects[::turned]).reading(STATE)[0, 0].item() == pytest.approx(0.7)


def test_a_late_measurement_is_a_late_command():
    torch.manual_seed(0)
    commands = torch.randn(20, 1, 1, dtype=torch.float64)
    seen = []
    for name in ("sensors.measurement_delay", "voltage.actuator_delay"):
        world = World(FURUTA, [BY_NAME[name](delay=0.02)], period=0.02, substeps=2)
        at = world.start(torch.zeros(1, 4, dtype=torch.float64))
        rows = []
        for command in commands:
            row, at = world.measure(at)
            rows.append(row)
            at = world.step(at, command)
        seen.append(torch.cat(rows))
    torch.testing.assert_close(seen[0], seen[1])


def test_added_inertia_on_a_load_that_is_no_force_has_the_load_s_unit_over_an_acceleration_s():
    @dataclass(frozen=True)
    class Oven(System):
        capacity: float = 2000.0

        name = "warm_oven"
        states = (Variable("air", "K", 0.0, 100.0),)
        actions = (Variable("heater", "W", 0.0, 400.0),)
        loads = (Variable("heat", "W", -100.0, 100.0),)
        coordinates = ((None, 0),)

        def derivative(self, state, command, load):
            return (command + load) / self.capacity

    found = {effect.name: effect for effect in catalogue(Oven())}
    assert found["heat.added_inertia"].table[0].unit == "W s/K"


def test_the_catalogue_of_a_system_leaves_the_librarys_effects_out():
    assert "actuator_gain" not in BY_NAME
    assert "cart_mass" not in BY_NAME
    text = catalogue_text(FURUTA)
    assert EFFECTS["hinge.viscous_friction"] is BY_NAME["hinge.viscous_friction"]
    assert "hinge.viscous_friction (dynamics)" in text
    assert "systems: " not in text, "all of them are of this one"
    assert not any("." in effect.name for effect in catalogue(CartPole()))


def test_a_system_derived_from_another_has_its_own_effects_whichever_was_asked_first():
    class Derived(Pendulum):
        name = "derived_pendulum"

    before = {effect.name for effect in catalogue(Pendulum())}
    derived = catalogue(Derived())
    assert {effect.name for effect in derived} == before
    assert len(derived) == len(before)
    assert {effect.systems for effect in derived if "." in effect.name} == {(Derived,)}
    assert {effect.systems for effect in catalogue(Pendulum()) if "." in effect.name} == {(Pendulum,)}


def test_effects_that_are_the_same_are_known_to_be():
    @dataclass(frozen=True)
    class Motor(Pendulum):
        max_torque: float = 2.0

        name = "motor"
        actions = (replace(Pendulum.actions[0], name="command", unit="1", low=-1.0, high=1.0),)

        def derivative(self, state, command, load):
            return super().derivative(state, self.max_torque * command, load)

    effects = {effect.name: effect for effect in catalogue(Motor())}
    assert effects["command.actuator_gain"].indistinguishable_from == ("max_torque.scale",)
    assert effects["max_torque.scale"].indistinguishable_from == ("command.actuator_gain",)
    assert effects["joint.constant_load"].indistinguishable_from == ("command.actuator_bias",)
    assert effects["inertia.scale"].indistinguishable_from == ()
    # With friction of the motor's voltage against its speed, the resistance is no gain.
    assert BY_NAME["resistance.scale"].indistinguishable_from == ()


@pytest.mark.parametrize(("speed", "command"), [(0.8, 0.5), (0.8, -0.5), (-0.8, 0.5), (-0.8, -0.5)])
def test_a_gear_rubs_with_a_share_of_the_motors_force_whichever_way_it_drives(speed, command):
    rubbing = World(CartPole(), [EFFECTS["load_dependent_friction"](share=0.2)], 0.001).double()
    slowed = World(CartPole(), [EFFECTS["coulomb_friction"](force=0.2 * 0.5 * CartPole().max_force)], 0.001).double()
    state, commands = columns(0.1, speed, 0.2, 1.0), columns(command)[None]
    time = torch.zeros(1).double()
    found, expected, free = (
        world.integrate(time, state, commands) for world in (rubbing, slowed, World(CartPole(), period=0.001).double())
    )
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-8)
    assert (found - free)[0, 1].item() * speed < 0, "against the motion"
    idle = rubbing.integrate(time, state, 0 * commands)
    torch.testing.assert_close(idle, World(CartPole(), period=0.001).double().integrate(time, state, 0 * commands))


def test_what_a_gear_of_a_joint_passes_is_the_motors_torque():
    loads = FURUTA.motor_loads(STATE, columns(2.0))[0]
    assert loads.tolist() == pytest.approx([2.0 * FURUTA.motor_constant / FURUTA.resistance, 0.0], abs=1e-12)
    rubbing = World(FURUTA, [BY_NAME["arm_axis.load_dependent_friction"](share=0.3)], 1e-4).double()
    slowed = World(FURUTA, [BY_NAME["arm_axis.coulomb_friction"](torque=0.3 * float(loads[0]))], 1e-4).double()
    found, expected = (
        world.integrate(torch.zeros(1).double(), STATE, columns(2.0)[None]) for world in (rubbing, slowed)
    )
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-9)
