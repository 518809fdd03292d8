"""A machine whose velocities jump, each by itself; a jump takes back a part of the one before."""

import numpy as np
import pytest
import torch

from tests.diagnosed import GAINS, record
from visadapt import diagnose
from visadapt.diagnosis.search.coloured import colour_left_by
from visadapt.diagnosis.search.jumps import with_jumps
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.search.search import Search
from visadapt.effects import ActuatorGain, CoulombFriction, PeriodicForce, ViscousFriction
from visadapt.recordings import Episode, Recording
from visadapt.systems import CartPole
from visadapt.world import World

CATALOGUE = [ViscousFriction, CoulombFriction, ActuatorGain]


@pytest.fixture(scope="module")
def jumping():
    """Four episodes of 150 rows, with viscous friction of 0.7 N s/m."""
    generator, world = torch.Generator().manual_seed(0), World(CartPole(), [ViscousFriction(coefficient=0.7)])
    state, jump, states, commands = torch.zeros(4, 4, dtype=torch.float64), torch.zeros(4, 2), [], []
    for _ in range(150):
        drawn = torch.randn(4, 3, generator=generator, dtype=torch.float64)
        jump = 0.1 * drawn[:, :2] - 0.6 * jump
        states.append(state)
        commands.append((state @ GAINS[:, None] + 0.1 * drawn[:, 2:]).clamp(-1, 1))
        with torch.no_grad():
            state = world.step(world.start(state), commands[-1]).state
        state[:, [1, 3]] += jump
    true = torch.stack(states, 1)[..., [0, 2]]
    seen = (true + 1e-4 * torch.randn(true.shape, generator=generator, dtype=torch.float64)).numpy()
    given, time = torch.stack(commands, 1).numpy(), 0.05 * np.arange(150)
    return Recording(tuple(Episode(time, given[k], seen[k]) for k in range(4)), ("x", "theta"), 0.05, ("",) * 4)


def search_of(recording):
    return Search(CartPole(), prepare(recording, CartPole()).rows, CATALOGUE)


def test_it_is_searched_with_jumps_that_are_not_white(jumping):
    with_loads = search_of(jumping)
    search = with_jumps(with_loads)
    assert search.rows.jumps
    assert with_loads.best.names in [each.names for each in search.ranked], "what explains loads was not tried"
    assert colour_left_by(search, search.best) is not None


def test_one_that_loads_disturb_is_not():
    recording = record([PeriodicForce(amplitude=4.0, frequency=3.3, phase=0.3, offset=0.0)], rows=100)
    assert with_jumps(search_of(recording)) is None


def test_its_friction_is_found(jumping):
    found = diagnose(jumping, World(CartPole()), catalogue=CATALOGUE)
    assert found.verdict == "unexplained"
    causes = {cause.effect: cause for cause in found.partial if not cause.slight}
    assert list(causes) == ["viscous_friction"]
    coefficient = causes["viscous_friction"].parameters["coefficient"]
    assert coefficient.ci90[0] < 0.7 < coefficient.ci90[1]
    assert coefficient.value == pytest.approx(0.7, rel=0.3)
