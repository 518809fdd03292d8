"""Stretches in which a joint is held, or its sensor is dead: their rows are left out."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from visadapt.diagnosis import diagnose
from visadapt.diagnosis.search.held_joints import without_held_joints
from visadapt.effects import ActuatorGain, CoulombFriction, FrozenZone, PoleSpring, StribeckFriction, ViscousFriction
from visadapt.recordings import Episode, Recording
from visadapt.systems import CartPole
from visadapt.world import World

PERIOD, ROWS, BEFORE = 0.02, 500, 50
GAINS = torch.tensor([0.08, 0.12, 1.3, 0.3], dtype=torch.float64)
NOISE = 1e-3


def balanced(effects=(), seed=0, resting=None, stop=0.4):
    """A cart-pole under feedback, whose motor is off in the rows `resting`, in which the pole falls on a stop; whoever
    then puts it upright lets go of it at rest."""
    world = World(CartPole(), [effect.double() for effect in effects], period=PERIOD, substeps=4)
    rng, rows, dither = np.random.default_rng(seed), [], 0.0
    now = world.start(torch.tensor([[0.1, 0, 0.02, 0]]).double())
    for row in range(ROWS):
        if row % 5 == 0:
            dither = rng.uniform(-0.1, 0.1)
        off = resting is not None and row in range(*resting)
        command = 0.0 if off else float(np.clip(float(now.state[0] @ GAINS) + dither, -1, 1))
        rows.append([*now.state[0, [0, 2]].tolist(), command])
        with torch.no_grad():
            now = world.step(now, torch.tensor([[command]]).double())
        if off and abs(float(now.state[0, 2])) > stop:
            x, _, theta, _ = now.state[0].tolist()
            now = replace(now, state=torch.tensor([[x, 0.0, np.sign(theta) * stop, 0.0]]).double())
        if resting is not None and row == resting[1] - 1:
            now = replace(now, state=torch.tensor([[float(now.state[0, 0]), 0, 0.01, 0]]).double())
    table = np.array(rows)
    state = table[:, :2] + NOISE * rng.normal(size=(ROWS, 2))
    return Recording((Episode(PERIOD * np.arange(ROWS), table[:, 2:], state),), ("x", "theta"), PERIOD, ("run.csv",))


def with_readings(recording, column, first, value=None):
    """The recording with a sensor that reads `value`, or its last reading, from row `first` on."""
    (episode,) = recording.episodes
    state = np.array(episode.state)
    state[first:, column] = state[first, column] if value is None else value
    return replace(recording, episodes=(replace(episode, state=state),))


def test_a_pole_that_fell_on_a_stop_hides_no_cause():
    recording = balanced([ViscousFriction(coefficient=2.0)], resting=(350, ROWS))
    (kept,) = without_held_joints(recording, CartPole(), BEFORE).episodes
    assert 330 < len(kept.time) < 385
    found = diagnose(recording, World(CartPole()), [ViscousFriction, ActuatorGain, PoleSpring])
    assert (found.verdict, [cause.effect for cause in found.causes]) == ("identified", ["viscous_friction"])
    low, high = found.causes[0].parameters["coefficient"].ci90
    assert low < 2.0 < high
    assert any("theta stands still at" in told and "as on a stop or in a hand" in told for told in found.warnings)


def test_both_sides_of_a_stretch_are_used():
    recording = balanced(resting=(200, 320))
    before, after = without_held_joints(recording, CartPole(), BEFORE).episodes
    assert 200 < len(before.time) < 270
    assert 6.2 < after.time[BEFORE] < 7.4  # s: led by rows of which the commands alone are used
    assert after.time[-1] == recording.episodes[0].time[-1]


@pytest.mark.parametrize("column", [0, 1])
def test_a_dead_sensor_is_said_and_its_rows_are_left_out(column):
    recording = with_readings(balanced([ViscousFriction(coefficient=2.0)]), column, 300)
    result = without_held_joints(recording, CartPole(), BEFORE)
    assert [len(episode.time) for episode in result.episodes] == [300]
    (told,) = result.warnings
    assert told.startswith(f"run.csv: from 6 to 9.96 s {('x', 'theta')[column]} reads")
    assert "its sensor is dead" in told


@pytest.mark.parametrize(
    "effects",
    [
        (),
        (CoulombFriction(force=6.0),),
        (StribeckFriction(force=2.0, breakaway=5.0, velocity=0.1),),
        (ActuatorGain(scale=0.3),),
        (PoleSpring(stiffness=0.6),),
        (PoleSpring(stiffness=2.0),),  # under which it tilts to 0.7 rad, and stays there
        (FrozenZone(start=0.0, end=0.05),),
    ],
    ids=lambda effects: ", ".join(effect.name for effect in effects) or "nothing",
)
@pytest.mark.parametrize("resolution", [None, 2e-3])
def test_what_an_effect_holds_is_kept(effects, resolution):
    recording = balanced(effects)
    if resolution is not None:
        (episode,) = recording.episodes
        episode = replace(episode, state=np.round(episode.state / resolution) * resolution)
        recording = replace(recording, episodes=(episode,))
    assert without_held_joints(recording, CartPole(), BEFORE) is recording
