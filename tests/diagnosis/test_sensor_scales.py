"""Sensors with a wrong scale, where the velocity is read by the same sensor as the position, by another, or not."""

import numpy as np
import pytest
import torch

from tests.own_systems import Pendulum
from visadapt.diagnosis import diagnose
from visadapt.diagnosis.search.searched_effects import shown_by
from visadapt.effects.catalogue import catalogue
from visadapt.effects.sensing import SensorGain
from visadapt.recordings import Episode, Recording
from visadapt.world import World

PERIOD, ROWS = 0.03, 300
BY_NAME = {effect.name: effect for effect in catalogue(Pendulum())}


def recorded(effect, measured):
    """A pendulum whose torque wanders, read with the sensors of an effect."""
    world, generator = World(Pendulum(), [effect], PERIOD), torch.Generator().manual_seed(0)
    at, read, torques = world.start(torch.tensor([[0.5, 0.0]], dtype=torch.float64)), [], []
    for row in range(ROWS):
        torque = torch.tensor([[0.4 * np.sin(1.9 * PERIOD * row) + 0.3 * np.sin(5.3 * PERIOD * row)]])
        shown, at = world.measure(at, generator)
        noise = torch.tensor([1e-3, 2e-2]) * torch.randn(2, generator=generator)
        read.append((shown[0] + noise).detach()[: len(measured)])
        torques.append(torque[0])
        at = world.step(at, torque)
    episode = Episode(PERIOD * np.arange(ROWS), torch.stack(torques).numpy(), torch.stack(read).numpy())
    return Recording((episode,), measured, PERIOD, ("pendulum",))


@pytest.mark.parametrize(
    ("hidden", "measured"),
    [
        ("angle.sensor_scale", ("angle", "rate")),
        ("angle.position_scale", ("angle", "rate")),
        ("rate.sensor_scale", ("angle", "rate")),
        ("angle.sensor_scale", ("angle",)),
    ],
)
def test_the_sensor_is_named_and_its_scale_found(hidden, measured):
    found = diagnose(recorded(BY_NAME[hidden](scale=1.1), measured), World(Pendulum(), (), PERIOD))
    assert (found.verdict, [cause.effect for cause in found.causes]) == ("identified", [hidden])
    assert found.causes[0].parameters["scale"].value == pytest.approx(1.1, abs=0.01)


@pytest.mark.parametrize(
    ("read", "scales"),
    [
        ([0, 1], ["angle.sensor_scale", "angle.position_scale", "rate.sensor_scale"]),
        ([0], ["angle.sensor_scale"]),
        ([1], ["rate.sensor_scale"]),
    ],
)
def test_a_scale_is_searched_of_sensors_that_were_read(read, scales):
    shown = shown_by(catalogue(Pendulum()), set(read))
    assert [effect.name for effect in shown if issubclass(effect, SensorGain)] == scales
