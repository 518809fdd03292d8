"""The source policies that are shipped: they fly in the source, and a few hundred samples adapt them."""

import math

import pytest
import torch

from datasets import quadrotor_references
from experiments.flights import flight_target
from tests.coarse import coarse_targets
from tests.flying import drag, trained_as
from visadapt.effects import MotorLag, PeriodicForce
from visadapt.evaluation import score
from visadapt.history import History
from visadapt.setups.flight import fixed_wing, quadrotor
from visadapt.systems import Quadrotor
from visadapt.systems.rigid_body import POSITION, VELOCITY
from visadapt.targets.rotorpy import SOURCE
from visadapt.tasks.follow import Follow
from visadapt.tasks.references import Reference
from visadapt.weights import shipped
from visadapt.world import World

SECONDS = 3.0


@pytest.fixture(scope="module", autouse=True)
def coarse():
    with coarse_targets(0.02):
        yield


def shortened(references, seconds=SECONDS):
    """Their first seconds: every step of a flight costs time here."""
    rows = round(seconds / references.period) + 1
    return Reference.of(references.motion[:, :, :rows], references.period)


@pytest.fixture(scope="module")
def whole():
    settings = quadrotor_references.Settings(train=30, test=20, seed=7)  # the policies were trained on seed 0
    return quadrotor_references.make(settings)


@pytest.fixture(scope="module")
def references(whole):
    train, test = whole
    return shortened(train), shortened(test)


def test_the_quadrotor_stays_within_3_cm_of_references_it_was_not_trained_on(references):
    setup = quadrotor(*references)
    found = score(setup.load(shipped("quadrotor")), flight_target(setup), 20, 0)
    assert found.failed == 0
    assert found.mean < 0.03


def test_thrown_far_off_its_reference_the_quadrotor_comes_back(whole):
    """Its body rates are limited: one that leans by all of such an error swings further each time, and is lost."""
    setup = quadrotor(*whole)
    policy, task, generator = setup.load(shipped("quadrotor")), setup.test, torch.Generator().manual_seed(0)
    assert isinstance(task, Follow)
    state, task_state = task.evaluation_start(20, generator)
    for part, size in ((POSITION, 2.0), (VELOCITY, 2.0)):
        away = torch.randn(20, 3, generator=generator)
        state[:, part] += size * away / away.norm(dim=1, keepdim=True)
    at, history = setup.source.start(state), History.start(task.show(state, task_state), 4)
    with torch.no_grad():
        for _ in range(task.steps):
            action = policy.act(history)
            at, task_state = setup.source.step(at, action), task.advance(task_state)
            history = history.acting(action).observing(task.show(at.state, task_state))
    assert task.distance_off(at.state, task_state).max() < 0.2


def test_where_motors_lag_and_the_rate_loop_is_slow_the_quadrotor_still_flies(whole):
    """One that answers small errors strongly swings up: on rotorpy's Crazyflie without air it then lost 4 of 5."""
    train, test = (shortened(references, 5.0) for references in whole)
    slow = quadrotor(train, test, World(SOURCE, period=train.period, substeps=2))
    lagging = flight_target(slow, lambda batch, generator: (MotorLag(time_constant=0.05),))
    found = score(slow.load(shipped("quadrotor")), lagging, 20, 0)
    assert found.failed == 0
    assert found.mean < 0.04


def test_200_samples_of_a_drag_lower_its_error_by_half_or_more(references, tmp_path):
    setup = quadrotor(*references)
    policy, dragged = setup.load(shipped("quadrotor")), flight_target(setup, drag(0.3))
    before = score(policy, dragged, 20, 0)
    brief = trained_as(setup, iterations=25, learning_rate=1e-3, batch=32)
    adapted = brief.adapt(policy, flight_target(setup, drag(0.3), test=False), tmp_path, 200, 200, seed=0)
    after = score(policy, dragged, 20, 0)
    assert adapted.ledger.used == 200
    assert after.mean < 0.5 * before.mean
    assert after.failed == 0


def test_200_samples_of_a_force_that_changes_lower_its_error_by_half_or_more(references, tmp_path):
    """Another phase in each flight: only who reads the past can know it; in Euler's steps, which suffice for that."""

    def swaying(batch, generator):
        phase = math.pi * (2 * torch.rand(batch, generator=generator) - 1)
        return (PeriodicForce(amplitude=1.0, frequency=0.16, phase=phase, offset=0.0),)

    source = World(Quadrotor(), period=references[0].period, integrator="euler", substeps=2)
    setup = quadrotor(references[0], references[1], source, with_history=True)
    policy, pushed = setup.load(shipped("quadrotor")), flight_target(setup, swaying)
    before = score(policy, pushed, 20, 0)
    brief = trained_as(setup, iterations=60, learning_rate=2e-3, batch=32)
    brief.adapt(policy, flight_target(setup, swaying, test=False), tmp_path, 200, 200, seed=0)
    after = score(policy, pushed, 20, 0)
    assert after.mean < 0.5 * before.mean
    assert after.failed == 0


def test_the_wing_passes_its_points_within_half_a_metre():
    setup = fixed_wing()
    found = score(setup.load(shipped("fixed_wing")), flight_target(setup), 20, 0)
    assert found.failed == 0
    assert found.mean < 0.5
