"""A motor that turns a disc: loads and errors of readings by the angle within a turn, and what acts between the two."""

from functools import cache

import numpy as np
import pytest
import torch

import visadapt as va
from tests.own_systems import Drive
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.search.pushes import pushes
from visadapt.diagnosis.search.search import Search
from visadapt.diagnosis.verdict import left_by_source
from visadapt.effects.catalogue import catalogue
from visadapt.recordings import Episode, Recording

PERIOD, ROWS = 0.01, 400
ENCODER = 2 * np.pi / 8192  # rad, a step of the motor's angle
PUSHED, PUSH = (1, 1.5, 0.08), 0.006
"""A push of the motor: the episode, its middle and its deviation in s; its peak in N m."""


def cogging(state):
    """Loads (B, 2) of a motor whose magnets hold it at eight angles of a turn."""
    load = -0.012 * (8 * state[:, 0]).sin()
    return torch.stack((load, torch.zeros_like(load)), -1)


ZEROS = torch.tensor([0.0, 1.1, 2.5, 0.7], dtype=torch.float64)
"""Angles, rad, at which an encoder that counts from 0 in every run began to count."""


def cogging_from_zeros(state):
    """The same, of the angles that such an encoder reads."""
    return cogging(state + ZEROS[:, None] * torch.eye(4, dtype=torch.float64)[0])


def play(state):
    """Loads (B, 2) that undo the coupling's torque within 0.04 rad."""
    lost = 0.15 * (state[:, 0] - state[:, 1]).clamp(-0.04, 0.04)
    return torch.stack((lost, -lost), -1)


def nothing(state):
    """No loads, (B, 2)."""
    return torch.zeros_like(state[:, :2])


@cache
def recorded(acting, push=0.0, eccentric=0.0):
    """Four runs of 4 s of a drive with loads `acting` by its states, a push of the motor, and a disc whose encoder is
    `eccentric` rad off once in a turn."""
    generator = np.random.default_rng(3)
    time = PERIOD * np.arange(ROWS)
    speeds, phases = generator.uniform(2.5, 16.0, (4, 3)), generator.uniform(0, 6.3, (4, 3))
    command = 0.05 * np.sin(speeds[:, :, None] * time + phases[:, :, None]).sum(1)
    state, states = torch.zeros(4, 4, dtype=torch.float64), []
    for row in range(ROWS):
        states.append(state)
        pushed = torch.zeros(4, 2, dtype=torch.float64)
        episode, middle, width = PUSHED
        pushed[episode, 0] = push * np.exp(-0.5 * ((time[row] - middle) / width) ** 2)
        for _ in range(20):
            half = state + PERIOD / 40 * rate(state, command[:, row], acting, pushed)
            state = state + PERIOD / 20 * rate(half, command[:, row], acting, pushed)
    angles = torch.stack(states, 1)[..., :2].numpy()
    angles[..., 1] += eccentric * np.cos(angles[..., 1] + 0.5)
    angles = np.round(angles / ENCODER) * ENCODER
    episodes = tuple(Episode(time, command[k, :, None], angles[k]) for k in range(4))
    return Recording(episodes, ("motor", "disc"), PERIOD, ("a", "b", "c", "d"))


def rate(state, torque, acting, pushed):
    return Drive().derivative(state, torch.from_numpy(torque)[:, None], acting(state) + pushed)


@cache
def left(acting, push=0.0):
    """What the source leaves unexplained of these runs."""
    with torch.inference_mode():
        prepared = prepare(recorded(acting, push), Drive(), [])
        return left_by_source(Search(Drive(), prepared.rows, [], prepared.source, 1))


@pytest.mark.parametrize(
    ("acting", "port", "variable"),
    [
        (cogging, "motor_shaft", "motor_within_a_turn"),
        (play, "between_motor_shaft_and_disc_shaft", "motor_minus_disc"),
    ],
)
def test_cogging_and_play_of_a_coupling_are_told_by_what_they_depend_on(acting, port, variable):
    first, second = left(acting)[:2]
    assert (first.port, first.variable) == (port, variable)
    assert first.log_odds > 1.5 * second.log_odds + 50


def test_cogging_is_no_push_and_hides_none():
    world = va.World(Drive(), period=PERIOD)
    with torch.inference_mode():
        assert pushes(recorded(cogging), world, left(cogging)) == ()
        (found,) = pushes(recorded(cogging, PUSH), world, left(cogging, PUSH))
    assert (found.load, found.episode) == ("motor_shaft", PUSHED[0])
    assert found.impulse == pytest.approx(PUSH * PUSHED[2] * np.sqrt(2 * np.pi), rel=0.3)


def test_cogging_is_named_among_other_loads():
    wanted = ("motor_shaft.cogging", "motor_shaft.coulomb_friction", "motor_shaft.periodic_load", "stiffness.scale")
    effects = [effect for effect in catalogue(Drive()) if effect.name in wanted]
    found = va.diagnose(recorded(cogging), va.World(Drive(), period=PERIOD), effects)
    assert found.verdict == "identified"
    (cause,) = (cause for cause in found.causes if not cause.slight)
    assert cause.effect == "motor_shaft.cogging"
    # -sin(8 q) is cos(8 q + pi / 2)
    for name, truth in {"torque": 0.012, "waves": 8.0, "phase": np.pi / 2}.items():
        assert cause.parameters[name].value == pytest.approx(truth, rel=2e-3)


def test_an_encoder_may_count_from_another_zero_in_every_run():
    (effect,) = (effect for effect in catalogue(Drive()) if effect.name == "motor_shaft.cogging")
    found = va.diagnose(recorded(cogging_from_zeros), va.World(Drive(), period=PERIOD), [effect])
    assert found.causes[0].parameters["torque"].value == pytest.approx(0.012, rel=2e-3)
    assert found.where.pushes == ()
    assert any("its phase differs from episode to episode" in warning for warning in found.warnings)


def test_an_eccentric_encoder_is_named():
    wanted = ("disc.sensor_eccentricity", "motor.sensor_eccentricity", "disc_shaft.periodic_load", "stiffness.scale")
    effects = [effect for effect in catalogue(Drive()) if effect.name in wanted]
    found = va.diagnose(recorded(nothing, eccentric=0.012), va.World(Drive(), period=PERIOD), effects)
    (cause,) = (cause for cause in found.causes if not cause.slight)
    assert cause.effect == "disc.sensor_eccentricity"
    for name, truth in {"amplitude": 0.012, "waves": 1.0, "phase": 0.5}.items():
        assert cause.parameters[name].value == pytest.approx(truth, rel=0.02)


def test_of_a_shaft_that_turns_one_way_all_that_does_the_same_is_named():
    friction = next(one for one in catalogue(Drive()) if one.name == "motor_shaft.coulomb_friction")(torque=0.01)
    world, time = va.World(Drive(), [friction], PERIOD).double(), PERIOD * np.arange(ROWS)
    torque = 0.03 + 0.01 * np.sin(4 * time) + 0.01 * np.sin(13 * time)
    at, states = world.start(torch.tensor([[0.0, 0.0, 12.0, 12.0]]).double()), []
    with torch.no_grad():
        for command in torque:
            states.append(at.state[0].numpy())
            at = world.step(at, torch.tensor([[command]]))
    read = np.stack(states) + np.random.default_rng(0).normal(size=(ROWS, 4)) * [1e-3, 1e-3, 0.05, 0.05]
    assert read[:, 2].min() > 2.0
    names = tuple(state.name for state in Drive.states)
    recording = Recording((Episode(time, torque[:, None], read),), names, PERIOD, ("run",))
    found = va.diagnose(recording, va.World(Drive(), (), PERIOD))
    same = {"coulomb_friction", "constant_load", "actuator_bias", "actuator_deadzone"}
    assert found.verdict == "ambiguous"
    assert {cause.effect.partition(".")[2] for cause in found.causes if not cause.slight} == same
    assert found.recording.noise["motor"].value == pytest.approx(1e-3, rel=0.2)
