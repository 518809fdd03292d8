"""What machines of a user's own bring with them: fast circuits, parameters that exclude each other, equal names."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
import torch

import visadapt as va
from visadapt.diagnosis.result import Cause, Diagnosis, Estimate, Gap, RecordingSummary, Where
from visadapt.systems import RigidBody, System, Variable
from visadapt.systems.base import holds
from visadapt.systems.contract import complaints

RANGES = (Variable("angle", "rad", -3.0, 3.0), Variable("rate", "rad/s", -10.0, 10.0))
SHAFT = (Variable("shaft", "N m", -1.0, 1.0),)


@dataclass(frozen=True)
class Motor(System):
    """A motor without an inductance, under a voltage."""

    inertia: float | torch.Tensor = 0.02  # kg m2
    constant: float | torch.Tensor = 0.3  # N m/A
    resistance: float | torch.Tensor = 1.5  # ohm

    name = "some_motor"
    states: ClassVar[tuple[Variable, ...]] = RANGES
    actions: ClassVar[tuple[Variable, ...]] = (Variable("voltage", "V", -2.0, 2.0),)
    loads: ClassVar[tuple[Variable, ...]] = SHAFT
    coordinates = ((0, 1),)

    def derivative(self, state, command, load):
        torque = self.constant * command[:, 0] / self.resistance
        return torch.stack((state[:, 1], (torque + load[:, 0]) / self.inertia), 1)


@dataclass(frozen=True)
class MotorWithCoil(Motor):
    """The same with an inductance: its current settles within 7 ms, and is not measured."""

    inductance: float | torch.Tensor = 0.01  # H
    damping: float | torch.Tensor = 0.05  # N m s/rad

    name = "motor_with_coil"
    states: ClassVar[tuple[Variable, ...]] = (*RANGES, Variable("current", "A", -2.0, 2.0))

    def derivative(self, state, command, load):
        _, rate, current = state.unbind(1)
        torque = self.constant * current - self.damping * rate + load[:, 0]
        voltage = command[:, 0] - self.resistance * current - self.constant * rate
        return torch.stack((rate, torque / self.inertia, voltage / self.inductance), 1)


def record(world, error=None, first=0.0):
    """Two episodes of 80 rows under random commands, of angle and rate, from the angle `first`; `error` of the angle
    (T,), by the angle."""
    world, generator, episodes = world.double(), torch.Generator().manual_seed(0), []
    for _ in range(2):
        at = world.start(first * torch.eye(len(world.system.states)).double()[:1])
        rows, commands = [], []
        for row in range(80):
            if row % 5 == 0:
                command = world.system.actions[0].largest * (2 * torch.rand(1, 1, generator=generator) - 1).double()
            rows.append(at.state[:, :2])
            commands.append(command)
            at = world.step(at, command)
        seen = torch.cat(rows)
        seen = seen + torch.tensor([0.002, 0.02]) * torch.randn(seen.shape, generator=generator)
        if error is not None:
            seen[:, 0] += error(seen[:, 0])
        episodes.append(va.Episode(world.period * np.arange(80.0), torch.cat(commands).numpy(), seen.detach().numpy()))
    return va.Recording(tuple(episodes), ("angle", "rate"), world.period, ("one", "two"))


def of(system, *names):
    """Effects of a system by their names."""
    return [effect for effect in va.catalogue(system) if effect.name in names]


def test_each_of_those_that_cannot_be_told_apart_has_its_own_size():
    names = ("voltage.actuator_gain", "resistance.scale", "constant.scale")
    recording = record(va.World(Motor(resistance=3.0), period=0.02))
    found = va.diagnose(recording, va.World(Motor(), period=0.02), of(Motor(), *names))
    sizes = {cause.effect: cause.parameters["scale"] for cause in found.causes}
    assert sizes.keys() == set(names)
    for name, size in (("voltage.actuator_gain", 0.5), ("resistance.scale", 2.0), ("constant.scale", 0.5)):
        assert sizes[name].value == pytest.approx(size, rel=0.03)
    assert ": measure resistance by itself" in found.next_experiment


def test_a_machine_with_a_fast_circuit_is_simulated_in_steps_that_follow_it():
    world = va.World(MotorWithCoil(), period=0.02)
    assert world.substeps == 3
    exact = va.World(MotorWithCoil(), period=0.02, substeps=40)
    at, command = world.start(torch.zeros(1, 3)), torch.ones(1, 1)
    torch.testing.assert_close(world.step(at, command).state, exact.step(at, command).state, rtol=0.01, atol=1e-4)
    found = va.diagnose(record(exact), world, of(MotorWithCoil(), "shaft.viscous_friction"))
    assert found.verdict == "no_gap"


def test_a_machine_whose_circuit_is_faster_than_the_default_one_is_diagnosed_too():
    faster = MotorWithCoil(inductance=0.003)
    recording = record(va.World(faster, period=0.02, substeps=100))
    names = ("shaft.viscous_friction", "inductance.scale", "resistance.scale")
    found = va.diagnose(recording, va.World(MotorWithCoil(), period=0.02), of(MotorWithCoil(), *names))
    assert [cause.effect for cause in found.causes] == ["inductance.scale"]
    assert found.causes[0].parameters["scale"].value == pytest.approx(0.3, rel=0.02)
    assert va.diagnose(recording, va.World(faster, period=0.02), of(MotorWithCoil(), *names)).verdict == "no_gap"


@dataclass(frozen=True)
class Hexacopter(RigidBody):
    """Six rotors: thrust along its own axis, and torques."""

    mass: float | torch.Tensor = 2.0  # kg
    gravity: float | torch.Tensor = 9.81  # m/s2

    name = "some_hexacopter"
    actions: ClassVar[tuple[Variable, ...]] = tuple(Variable(f"action_{k}", "1", -1.0, 1.0) for k in range(4))

    def inertia(self, like):
        return torch.diag(torch.tensor([0.02, 0.02, 0.04])).to(like)

    def wrench(self, velocity, rates, command):
        thrust = self.mass * self.gravity * (1 + command[:, 0])
        return torch.nn.functional.pad(thrust[:, None], (2, 0)), 0.1 * command[:, 1:] - 0.05 * rates


def test_a_rigid_body_of_ones_own_is_diagnosed_by_the_effects_on_every_vehicle():
    assert complaints(Hexacopter) == []
    generator, episodes = torch.Generator().manual_seed(0), []
    world = va.World(Hexacopter(), [va.effects.ConstantForce(force=0.6)], 0.05).double()
    for _ in range(4):
        at, rows, commands = world.start(torch.eye(13)[6:7].double()), [], []
        for row in range(25):
            if row % 5 == 0:
                command = 0.3 * torch.randn(1, 4, generator=generator).double().clamp(-1, 1)
            rows.append(at.state + 0.005 * torch.randn(1, 13, generator=generator))
            commands.append(command)
            at = world.step(at, command)
        seen, given = (torch.cat(each).detach().numpy() for each in (rows, commands))
        episodes.append(va.Episode(0.05 * np.arange(25.0), given, seen))
    columns = tuple(state.name for state in Hexacopter.states)
    recording = va.Recording(tuple(episodes), columns, 0.05, tuple("abcd"))
    pair = [va.effects.ConstantForce, va.effects.ActuatorGain]
    found = va.diagnose(recording, va.World(Hexacopter(), period=0.05), pair)
    assert [cause.effect for cause in found.causes] == ["constant_force"]
    assert found.causes[0].parameters["force"].value == pytest.approx(0.6, rel=0.05)
    assert {"constant_force", "actuator_delay"} < {effect.name for effect in va.catalogue(Hexacopter())}


def test_a_quadrotor_s_rate_loop_is_followed_at_the_references_period():
    world, exact = va.World(va.Quadrotor(), period=0.1), va.World(va.Quadrotor(), period=0.1, substeps=100)
    at, command = world.start(torch.eye(13)[6:7]), torch.tensor([[0.0, 0.5, 0.0, 0.0]])
    torch.testing.assert_close(world.step(at, command).state, exact.step(at, command).state, rtol=0.01, atol=1e-3)


@dataclass(frozen=True)
class Crank(System):
    """A crank whose rod has to be longer than it is."""

    inertia: float | torch.Tensor = 0.02  # kg m2
    crank: float | torch.Tensor = 0.05  # m
    rod: float | torch.Tensor = 0.08  # m

    name = "some_crank"
    states: ClassVar[tuple[Variable, ...]] = RANGES
    actions: ClassVar[tuple[Variable, ...]] = (Variable("force", "N", -10.0, 10.0),)
    loads: ClassVar[tuple[Variable, ...]] = SHAFT
    coordinates = ((0, 1),)

    def __post_init__(self):
        self.check_parameters()
        if not holds(self.rod > self.crank):
            raise ValueError("crank: the rod must be longer than the crank")

    def derivative(self, state, command, load):
        sine, cosine, ratio = state[:, 0].sin(), state[:, 0].cos(), self.crank / self.rod
        lever = self.crank * sine * (1 + ratio * cosine / (1 - (ratio * sine).square()).sqrt())
        return torch.stack((state[:, 1], (lever * command[:, 0] + load[:, 0]) / self.inertia), 1)


def test_a_parameter_is_searched_where_its_class_takes_it():
    (scale,) = of(Crank(), "crank.scale")
    assert scale.table[0].high == pytest.approx(1.6, rel=0.01)
    (other,) = of(Crank(), "rod.scale")
    assert other.table[0].low == pytest.approx(0.625, rel=0.01)
    recording = record(va.World(Crank(), [scale(scale=1.3)], period=0.02), first=1.0)
    found = va.diagnose(recording, va.World(Crank(), period=0.02), [scale])
    assert found.causes[0].parameters["scale"].value == pytest.approx(1.3, rel=0.02)


@dataclass(frozen=True)
class Arm(Motor):
    """A motor whose shaft is called as its angle is."""

    name = "some_arm"
    loads: ClassVar[tuple[Variable, ...]] = (Variable("angle", "N m", -1.0, 1.0),)


def test_an_error_of_a_reading_is_none_of_the_load_of_that_name():
    recording = record(va.World(Arm(), period=0.02), lambda angle: 0.01 * (6 * angle).sin())
    found = va.diagnose(recording, va.World(Arm(), period=0.02), of(Arm(), "angle.constant_load"))
    assert found.verdict == "unexplained"
    assert "error of the reading of angle may depend on angle" in found.next_experiment


def test_effects_of_the_diagnosed_system_are_given_where_another_has_the_same_names():
    va.catalogue(Motor())
    va.catalogue(Crank())  # which has a shaft too
    friction = Cause("shaft.viscous_friction", {"coefficient": Estimate(0.1, "N m s/rad", (0.09, 0.11))}, 1.0, 1.0)
    summary, gap = RecordingSummary(1, 80, 0.02), Gap("", 2.0, 1.0, 1.0, 1.0, 1.0)
    found = Diagnosis("some_motor", summary, "identified", Where({}, {}), (friction,), (), gap, "")
    assert va.World(Motor(), found.effects()).table[0].name == "coefficient"


@pytest.mark.parametrize("taken", ["half", "order", "training"])
def test_a_parameter_may_not_be_called_as_what_every_effect_has(taken):
    with pytest.raises(ValueError, match=f"slope_drag: every effect has something else that is called {taken}"):

        class Slope(va.DynamicsEffect):
            name = "slope_drag"
            table = (va.Parameter(taken, "N", 0.0, 1.0, 0.0),)
