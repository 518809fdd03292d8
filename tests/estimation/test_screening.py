"""Which effects the screening proposes, and with which parameters, where an effect is not proportional to them."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.diagnosed import record
from tests.own_systems import Pendulum
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.search.search import Search
from visadapt.effects import EFFECTS, PeriodicForce
from visadapt.effects.catalogue import catalogue
from visadapt.estimation.screening import screen
from visadapt.recordings import Episode, Recording
from visadapt.systems import CartPole
from visadapt.world import World

SYSTEM = CartPole()


def screened(effect, value):
    """The value that is proposed for the one strength of an effect that is hidden with `value`."""
    recording = record([effect(**{effect.table[0].name: value})])
    search = Search(SYSTEM, prepare(recording, SYSTEM).rows, ())
    return screen(SYSTEM, (), search.source.fits, search.rows, [effect])[0].values[0]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("actuator_saturation", 0.17),
        ("actuator_deadzone", 0.055),
        ("actuator_backlash", 0.035),
        ("actuator_lag", 0.035),
        ("cart_mass", 1.3),
        ("track_tilt", 0.02),
        ("coulomb_friction", 0.6),
    ],
)
def test_a_strength_between_the_points_of_its_grid_is_found(name, value):
    assert screened(EFFECTS[name], value) == pytest.approx(value, rel=0.06)


def test_a_limit_that_only_the_largest_commands_reach_is_found():
    largest = max(float(abs(episode.action).max()) for episode in record().episodes)
    limit = 0.85 * largest
    assert screened(EFFECTS["actuator_saturation"], limit) == pytest.approx(limit, rel=0.06)


FREQUENCIES = (0.06, 0.31, 1.03, 1.6, 2.3, 4.7)  # Hz


@pytest.fixture(scope="module")
def shaken():
    """Three episodes at each of FREQUENCIES, simulated side by side."""
    each = torch.tensor(FREQUENCIES, dtype=torch.float64).repeat_interleave(3)
    return record([PeriodicForce(amplitude=0.8, frequency=each, phase=2.0, offset=0.0)], len(each), 400)


@pytest.mark.parametrize(
    ("frequency", "episodes"), [(0.06, 1), (0.31, 1), (1.6, 1), (4.7, 1), (0.06, 3), (1.03, 3), (2.3, 3)]
)
def test_a_frequency_between_the_points_of_any_coarse_grid_is_found(frequency, episodes, shaken):
    first = 3 * FREQUENCIES.index(frequency)
    own = slice(first, first + episodes)
    recording = dataclasses.replace(shaken, episodes=shaken.episodes[own], sources=shaken.sources[own])
    search = Search(SYSTEM, prepare(recording, SYSTEM).rows, ())
    found = screen(SYSTEM, (), search.source.fits, search.rows, [PeriodicForce])[0].values[1]
    assert found == pytest.approx(frequency, abs=0.25 / 20)  # of 20 s


def test_the_frequency_of_a_torque_on_a_system_of_one_s_own_is_found():
    system = Pendulum()
    load = next(effect for effect in catalogue(system) if effect.name.endswith("periodic_load"))
    table = {parameter.name: parameter.neutral or 0.0 for parameter in load.table}
    hidden = load(**table | {load.table[0].name: 0.1, "frequency": 1.7, "phase": 0.3}).double()
    world, generator = World(system, [hidden], 0.02, substeps=5), torch.Generator().manual_seed(0)
    at, states, commands = world.start(torch.zeros(1, 2, dtype=torch.float64)), [], []
    for _ in range(600):
        states.append(at.state[0] + 0.002 * torch.randn(2, generator=generator))
        commands.append(0.3 * torch.randn(1, generator=generator, dtype=torch.float64))
        with torch.no_grad():
            at = world.step(at, commands[-1][None])
    episode = Episode(0.02 * np.arange(600), torch.stack(commands).numpy(), torch.stack(states).numpy())
    recording = Recording((episode,), ("angle", "rate"), 0.02, ("run",))
    search = Search(system, prepare(recording, system).rows, ())
    found = screen(system, (), search.source.fits, search.rows, [load])[0].values
    assert found[[parameter.name for parameter in load.table].index("frequency")] == pytest.approx(1.7, abs=0.02)
