"""A transmission that gives: what its motor's encoder reads, when, and that a fit finds it."""

import pytest
import torch

from experiments.furuta import Furuta
from tests.own_systems import Pendulum
from visadapt.effects.catalogue import catalogue
from visadapt.estimation.effect_fit import fit_effects
from visadapt.world import World

PERIOD, COMPLIANCE = 0.02, 0.01
TORQUES = torch.tensor([0.4, -1.0, 1.6, 0.2, -0.8], dtype=torch.float64)
BY_NAME = {effect.name: effect for effect in catalogue(Pendulum())}


def made(**values):
    """Effects of the pendulum by their names, with _ in place of the point, each with the value of its parameter."""
    for name, value in values.items():
        effect = BY_NAME[name.replace("__", ".")]
        yield effect(**{effect.table[0].name: value})


def rows(world, torques=TORQUES):
    """The states (T + 1, 2) of an episode that begins at rest, and what the sensors read of them."""
    at = world.start(torch.zeros(1, 2, dtype=torch.float64))
    states, read = [], []
    for k in range(len(torques) + 1):
        seen, at = world.measure(at)
        states.append(at.state[0])
        read.append(seen[0])
        if k < len(torques):
            at = world.step(at, torques[k].reshape(1, 1))
    return torch.stack(states), torch.stack(read)


def twisted(torque):
    """What the torque (T,) before each row but the first adds to the readings (T + 1, 2)."""
    torque = torch.cat((torch.zeros(1), torque))
    return COMPLIANCE * torch.stack((torque, torque.diff(prepend=torque[:1]) / PERIOD), -1)


@pytest.mark.parametrize(
    ("others", "torque"),
    [
        ({}, TORQUES),
        ({"torque__actuator_gain": 0.5}, 0.5 * TORQUES),
        ({"torque__actuator_delay": PERIOD}, torch.cat((torch.zeros(1), TORQUES[:-1]))),
        ({"torque__actuator_delay": PERIOD / 4}, 0.75 * TORQUES + 0.25 * torch.cat((torch.zeros(1), TORQUES[:-1]))),
    ],
    ids=["alone", "gain", "delay", "quarter of a period late"],
)
def test_the_motor_is_ahead_of_the_joint_by_the_torque_that_acted_before_the_row(others, torque):
    world = World(Pendulum(), [*made(joint__transmission_compliance=COMPLIANCE, **others)], PERIOD, substeps=4)
    states, read = rows(world)
    torch.testing.assert_close(read, states + twisted(torque), rtol=1e-5, atol=1e-6)


def test_late_sensors_read_the_motor_late():
    effects = made(joint__transmission_compliance=COMPLIANCE, sensors__measurement_delay=PERIOD)
    states, read = rows(World(Pendulum(), [*effects], PERIOD))
    torch.testing.assert_close(read[1:], (states + twisted(TORQUES))[:-1], rtol=1e-5, atol=1e-6)


def test_a_motor_that_is_commanded_a_voltage_twists_by_its_torque():
    arm = Furuta()
    (transmission,) = (each for each in catalogue(arm) if each.name.endswith("transmission_compliance"))
    assert transmission.table[0].unit == "rad/(N m)"
    assert transmission.name == "arm_axis.transmission_compliance", "no motor moves the hinge"
    world = World(arm, [transmission(compliance=COMPLIANCE)], PERIOD)
    at = world.step(world.start(torch.zeros(1, 4, dtype=torch.float64)), torch.full((1, 1), 5.0, dtype=torch.float64))
    ahead = (world.measure(at)[0] - at.state)[0, 0]
    load = arm.motor_loads(at.state, torch.full((1, 1), 5.0, dtype=torch.float64))[0, 0]
    assert load > 0.01
    assert ahead.item() == pytest.approx(COMPLIANCE * load.item())


@pytest.mark.parametrize("row", [1, 3])
def test_an_episode_goes_on_from_any_of_its_rows(row):
    effects = made(joint__transmission_compliance=COMPLIANCE, torque__actuator_delay=0.03)
    world = World(Pendulum(), [*effects], PERIOD, substeps=2)
    states, read = rows(world)
    time = torch.full((1,), row * PERIOD, dtype=torch.float64)
    at = world.start(states[None, row], time, TORQUES[None, :, None], states[None])
    torch.testing.assert_close(world.measure(at)[0], read[None, row])


@pytest.mark.parametrize(
    "others", [{}, {"torque__actuator_delay": 0.03}, {"torque__actuator_gain": 0.8}, {"joint__viscous_friction": 0.02}]
)
def test_a_fit_finds_it_beside_another_effect(others):
    truth = [*made(joint__transmission_compliance=COMPLIANCE, **others)]
    time = PERIOD * torch.arange(120, dtype=torch.float64)
    torques = 0.8 * (3 * time).sin() + 0.8 * (9 * time).sin()
    read = rows(World(Pendulum(), truth, PERIOD, substeps=4).double(), torques)[1][:-1].detach()
    noise = torch.randn(read.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    start = [*made(**dict.fromkeys(others, 0.01), joint__transmission_compliance=0.0)]
    fit = fit_effects(Pendulum(), start, [read + noise * 1e-4], [torques[:, None]], PERIOD)
    for effect in truth:
        name = effect.table[0].name
        assert fit.values[type(effect)].item() == pytest.approx(getattr(effect, name).item(), rel=0.02)
