"""Recordings whose rows do not hold the commands that act: the diagnosis puts them where they act, and says so."""

import numpy as np
import pytest
import torch

from visadapt.diagnosis import diagnose
from visadapt.diagnosis.next_experiment import EVERY_COMMAND
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.words import BETWEEN_ROWS, OWN_CLOCK, THINNED
from visadapt.effects import ActuatorDelay, ActuatorGain, ViscousFriction
from visadapt.recordings import Episode, Recording
from visadapt.recordings.command_clock import instants
from visadapt.systems import CartPole
from visadapt.world import World

STEP, EPISODES = 0.001, 2
CATALOGUE = [ViscousFriction, ActuatorGain, ActuatorDelay]


def recorded(row, due, effects=()):
    """6 s of balanced cart-poles, read every `row` steps of 1 ms, whose command is computed anew where `due`, of the
    number of a step, says so."""
    generator = torch.Generator().manual_seed(0)
    world = World(CartPole(), [effect.double() for effect in effects], STEP)
    gains = torch.tensor([0.08, 0.12, 1.3, 0.3], dtype=torch.float64)
    at = world.start(0.05 * torch.randn(EPISODES, 4, generator=generator, dtype=torch.float64))
    command, states, commands = torch.zeros(EPISODES, 1, dtype=torch.float64), [], []
    with torch.no_grad():
        for step in range(6000):
            if due(step):
                noise = torch.randn(EPISODES, 1, generator=generator, dtype=torch.float64)
                command = ((at.state * gains).sum(1, keepdim=True) + 0.04 * noise).clamp(-1, 1)
            if step % row == 0:
                states.append(at.state[:, [0, 2]])
                commands.append(command)
            at = world.step(at, command)
    clean, action = torch.stack(states, 1), torch.stack(commands, 1).numpy()
    state = (clean + 0.001 * torch.randn(clean.shape, generator=generator, dtype=torch.float64)).numpy()
    time = STEP * row * np.arange(len(states))
    episodes = tuple(Episode(time, action[k], state[k]) for k in range(EPISODES))
    return Recording(episodes, ("x", "theta"), STEP * row, tuple(f"run.csv, episode {k}" for k in range(EPISODES)))


@pytest.mark.parametrize("effects", [(), [ViscousFriction(coefficient=2.0)]])
def test_commands_act_when_a_controller_of_its_own_clock_sent_them(effects):
    recording = recorded(13, lambda step: step % 20 == 7, effects)
    found = diagnose(recording, World(CartPole()), CATALOGUE)
    assert [said for said in found.warnings if OWN_CLOCK in said] == [f"commands change every 0.0200 s, {OWN_CLOCK}"]
    assert [cause.effect for cause in found.causes] == [effect.name for effect in effects]
    assert found.verdict == ("identified" if effects else "no_gap")


@pytest.mark.parametrize("effects", [(), [ViscousFriction(coefficient=2.0)]])
def test_commands_between_the_rows_are_estimated(effects):
    recording = recorded(40, lambda step: step % 10 == 0, effects)
    found = diagnose(recording, World(CartPole()), CATALOGUE)
    assert BETWEEN_ROWS in found.warnings
    assert (found.verdict, found.next_experiment) == ("unexplained", EVERY_COMMAND)  # what was sent stays unknown
    assert [cause.effect for cause in found.partial] == [effect.name for effect in effects]
    assert all(cause.parameters["coefficient"].value == pytest.approx(2.0, rel=0.15) for cause in found.partial)


def test_commands_of_the_loop_that_reads_act_from_their_rows_on():
    # Steps of 33 ms, which a loop of 10 ms can begin in a row alone.
    recording = recorded(10, lambda step: step % 10 == 0 and step // 33 != (step - 10) // 33)
    episode = recording.episodes[0]
    assert instants(episode.time, episode.action) is not None  # a clock of its own would show the same commands
    assert not any(OWN_CLOCK in said for said in prepare(recording, CartPole(), CATALOGUE).warnings)


def logged(kept, noise, late=0):
    """6 s of a balanced cart-pole, read every 40 ms, whose commands change every 4 ms; a log keeps one every `kept` ms,
    `late` ms after it acts, and a row has the mean of those that it keeps, each held until the next."""
    generator = torch.Generator().manual_seed(0)
    world, row, loop = World(CartPole(), (), STEP), 40, 4
    at, states, held = world.start(torch.tensor([[0.0, 0.0, 0.02, 0.0]], dtype=torch.float64)), [], []
    gains = torch.tensor([0.3, 0.4, 3.0, 0.6], dtype=torch.float64)
    with torch.no_grad():
        for step in range(6000):
            if step % loop == 0:
                aim = 0.1 * np.sin(0.003 * step)
                command = ((at.state * gains).sum(1, keepdim=True) + aim).clamp(-1, 1)
            if step % kept == 0:
                last = command
            if step % row == 0:
                states.append(at.state[0, [0, 2]])
            held.append(last[0])
            at = world.step(at, command)
    stamped = torch.stack(held[:1] * late + held[: len(held) - late])
    commands = stamped.unflatten(0, (-1, row)).mean(1).numpy()
    clean = torch.stack(states)
    state = (clean + noise * torch.randn(clean.shape, generator=generator, dtype=torch.float64)).numpy()
    episode = Episode(STEP * row * np.arange(len(state)), commands, state)
    return Recording((episode,), ("x", "theta"), STEP * row, ("run.ulg",), command_period=STEP * kept)


@pytest.mark.parametrize(("kept", "late"), [(40, 0.018), (16, 0.006)])
def test_commands_of_which_a_log_keeps_some_are_moved_by_half_of_what_is_between_them(kept, late):
    said, why = prepare(logged(kept, 1e-4), CartPole(), CATALOGUE).warnings
    assert float(said.split()[3]) == pytest.approx(late, abs=0.003)
    assert why == THINNED


def test_commands_of_which_a_log_keeps_all_act_when_they_were_sent():
    assert prepare(logged(4, 1e-4), CartPole(), CATALOGUE).warnings == ()


def test_commands_that_reach_their_log_late_are_not_said_to_be_some_of_those_sent():
    (said,) = prepare(logged(4, 1e-4, late=5), CartPole(), CATALOGUE).warnings
    assert float(said.split()[3]) == pytest.approx(0.005, abs=0.001)
