"""Two motors whose commands are exchanged are recognised by what each moves."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from tests.own_systems import DoublePendulum, Rover
from visadapt.recordings import Episode, RecordingError, load_recording, write_recording
from visadapt.world import World

PERIOD = 0.02


def recorded(path, system, moved, apart=1.0, signs=1.0):
    """A file of 10 s of random commands (T, 2), in common but for a share that is `apart`, and of what these do as
    `moved`: states with `signs`."""
    generator = np.random.default_rng(0)
    size = (0.3 if isinstance(system, Rover) else 0.03) * np.array([action.high for action in system.actions])
    action = size * np.repeat(generator.uniform(-1, 1, (34, len(size))), 15, 0)[:501]
    action = apart * action + (1 - apart) * action[:, :1]
    world = World(system, period=PERIOD).double()
    at, rows = world.start(torch.zeros(1, len(system.states), dtype=torch.float64)), []
    for command in torch.from_numpy(moved(action)):
        rows.append(at.state[0].numpy() + 1e-3 * generator.standard_normal(len(system.states)))
        at = world.step(at, command[None])
    episode = Episode(PERIOD * np.arange(501), action, signs * np.array(rows))
    write_recording(path, [episode], [each.name for each in system.states], [each.name for each in system.actions])
    return path


def test_exchanged_motors_are_refused_and_read_rightly_as_the_message_says(tmp_path):
    system = DoublePendulum()
    path = recorded(tmp_path / "run.h5", system, lambda action: action[:, ::-1].copy())
    one, other = (each.name for each in system.actions)
    right = f"column '{one}' moves what {other} should, .* exchanged; --columns {one}={other},{other}={one} converts"
    with pytest.raises(RecordingError, match=right):
        load_recording(path, system)
    assert load_recording(path, system, {one: other, other: one}).warnings == ()


@pytest.mark.parametrize("system", [DoublePendulum(), Rover()])
@pytest.mark.parametrize("moved", [
    lambda action: action,
    lambda action: np.roll(action, 8, 0),
    lambda action: action * [1.0, 0.1],
    lambda action: action * [0.1, 1.0],
    lambda action: action * [1.0, -1.0],
    lambda action: -action,
], ids=["as commanded", "late", "right weak", "left weak", "right opposite", "both opposite"])  # fmt: skip
def test_motors_that_do_something_else_are_not_called_exchanged(tmp_path, system, moved):
    load_recording(recorded(tmp_path / "run.h5", system, moved), system)


@pytest.mark.parametrize("apart", [0.0, 0.05, 0.1])
def test_motors_that_get_nearly_the_same_command_are_not_called_exchanged(tmp_path, apart):
    load_recording(recorded(tmp_path / "run.h5", Rover(), lambda action: action * [1.0, 0.5], apart), Rover())


def test_wheels_that_turn_a_robot_the_other_way_may_be_a_heading_of_the_other_sign(tmp_path):
    signs = np.array([1.0, -1.0, -1.0, 1.0, -1.0])
    load_recording(recorded(tmp_path / "run.h5", Rover(), lambda action: action, signs=signs), Rover())
    load_recording(recorded(tmp_path / "run.h5", Rover(), lambda action: action[:, ::-1].copy()), Rover())


@dataclass(frozen=True)
class Undefined(DoublePendulum):
    """Its derivative is no number where the second joint turns backwards."""

    name = "undefined"

    def derivative(self, state, command, load):
        return super().derivative(state, command, load) + 0 * state[:, 3:].sqrt()


@dataclass(frozen=True)
class Unjointed(DoublePendulum):
    """No state is the rate of another."""

    name = "unjointed"
    coordinates = ()


@pytest.mark.parametrize("system", [Undefined(), Unjointed()])
def test_what_the_source_says_nothing_of_is_not_judged(tmp_path, system):
    path = recorded(tmp_path / "run.h5", DoublePendulum(), lambda action: action[:, ::-1].copy())
    load_recording(path, system)
