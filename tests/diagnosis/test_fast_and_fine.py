"""Machines that are fast within a row, that are small in SI units, or whose states have no position."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch

import visadapt as va
from tests.cylinder import Cylinder
from tests.own_systems import DoublePendulum
from visadapt.estimation.integration_step import with_longest_step
from visadapt.estimation.segments import cut
from visadapt.systems import System, Variable
from visadapt.world import World


@dataclass(frozen=True)
class Magnet(System):
    """A ball held below a magnet by its current, which is the command."""

    mass: float | torch.Tensor = 0.05  # kg
    pull: float | torch.Tensor = 4e-5  # N m2/A2

    name = "magnet"
    prediction_time = 0.05
    states: ClassVar[tuple[Variable, ...]] = (Variable("gap", "m", 0.002, 0.02), Variable("speed", "m/s", -0.5, 0.5))
    actions: ClassVar[tuple[Variable, ...]] = (Variable("current", "A", 0.0, 4.0),)
    loads: ClassVar[tuple[Variable, ...]] = (Variable("ball", "N", -0.2, 0.2),)
    coordinates = ((0, 1),)

    def derivative(self, state, command, load):
        gap, speed = state.unbind(-1)
        attraction = self.pull * (command[:, 0] / gap) ** 2
        return torch.stack((speed, 9.81 + (load[:, 0] - attraction) / self.mass), -1)


@dataclass(frozen=True)
class Tank(System):
    """A tank that a pump fills and that runs out through a hole."""

    area: float | torch.Tensor = 0.02  # m2

    name = "tank"
    prediction_time = 60.0
    states: ClassVar[tuple[Variable, ...]] = (Variable("level", "m", 0.02, 1.0),)
    actions: ClassVar[tuple[Variable, ...]] = (Variable("pump", "V", 0.0, 12.0),)
    loads: ClassVar[tuple[Variable, ...]] = (Variable("inflow", "m3/s", -1e-4, 1e-4),)
    coordinates = ((None, 0),)

    def derivative(self, state, command, load):
        outflow = 1.2e-4 * (2 * 9.81 * state[:, 0].clamp(min=1e-3)).sqrt()
        return ((4.5e-5 * command[:, 0] + load[:, 0] - outflow) / self.area)[:, None]


def recorded(system, period, first, control, rows, noise, episodes=2, effects=()):
    """Recordings of a machine with `effects` under `control` (row, state, generator) -> commands, integrated in steps
    of a 40th of the period."""
    world, generator, out = (
        World(system, effects, period, substeps=40).requires_grad_(False),
        torch.Generator().manual_seed(0),
        [],
    )
    for _ in range(episodes):
        at = world.start(torch.tensor([first], dtype=torch.float64))
        states, actions = [], []
        for row in range(rows):
            action = torch.tensor([control(row, at.state[0], generator)], dtype=torch.float64)
            states.append(at.state[0])
            actions.append(action[0])
            at = world.step(at, action)
        state, action = torch.stack(states), torch.stack(actions)
        state = state + torch.tensor(noise) * torch.randn(state.shape, generator=generator, dtype=torch.float64)
        out.append(va.Episode(time=period * np.arange(rows), action=action.numpy(), state=state.numpy()))
    return out


def diagnosed(tmp_path, system, episodes):
    names = [variable.name for variable in system.states]
    va.write_recording(tmp_path / "run.h5", episodes, names)
    recording = va.load_recording(tmp_path / "run.h5", system)
    return va.diagnose(recording, World(system, (), recording.period))


def sway(row, state, generator):
    return 0.5 * np.sin(0.2 * row), 0.0


def test_the_source_s_own_integration_is_no_cause(tmp_path):
    system = DoublePendulum()
    episodes = recorded(system, 0.04, [1.2, 1.0, 0.0, 0.0], sway, 100, [2e-4, 2e-4, 2e-3, 2e-3])
    assert max(np.abs(episode.state[:, 3]).max() for episode in episodes) > 10
    found = diagnosed(tmp_path, system, episodes)
    assert found.verdict == "no_gap"


def hold(row, state, generator):
    gap, speed = state.tolist()
    balance = gap * (0.05 * 9.81 / 4e-5) ** 0.5
    wanted = 0.01 + 0.001 * np.sin(0.1 * row)
    noise = 0.02 * float(torch.randn((), generator=generator))
    return (np.clip(balance + 600 * (gap - wanted) + 12 * speed + noise, 0, 4),)


def test_a_small_machine_s_mass_is_found_to_a_thousandth(tmp_path):
    episodes = recorded(replace(Magnet(), mass=0.05 * 1.005), 0.002, [0.01, 0.0], hold, 400, [1e-5, 2e-3])
    found = diagnosed(tmp_path, Magnet(), episodes)
    assert found.verdict in ("identified", "ambiguous")
    scales = {cause.effect: cause.parameters["scale"].value for cause in found.causes if "scale" in cause.parameters}
    assert abs(scales["mass.scale"] - 1.005) < 5e-4
    # Only the ratio of the two moves the ball.
    assert "no motion tells another mass from another pull: measure mass by itself" in found.next_experiment


def fill(row, state, generator):
    return (5.0 + 4.0 * np.sin(0.02 * row) + 2.0 * (row // 25 % 2),)


def test_a_level_s_sensor_may_have_another_scale(tmp_path):
    episodes = recorded(Tank(), 4.0, [0.3], fill, 300, [2e-3], episodes=1)
    read = [replace(episode, state=1.1 * episode.state) for episode in episodes]
    found = diagnosed(tmp_path, Tank(), read)
    assert [cause.effect for cause in found.causes] == ["level.sensor_scale"]
    assert abs(found.causes[0].parameters["scale"].value - 1.1) < 0.005


def test_only_a_fast_motion_is_integrated_in_shorter_steps():
    def longest(factor):
        generator = torch.Generator().manual_seed(0)
        state = factor * torch.randn(40, 4, generator=generator, dtype=torch.float64)
        clock, commands = 0.04 * torch.arange(40.0).double(), torch.zeros(40, 2).double()
        rows = cut([state], [torch.ones_like(state)], [commands], [clock], (0, 1, 2, 3), 0.04, 40)
        return with_longest_step(rows, DoublePendulum()).longest_step

    assert longest(0.1) == float("inf")
    assert longest(5.0) < 0.011


@dataclass(frozen=True)
class Winding(System):
    """A motor whose current follows the voltage within a few rows."""

    inertia: float | torch.Tensor = 5e-4  # kg m2
    constant: float | torch.Tensor = 0.06  # N m/A
    resistance: float | torch.Tensor = 1.5  # ohm
    inductance: float | torch.Tensor = 0.03  # H

    name = "winding"
    states: ClassVar[tuple[Variable, ...]] = (Variable("speed", "rad/s", -250, 250), Variable("current", "A", -10, 10))
    actions: ClassVar[tuple[Variable, ...]] = (Variable("voltage", "V", -12.0, 12.0),)
    loads: ClassVar[tuple[Variable, ...]] = (Variable("shaft", "N m", -0.4, 0.4),)
    coordinates = ((None, 0),)

    def derivative(self, state, command, load):
        speed, current = state.unbind(-1)
        turns = (self.constant * current + load[:, 0]) / self.inertia
        drop = self.resistance * current + self.constant * speed
        return torch.stack((turns, (command[:, 0] - drop) / self.inductance), -1)


def steps_of_voltage(row, state, generator):
    return (8.0 * np.sign(np.sin(0.9 * (row // 16) ** 2 + 0.5)) * (0.3 + 0.7 * ((row // 16) % 5) / 4),)


def test_a_lag_of_two_rows_is_found_as_exactly_as_longer_ones():
    """With the mean of what acts over whole rows, it came out 1.2 % short."""
    lag = {effect.name: effect for effect in va.catalogue(Winding())}["voltage.actuator_lag"]
    episodes = recorded(Winding(), 0.005, [0.0, 0.0], steps_of_voltage, 500, [0.2, 0.03], 1, [lag(time_constant=0.01)])
    recording = va.Recording(tuple(episodes), ("speed", "current"), 0.005, ("run.csv",))
    found = va.diagnose(recording, va.World(Winding(), period=0.005), [lag])
    assert abs(found.causes[0].parameters["time_constant"].value - 0.01) < 5e-5


def steps_of_a_valve(row, state, generator):
    return (np.random.default_rng(row // 15).uniform(-0.4, 0.4),)


def test_a_valve_that_lags_is_not_a_command_that_came_too_early():
    """The commands came out 2.6 ms early and the lag 3 % long: sets without the lag were fitted to them as they are."""
    words = "scale", "delay", "lag", "added"
    catalogue = [effect for effect in va.catalogue(Cylinder()) if any(word in effect.name for word in words)]
    lag = next(effect for effect in catalogue if effect.name == "valve.actuator_lag")
    noise, effects = [2e-4, 3e-3, 0.02], [lag(time_constant=0.03)]
    episodes = recorded(Cylinder(), 0.01, [0.0, 0.0, 0.0], steps_of_a_valve, 150, noise, 1, effects)
    recording = va.Recording(tuple(episodes), ("x", "v", "p"), 0.01, ("run.csv",))
    found = va.diagnose(recording, va.World(Cylinder(), period=0.01), catalogue)
    assert (found.verdict, [cause.effect for cause in found.causes]) == ("identified", [lag.name])
    assert abs(found.causes[0].parameters["time_constant"].value - 0.03) < 6e-4
    assert not any("before the rows" in warning for warning in found.warnings)
