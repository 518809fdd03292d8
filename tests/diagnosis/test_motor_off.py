"""Commands that are logged on after the motor was switched off: the rows of this end are left out."""

import numpy as np
import pytest
import torch

from visadapt.diagnosis import diagnose
from visadapt.diagnosis.search.motor_off import without_idle_ends
from visadapt.effects import ActuatorGain, CoulombFriction, Gust, ViscousFriction
from visadapt.recordings import Episode, Recording
from visadapt.systems import CartPole
from visadapt.world import World

PERIOD, ROWS, OFF = 0.02, 300, 260
GAINS = torch.tensor([0.08, 0.12, 1.3, 0.3], dtype=torch.float64)


def logged(effects, off=ROWS):
    """A cart-pole under feedback, whose motor gets nothing from row `off` on."""
    world = World(CartPole(), [effect.double() for effect in effects], period=PERIOD, substeps=4)
    rng, now, rows, dither = np.random.default_rng(0), world.start(torch.tensor([[0.1, 0, 0.02, 0]]).double()), [], 0.0
    for row in range(ROWS):
        if row % 5 == 0:
            dither = rng.uniform(-0.1, 0.1)
        command = float(np.clip(float(now.state[0] @ GAINS) + dither, -1, 1))
        rows.append([*(now.state[0, [0, 2]] + 1e-3 * torch.from_numpy(rng.normal(size=2))).tolist(), command])
        with torch.no_grad():
            now = world.step(now, torch.tensor([[command if row < off else 0.0]]).double())
    table = np.array(rows)
    episode = Episode(PERIOD * np.arange(ROWS), table[:, 2:], table[:, :2])
    return Recording((episode,), ("x", "theta"), PERIOD, ("run.csv",))


def test_the_end_is_left_out_and_what_acts_before_it_is_named():
    recording = logged([ViscousFriction(coefficient=2.0)], OFF)
    (episode,) = without_idle_ends(recording, CartPole()).episodes
    assert OFF - 30 < len(episode.time) <= OFF + 5
    found = diagnose(recording, World(CartPole()), [ViscousFriction, ActuatorGain, Gust])
    assert (found.verdict, [cause.effect for cause in found.causes]) == ("identified", ["viscous_friction"])
    low, high = found.causes[0].parameters["coefficient"].ci90
    assert low < 2.0 < high
    assert any("its commands do not act, as where a motor is switched off" in said for said in found.warnings)


@pytest.mark.parametrize(
    "effects",
    [(), (CoulombFriction(force=6.0),), (ActuatorGain(scale=0.3),), (Gust(start=4.0, end=5.0, force=8.0),)],
    ids=["nothing", "dry friction", "a weak motor", "a gust"],
)
def test_a_motor_that_acts_to_the_end_is_not_called_off(effects):
    recording = logged(effects)
    assert without_idle_ends(recording, CartPole()) is recording
