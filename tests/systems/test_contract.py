"""The contract of a system: the library's keep it, and a class of one's own is told in a line what it lacks."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from experiments.furuta import Furuta
from tests.own_systems import Pendulum, Rover
from visadapt.systems import SYSTEMS, System, Variable
from visadapt.systems.contract import complaints


@pytest.mark.parametrize("system", [*SYSTEMS.values(), Pendulum, Rover, Furuta], ids=lambda system: system.name)
def test_the_systems_keep_it(system):
    assert complaints(system) == []


def altered(**attributes):
    return dataclass(frozen=True)(type("Altered", (Pendulum,), attributes))


def test_a_class_that_is_no_dataclass_or_states_nothing():
    class Plain(Pendulum):
        pass

    @dataclass(frozen=True)
    class Empty(System):
        mass: float = 1.0

    assert complaints(Plain) == ["Plain is no frozen dataclass: write @dataclass(frozen=True) above it"]
    found = complaints(Empty)  # type: ignore[type-abstract]
    assert len(found) == 5
    assert 'Empty has no actions: actions = (Variable("torque", "N m", -1.0, 1.0),) would be right' in found


def rates(change):
    """The pendulum's derivative, changed."""

    def derivative(self, state, command, load):
        return change(Pendulum.derivative(self, state, command, load), state, load)

    return derivative


ANGLE, RATE = Pendulum.states


@pytest.mark.parametrize(
    ("attributes", "right"),
    [
        ({"states": (Variable("angle", "", -3.0, 3.0), RATE)}, "states: angle has no unit; an SI unit such as m"),
        ({"states": (Variable("angle", "rad", 3.0, -3.0), RATE)}, "angle goes from 3.0 to -3.0; two finite numbers"),
        (
            {"states": (Variable("angle", "rad", -3e-3, 3e-3), RATE)},
            "angle reaches 0.003 rad; in another unit",
        ),
        ({"actions": (Variable("angle", "N m", -1.0, 1.0),)}, "'angle' is a state and an action, which are columns"),
        ({"states": (ANGLE, ANGLE)}, "states has 'angle' twice"),
        ({"states": ("angle", "rate")}, "states holds 'angle'; states = (Variable("),
        ({"states": (Variable("time", "rad", -3.0, 3.0), RATE)}, "(time and episode are taken)"),
        ({"loads": (*Pendulum.loads, Variable("other", "N", -1.0, 1.0))}, "load (5, 2) raises ValueError: too many"),
        ({"loads": ()}, 'loads is (); a tuple of at least one, loads = (Variable("joint", "N m"'),
        ({"prediction_time": 0.0}, "prediction_time is 0.0; a positive number of s, such as"),
        ({"prediction_time": "10 s"}, "prediction_time is '10 s'; a positive number of s"),
        ({"coordinates": ()}, "coordinates is (); a pair (column of the position, column of the velocity) for each"),
        ({"coordinates": ((1, 0),)}, "angle is not the rate of rate that derivative returns; a velocity that"),
        ({"coordinates": ((None, 2),)}, "coordinates holds (None, 2);"),
        ({"coordinates": ((None, 0),)}, "loads: joint does not accelerate angle"),
        ({"coordinates": ((0, 2),)}, "coordinates holds (0, 2);"),
        ({"derivative": rates(lambda r, s, load: r[:, :1])}, "has the shape (5, 1); a tensor (5, 2), the rate of each"),
        ({"derivative": rates(lambda r, s, load: r.numpy())}, "has a ndarray; a tensor (5, 2)"),
        ({"derivative": rates(lambda r, s, load: r / 0)}, "derivative: the rate of angle is"),
        ({"derivative": rates(lambda r, s, load: r.detach())}, "is not differentiable: compute it from the tensors"),
        (
            {"derivative": rates(lambda r, s, load: r + torch.from_numpy(np.sin(s.detach().numpy())))},
            "derivative by the state angle is not what torch differentiates",
        ),
        ({"derivative": rates(lambda r, s, load: r + r.mean(0))}, "derivative mixes rows"),
        ({"derivative": rates(lambda r, s, load: r.float())}, "derivative turns torch.float64 into torch.float32"),
        (
            {"derivative": rates(lambda r, s, load: r - load * torch.tensor([0.0, 99.0]).double())},
            "loads: joint does not accelerate rate",
        ),
        ({"derivative": rates(lambda r, s, load: r + load**2 * s)}, "derivative is not linear in the load"),
        (
            {"derivative": rates(lambda r, s, load: r + 0.1 * (s**2).sqrt())},
            "derivative is not differentiable at angle 0, rate 0, command and load 0: a root, a norm or a power has",
        ),
        (
            {"derivative": rates(lambda r, s, load: r + (2.9 - s[:, :1]).sqrt())},
            "derivative: the rate of angle is nan at angle 2.9",
        ),
        ({"predicton_time": 10.0}, "predicton_time is nothing that visadapt reads; prediction_time is: is that meant?"),
        ({"name": "cartpole"}, "name is 'cartpole', a system of visadapt's own; another word would be right"),
        ({"inertia": -0.1, "__annotations__": {"inertia": float}}, "pendulum: inertia must be positive, got -0.1"),
        ({"inertia": "heavy", "__annotations__": {"inertia": str}}, "Altered() raises TypeError"),
    ],
)
def test_what_is_wrong_is_said_in_a_line(attributes, right):
    found = complaints(altered(**attributes))
    assert any(right in line for line in found), found
    assert not any("\n" in line for line in found)


def test_a_parameter_that_is_broadcast_over_columns():
    def derivative(self, state, command, load):
        torque = (command + load) / self.inertia
        return torch.cat((state[:, 1:], torque), 1)

    (line,) = complaints(altered(derivative=derivative))
    assert line.startswith("inertia as a tensor, one value for each row (5,), gives rates (5, 6); (5, 2) are right")


def test_a_parameter_that_cannot_be_one_for_each_row():
    def derivative(self, state, command, load):
        return torch.stack((state[:, 1], (command + load)[:, 0] / float(self.inertia)), 1)

    (line,) = complaints(altered(derivative=derivative))
    assert "inertia as a tensor, one value for each row (5,), raises" in line
    assert "test_contract.py, line" in line
