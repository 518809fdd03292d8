"""Pushes of a double pendulum and of a cart: found with times and impulses, and none named where there is none."""

import dataclasses
import functools
import math

import numpy as np
import pytest
import torch

import visadapt as va
from tests.diagnosed import record
from tests.own_systems import DoublePendulum, Motor
from visadapt.diagnosis import diagnose
from visadapt.diagnosis.result import Push
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.search.pushed_rows import depart_from
from visadapt.diagnosis.search.pushes import pushes
from visadapt.diagnosis.search.search import Search
from visadapt.diagnosis.search.unexplained_load import load_tracks, unread_states
from visadapt.effects import ActuatorLag, ActuatorSaturation, CoulombFriction, DynamicsEffect
from visadapt.effects.catalogue import catalogue
from visadapt.estimation.candidate import CandidateModel
from visadapt.recordings import Episode, Recording
from visadapt.systems import CartPole
from visadapt.world import World

PERIOD, WIDTH = 0.004, 0.08
SHOULDER, ELBOW = (0, 1.5, 0.4), (1, 3.2, -0.35)
"""A push: on which joint, its middle in s, its peak in N m."""


RUNS = ((), (ELBOW,), (SHOULDER, ELBOW))


def states_under(world, start, commands):
    """The states (T, B, n) of a world that starts in `start` (B, n), under commands (T, B, n_action)."""
    at, states = world.start(torch.tensor(start).double()), []
    with torch.no_grad():
        for command in torch.from_numpy(commands):
            states.append(at.state.numpy())
            at = world.step(at, command)
    return np.stack(states)


@functools.cache
def every():
    """5 s of double pendulums with friction and a weaker motor than the source's, under torques, and pushes of RUNS."""
    effects = {effect.name: effect for effect in catalogue(DoublePendulum())}
    machine = World(
        DoublePendulum(),
        [
            effects["shoulder.coulomb_friction"](torque=0.15),
            effects["elbow.viscous_friction"](coefficient=0.02),
            effects["torque_1.actuator_gain"](scale=0.85),
        ],
        PERIOD,
    ).double()
    time = PERIOD * np.arange(1250)
    torque = np.stack((1.6 * np.sin(4 * time) + 0.9 * np.sin(9.5 * time + 1), 0.3 * np.sin(6 * time)), 1)
    push = np.zeros((len(time), len(RUNS), 2))
    for run, given in enumerate(RUNS):
        for joint, middle, peak in given:
            push[:, run, joint] += peak * np.exp(-0.5 * ((time - middle) / WIDTH) ** 2)
    push[..., 0] /= 0.85  # it acts whole, whatever the motor makes of its command
    states = states_under(machine, np.zeros((len(RUNS), 4)), torque[:, None] + push)
    noise = np.random.default_rng(0).normal(size=(len(time), 4)) * [2e-4, 2e-4, 0.05, 0.05]
    return {
        given: Recording(
            (Episode(time, torque, clean + noise),), tuple(s.name for s in DoublePendulum.states), PERIOD, ("run",)
        )
        for given, clean in zip(RUNS, states.swapaxes(0, 1), strict=True)
    }


def recorded(*given):
    """One of these runs."""
    return every()[given]


def found_in(recording):
    with torch.inference_mode():
        return pushes(recording, World(DoublePendulum(), period=PERIOD))


def test_pushes_are_found_with_joint_time_and_impulse():
    found = found_in(recorded(SHOULDER, ELBOW))
    assert [push.load for push in found] == ["shoulder", "elbow"]
    for push, (_, middle, peak) in zip(found, (SHOULDER, ELBOW), strict=True):
        assert push.start == pytest.approx(middle - 2.45 * WIDTH, abs=0.1)
        assert push.end == pytest.approx(middle + 2.45 * WIDTH, abs=0.1)
        assert push.impulse == pytest.approx(peak * WIDTH * math.sqrt(2 * math.pi), rel=0.3)
        assert push.ci90[0] < push.impulse < push.ci90[1]
        assert push.unit == "N m"
        assert push.p_value < 1e-3


def test_none_is_named_where_there_is_none():
    assert found_in(recorded()) == ()


def test_each_episode_has_its_own():
    first, second = recorded(), recorded(ELBOW)
    both = dataclasses.replace(first, episodes=first.episodes + second.episodes, sources=("one", "two"))
    assert [(push.episode, push.load) for push in found_in(both)] == [(1, "elbow")]


def test_without_a_joints_position_none_are_looked_for():
    whole = recorded(ELBOW)
    first = whole.episodes[0]
    episode = Episode(first.time[:450], first.action[:450], first.state[:450, [0, 2, 3]])
    less = dataclasses.replace(whole, episodes=(episode,), measured=("angle_1", "velocity_1", "velocity_2"))
    assert found_in(less) == ()
    assert unread_states(less, DoublePendulum()) == ["angle_2"]
    assert unread_states(whole, DoublePendulum()) == []
    friction = [one for one in catalogue(DoublePendulum()) if one.name == "shoulder.viscous_friction"]
    warning = "pushes in single episodes were not looked for: they need angle_2, which no sensor read"
    found = diagnose(less, World(DoublePendulum(), period=less.period), friction)
    assert found.verdict == "unexplained"
    assert warning in found.warnings


@pytest.mark.parametrize("peak", [0.04, 0.0])
def test_of_a_motor_its_measured_speed_shows_them(peak):
    time = 0.01 * np.arange(600)
    voltage = 8 * np.sign(np.sin(3 * time + 2 * np.sin(time)))
    push = peak * np.exp(-0.5 * ((time - 3.3) / WIDTH) ** 2)
    by_volt = Motor().constant / Motor().resistance
    speed = states_under(World(Motor(), period=0.01).double(), [[0.0]], (voltage + push / by_volt)[:, None, None])[:, 0]
    read = speed + np.random.default_rng(3).normal(size=speed.shape) * 0.1
    recording = Recording((Episode(time, voltage[:, None], read),), ("speed",), 0.01, ("run",))
    found = diagnose(recording, World(Motor(), period=0.01), ())
    pushes = [(push.load, round(push.impulse / (WIDTH * math.sqrt(2 * math.pi)), 2)) for push in found.where.pushes]
    assert pushes == ([("shaft", peak)] if peak else [])
    assert found.verdict == ("unexplained" if peak else "no_gap")
    assert unread_states(recording, Motor()) == []


TIME = 0.02 * np.arange(250)
HANGING = (0.0, 0.0, math.pi, 0.0)
BURST = np.exp(-0.5 * ((TIME - 2.5) / 0.1) ** 2)


def hanging(acting, command, effects=()):
    """5 s of a cart with a hanging pole, on which the commands `acting` act where `command` is recorded."""
    world = World(CartPole(), effects, period=0.02).double()
    generator = np.random.default_rng(1)
    state = states_under(world, [HANGING], acting[:, None, None])[:, 0]
    state = state + generator.normal(size=(len(TIME), 4)) * [1e-3, 1e-2, 1e-3, 1e-2]
    return Recording((Episode(TIME, command[:, None], state),), ("x", "x_dot", "theta", "theta_dot"), 0.02, ("run",))


def test_a_kick_of_the_cart_is_found():
    command = 0.5 * np.sin(5 * TIME) + 0.3 * np.sin(11 * TIME)
    recording = hanging(command + 4.0 * BURST / CartPole().max_force, command)
    with torch.inference_mode():
        (push,) = pushes(recording, World(CartPole(), period=0.02))
    assert push.load == "cart_force"
    assert push.start == pytest.approx(2.5 - 0.245, abs=0.1)
    assert push.impulse == pytest.approx(4.0 * 0.1 * math.sqrt(2 * math.pi), rel=0.3)


def test_what_a_cause_explains_is_no_push():
    command = 0.1 * np.sin(5 * TIME) + 0.1 * np.sin(11 * TIME) + 0.6 * BURST
    recording = hanging(command, command, [ActuatorSaturation(limit=0.3)])
    with torch.inference_mode():
        assert pushes(recording, World(CartPole(), period=0.02))
    found = va.diagnose(recording, World(CartPole(), period=0.02), catalogue=[ActuatorSaturation])
    assert found.verdict == "identified"
    assert found.where.pushes == ()


def test_a_joint_that_stands_still_in_one_episode_hides_no_push_of_another():
    whole = balanced(4.0, 0.0)
    run = whole.episodes[0]
    still = Episode(run.time, 0 * run.action, 0 * run.state)
    both = Recording((still, run), whole.measured, whole.period, ("still", "run"))
    with torch.inference_mode():
        assert {push.episode for push in pushes(both, World(CartPole()))} == {1}


STEPS = np.array([1e-4, 2 * math.pi / 4096])
STEADY = [(0.0, jitter, seed) for seed in range(3) for jitter in (0.0, 0.2)]
PUSHED = [(2.0, 0.0, 0), (2.0, 0.2, 2), (2.0, 0.2, 7), (-4.0, 0.0, 3), (-4.0, 0.2, 0), (10.0, 0.0, 0), (8.0, 0.1, 1)]
"""Runs of a balanced cart-pole: force in N, jitter of the clock, seed."""


def drive(world, runs, liveliness):
    """12 s of cart-poles that are balanced by feedback, read by encoders, with a push of `force` N for about 0.5 s at
    8 s; steps of the clock are up to `jitter` longer than 20 ms. The `liveliness` multiplies what wanders in their
    commands."""
    force, jitter = np.array(runs)[:, 0], np.array(runs)[:, 1]
    randoms = [np.random.default_rng(seed) for _, _, seed in runs]
    gain = [0.05, 0.12, 1.6, 0.35]
    at = torch.tensor([[0.1, 0.0, 0.03, 0.0]]).double().repeat(len(runs), 1)
    time, wander, rows = np.zeros(len(runs)), np.zeros(len(runs)), []
    while time.min() < 12:
        read = np.round(at.numpy()[:, [0, 2]] / STEPS) * STEPS
        drawn = np.array([(random.normal(), random.uniform()) for random in randoms])
        wander = 0.97 * wander + 0.03 * liveliness * drawn[:, 0]
        command = np.clip(at.numpy() @ np.multiply(gain, (1 + liveliness) / 2) + wander, -1, 1)
        rows.append(np.column_stack((time, read, command)))
        step = 0.02 * (1 + jitter * drawn[:, 1])
        for _ in range(4):
            push = force * np.exp(-0.5 * ((time - 8) / 0.11) ** 2) / CartPole().max_force
            acting = torch.from_numpy(command + push)[:, None, None]
            with torch.no_grad():
                at = world.integrate(torch.zeros(len(runs)), at, acting, torch.from_numpy(step / 4))
            time = time + step / 4
    tables = [table[table[:, 0] < 12] for table in np.stack(rows, 1)]
    return {
        run: Recording(
            (Episode(table[:, 0], table[:, 3:], table[:, 1:3]),),
            ("x", "theta"),
            float(np.median(np.diff(table[:, 0]))),
            ("run",),
        )
        for run, table in zip(runs, tables, strict=True)
    }


@functools.cache
def every_balanced():
    """These runs, of carts without friction."""
    return drive(World(CartPole(), period=0.02), (*STEADY, *PUSHED, (4.0, 0.0, 0)), 1.0)


def balanced(force, jitter, seed=0):
    """One of these runs."""
    return every_balanced()[force, jitter, seed]


@pytest.mark.parametrize(("force", "jitter", "seed"), STEADY)
def test_of_a_balanced_cart_pole_none_is_named_where_there_is_none(force, jitter, seed):
    with torch.inference_mode():
        assert pushes(balanced(force, jitter, seed), World(CartPole())) == ()


@pytest.mark.parametrize(("force", "jitter", "seed"), PUSHED)
def test_feedback_does_not_hide_a_push_and_the_pole_is_not_pushed(force, jitter, seed):
    with torch.inference_mode():
        (push,) = pushes(balanced(force, jitter, seed), World(CartPole()))
    assert push.load == "cart_force"
    impulse = force * 0.11 * math.sqrt(2 * math.pi)
    assert push.size == pytest.approx(force, rel=0.25)
    assert push.impulse == pytest.approx(impulse, rel=0.25)
    assert push.start == pytest.approx(8 - 2.45 * 0.11, abs=0.1)
    assert push.ci90[0] < impulse < push.ci90[1]


@pytest.mark.parametrize(
    ("friction", "noise", "seed"), [(3.0, 3e-3, 1), (6.0, 1e-3, 2), (6.0, 1e-3, 4), (6.0, 1e-3, 6)]
)
def test_none_is_named_where_a_cart_sticks_now_and_then(friction, noise, seed):
    """Under slow forces of up to 1.5 or 3 times its dry friction, read every 30 ms with `noise` in m and rad."""
    world = World(CartPole(), [CoulombFriction(force=friction)], period=0.03).double()
    random, time = np.random.default_rng(seed), 0.03 * np.arange(120)
    frequency, phase = random.uniform(1, 8, (3, 4, 1)), random.uniform(0, 6, (3, 4, 1))
    command = 0.1 * friction * np.sin(frequency * time + phase).mean(0)
    read = states_under(world, 4 * [HANGING], command.T[..., None])[..., [0, 2]].swapaxes(0, 1)
    read = read + noise * random.normal(size=read.shape)
    episodes = tuple(Episode(time, each[:, None], rows) for each, rows in zip(command, read, strict=True))
    with torch.inference_mode():
        assert pushes(Recording(episodes, ("x", "theta"), 0.03, ("run",) * 4), world) == ()


@functools.cache
def every_sticking():
    """Runs of carts with 4 N of dry friction that stick in between, pushed or not."""
    runs = [(force, 0.2, seed) for force, seeds in ((0.0, range(8)), (6.0, (2, 5))) for seed in seeds]
    return drive(STICKING, runs, 2.0)


STICKING = World(CartPole(), [CoulombFriction(force=4.0)], period=0.02)


@pytest.mark.parametrize("seed", range(8))
def test_the_friction_that_holds_a_cart_is_no_push(seed):
    with torch.inference_mode():
        assert pushes(every_sticking()[0.0, 0.2, seed], STICKING) == ()


@pytest.mark.parametrize("seed", [2, 5])
def test_a_cart_that_sticks_hides_no_push_that_moves_it(seed):
    with torch.inference_mode():
        (push,) = pushes(every_sticking()[6.0, 0.2, seed], STICKING)
    assert push.load == "cart_force"
    assert push.start == pytest.approx(8 - 2.45 * 0.11, abs=0.1)
    assert push.impulse == pytest.approx(6.0 * 0.11 * math.sqrt(2 * math.pi), rel=0.3)


@pytest.mark.parametrize("rate", [0.2, 0.5])
def test_none_is_named_where_readings_were_lost(rate):
    recording = record(rows=100, noise=(5e-4, 5e-4, 2e-3, 2e-3))
    lost = [np.random.default_rng(k).random(len(e.time)) < rate for k, e in enumerate(recording.episodes)]
    episodes = []
    for episode, marks in zip(recording.episodes, lost, strict=True):
        last = np.maximum.accumulate(np.where(marks, 0, np.arange(len(marks))))
        episodes.append(Episode(episode.time, episode.action, episode.state[last]))
    whole = prepare(dataclasses.replace(recording, episodes=tuple(episodes)), CartPole()).whole
    with torch.inference_mode():
        assert pushes(whole, World(CartPole())) == ()


class Tap(DynamicsEffect):
    """A finger that taps the pole: half a sine of torque, from 3.00 to 3.15 s, and no other effect."""

    equation = "Q_theta = 0.4 sin(pi (t - 3) / 0.15)"
    table = ()

    def load(self, time, state, system):
        torque = 0.4 * (math.pi * (time - 3.0) / 0.15).sin() * ((time > 3.0) & (time < 3.15))
        return torch.stack((torch.zeros_like(state[:, 0]), torque.expand(len(state))), -1)


class Blow(DynamicsEffect):
    """A stop that the cart hits, in 20 ms: shorter than a row."""

    equation = "Q_x = 40 exp(-((t - 2.52) / 0.01)^2)"
    table = ()

    def load(self, time, state, system):
        force = 40 * (-((time - 2.52) / 0.01).square()).exp()
        return torch.stack((force.expand(len(state)), torch.zeros_like(state[:, 0])), -1)


Tap.name, Blow.name = "tap", "blow"  # only now, so that they are in no catalogue


@pytest.mark.parametrize(
    ("effect", "load", "impulse"),
    [(Tap, "pivot_torque", 0.4 * 0.15 * 2 / math.pi), (Blow, "cart_force", 40 * 0.01 * math.sqrt(math.pi))],
)
def test_of_a_short_push_the_impulse_is_said_and_no_effect_is_named(effect, load, impulse):
    found = diagnose(record([effect()], 2, rows=120), World(CartPole()))
    assert (found.verdict, found.causes) == ("unexplained", ())
    assert [(push.load, push.episode) for push in found.where.pushes] == [(load, 0), (load, 1)]
    for push in found.where.pushes:
        assert push.ci90[0] < impulse < push.ci90[1]
        assert push.impulse == pytest.approx(impulse, rel=0.2)


def test_a_lagging_motor_goes_on_through_rows_that_were_not_read():
    """From rest, what acts after them was 10 N off."""
    lag = ActuatorLag(time_constant=0.2)
    recording = record([lag], episodes=1, rows=200, noise=(0, 0, 0, 0))
    read = np.ones((200, 2), bool)
    read[90:100] = False
    tracks = load_tracks(dataclasses.replace(recording, usable=(read,)), [World(CartPole(), [lag]).double()])
    assert len(tracks) == 2
    for track in tracks:
        assert float((track.load * track.unit)[:, 0].abs().max()) < 1.0  # N


def test_a_push_is_none_where_every_row_is_as_predicted():
    """By the readings of a quiet cart, and of one whose velocity jumps by ten times the noise."""
    push = Push(1, "force", 1.0, 1.5, 3.0, "N", 0.5, (0.4, 0.6), 1e-9)
    states = [state.name for state in CartPole.states]
    quiet = record(measured=states, noise=(1e-3,) * 4)
    pushed = [episode.state.copy() for episode in quiet.episodes]
    pushed[1][24:26, 1] += 0.01
    episodes = [dataclasses.replace(e, state=state) for e, state in zip(quiet.episodes, pushed, strict=True)]
    for recording, kept in ((quiet, ()), (dataclasses.replace(quiet, episodes=tuple(episodes)), (push,))):
        rows = prepare(recording, CartPole()).rows
        fits = Search(CartPole(), rows, []).source.fits
        model = CandidateModel(CartPole(), [], rows)
        assert depart_from(model, fits, [push]) == kept
        assert depart_from(model, fits, [dataclasses.replace(push, episode=0)]) == ()
        unread = dataclasses.replace(push, start=8.0, end=9.0)
        assert depart_from(model, fits, [unread]) == (unread,), "of rows that are not read, nothing is known"
