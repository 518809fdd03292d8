"""The source policies that are shipped: they fly in the source, and a few hundred samples adapt them."""

import dataclasses
import math
from pathlib import Path

import pytest
import torch

from datasets import quadrotor_references
from tests.flying import drag
from visadapt.effects import PeriodicForce
from visadapt.setups.flight import TrainSettings, fixed_wing, quadrotor, score
from visadapt.tasks.courses import AlongReferences
from visadapt.tasks.references import Reference

ASSETS = Path(__file__).parents[2] / "assets"
SECONDS = 3.0


def shortened(references):
    """Their first seconds: every step of a flight costs time here."""
    rows = round(SECONDS / references.period) + 1
    whole = (references.positions, references.velocities, references.accelerations, references.jerks)
    return AlongReferences(Reference.of(torch.stack([part[:, :rows] for part in whole]), references.period))


def shipped(flight):
    """The policy of the assets: without this check, one that is missing would be trained and written there."""
    path = ASSETS / f"{flight.system.name}.safetensors"
    assert path.exists(), f"{path} is missing: python -m train.flight_policies"
    return flight.pretrain(path, 0)


@pytest.fixture(scope="module")
def flight():
    settings = quadrotor_references.Settings(train=30, test=20, seed=7)  # the policies were trained on seed 0
    return quadrotor(*(shortened(each) for each in quadrotor_references.make(settings)))


def test_the_quadrotor_stays_within_3_cm_of_references_it_was_not_trained_on(flight):
    policy = shipped(flight)
    found = score(flight.target(), policy, 0, 20)
    assert found.failed == 0
    assert found.mean < 0.03


def test_200_samples_of_a_drag_lower_its_error_by_half_or_more(flight, tmp_path):
    policy = shipped(flight)
    dragged = flight.target(drag(0.3))
    before = score(dragged, policy, 0, 20)
    flight.settings = dataclasses.replace(flight.settings, tuning=TrainSettings(40, 1e-3, batch=64))
    adapted = flight.adapt(policy, flight.target(drag(0.3), test=False), tmp_path, 200, 200, seed=0)
    after = score(dragged, policy, 0, 20)
    assert adapted.ledger.used == 200
    assert after.mean < 0.5 * before.mean
    assert after.failed == 0


def test_200_samples_of_a_force_that_changes_lower_its_error_by_half_or_more(flight, tmp_path):
    """Another phase in each flight: only who reads the past can know it."""

    def swaying(batch, generator):
        phase = math.pi * (2 * torch.rand(batch, generator=generator) - 1)
        return (PeriodicForce(amplitude=1.0, frequency=0.16, phase=phase, offset=0.0),)

    policy = shipped(flight)
    before = score(flight.target(swaying), policy, 0, 20)
    flight.settings = dataclasses.replace(flight.settings, recovering=TrainSettings(60, 2e-3, batch=64))
    flight.adapt(policy, flight.target(swaying, test=False), tmp_path, 200, 200, seed=0, with_history=True)
    after = score(flight.target(swaying), policy, 0, 20)
    assert after.mean < 0.5 * before.mean
    assert after.failed == 0


def test_the_wing_passes_its_points_within_half_a_metre():
    flight = fixed_wing()
    found = score(flight.target(), shipped(flight), 0, 20)
    assert found.failed == 0
    assert found.mean < 0.5
