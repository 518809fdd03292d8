"""Two motors whose commands are exchanged are recognised by what each moves."""

import numpy as np
import pytest
import torch

from tests.own_systems import DoublePendulum, Rover
from visadapt.recordings import Episode, RecordingError, load_recording, write_recording
from visadapt.world import World

PERIOD = 0.02


def recorded(path, system, moved, alike=False):
    """A file of 10 s of random commands (T, 2), perhaps the same for both motors, and of what these do as `moved`."""
    generator = np.random.default_rng(0)
    size = (0.3 if isinstance(system, Rover) else 0.03) * np.array([action.high for action in system.actions])
    action = size * np.repeat(generator.uniform(-1, 1, (34, len(size))), 15, 0)[:501]
    if alike:
        action[:, 1] = action[:, 0]
    world = World(system, period=PERIOD).double()
    at, rows = world.start(torch.zeros(1, len(system.states), dtype=torch.float64)), []
    for command in torch.from_numpy(moved(action)):
        rows.append(at.state[0].numpy() + 1e-3 * generator.standard_normal(len(system.states)))
        at = world.step(at, command[None])
    episode = Episode(PERIOD * np.arange(501), action, np.array(rows))
    write_recording(path, [episode], [each.name for each in system.states], [each.name for each in system.actions])
    return path


@pytest.mark.parametrize("system", [DoublePendulum(), Rover()])
def test_exchanged_motors_are_refused_and_read_rightly_as_the_message_says(tmp_path, system):
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


def test_motors_that_get_the_same_command_cannot_be_told_apart(tmp_path):
    load_recording(recorded(tmp_path / "run.h5", Rover(), lambda action: action, alike=True), Rover())
