"""What acts beside a push in one of several episodes, which no effect does, and which would hide all else."""

import dataclasses
import math

import pytest
import torch

import visadapt as va
from tests.diagnosed import record
from tests.diagnosis.test_diagnosis_flights import record as a_flight
from tests.diagnosis.test_pushes import drive
from visadapt.diagnosis.report.text import as_text
from visadapt.diagnosis.result import Push
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.words import BESIDE_PUSHES
from visadapt.effects import ActuatorSaturation, DynamicsEffect, LinearDrag, ThrustGain, ViscousFriction
from visadapt.estimation.segments import initial_states, joined
from visadapt.recordings import Recording
from visadapt.systems import CartPole, Quadrotor
from visadapt.world import World

FORCE = 5.0  # N, of the push in episode 1
CATALOGUE = [ViscousFriction, ActuatorSaturation]


def pushed(*effects):
    """Two episodes of a balanced cart with these effects, the second of which is pushed at 8 s."""
    runs = drive(World(CartPole(), effects, period=0.02), [(0.0, 0.1, 0), (FORCE, 0.1, 1)], 1.0)
    recordings = list(runs.values())
    episodes = tuple(each.episodes[0] for each in recordings)
    return Recording(episodes, ("x", "theta"), recordings[0].period, ("one", "two"))


@pytest.mark.parametrize("effects", [(), (ViscousFriction(coefficient=1.5),)], ids=["nothing", "viscous_friction"])
def test_a_push_does_not_hide_what_acts_beside_it(effects):
    found = va.diagnose(pushed(*effects), World(CartPole(), period=0.02), CATALOGUE)
    assert found.verdict == ("identified" if effects else "unexplained")
    assert [cause.effect for cause in found.causes] == [effect.name for effect in effects]
    for cause in found.causes:
        assert cause.parameters["coefficient"].value == pytest.approx(1.5, abs=0.02)
    assert found.gap.after < 1.2 * found.gap.floor  # encoders count: their noise is not white
    (push,) = found.where.pushes
    impulse = FORCE * 0.11 * math.sqrt(2 * math.pi)
    assert push.episode == 1
    assert push.start == pytest.approx(8 - 2.45 * 0.11, abs=0.1)
    assert push.ci90[0] < impulse < push.ci90[1]
    assert BESIDE_PUSHES in found.warnings
    assert "nothing touches the machine" in found.next_experiment
    assert effects or "Beside it there is no gap" in as_text(found)


def test_no_window_holds_a_row_within_a_push():
    recording = pushed()
    push = Push(1, "cart_force", 7.7, 8.3, FORCE, "N", 1.4, (1.0, 1.8), 1e-6)
    early = dataclasses.replace(push, start=0.0, end=0.1)
    rows = prepare(recording, CartPole(), pushes=[push, early]).rows
    time = rows.time[(rows.inside > 0) & (rows.episode == 1)[:, None]]
    assert time.min() > 0.1
    assert not ((time >= push.start) & (time <= push.end)).any()
    assert (time > push.end).any()
    whole = prepare(recording, CartPole()).rows
    assert rows.inside[rows.episode != 1].sum() == whole.inside[whole.episode != 1].sum()


class Passing(DynamicsEffect):
    """2 N along x from 2 to 2.6 s."""

    def load(self, time, state, system):
        along_x = torch.eye(len(system.loads), dtype=state.dtype)[0]
        return 2.0 * ((time >= 2.0) & (time < 2.6))[:, None] * along_x


@pytest.mark.parametrize("effects", [(), (LinearDrag(coefficient=0.3),)], ids=["nothing", "linear_drag"])
def test_a_gust_over_one_of_several_flights_does_not_hide_what_acts_beside_it(effects):
    flights, other = (
        a_flight(Quadrotor(), [*effects, *more], episodes=count, rows=40, seed=count)
        for count, more in ((3, ()), (1, (Passing(),)))
    )
    whole = dataclasses.replace(flights, episodes=(*flights.episodes, *other.episodes), sources=("1", "2", "3", "4"))
    found = va.diagnose(whole, World(Quadrotor(), period=0.1), [LinearDrag, ThrustGain])
    assert found.verdict == ("identified" if effects else "unexplained")
    assert [cause.effect for cause in found.causes] == [effect.name for effect in effects]
    for cause in found.causes:
        assert cause.parameters["coefficient"].value == pytest.approx(0.3, abs=0.05)
    (push,) = found.where.pushes
    assert (push.episode, push.load) == (3, "force_x")
    assert push.start == pytest.approx(2.0, abs=0.15)
    assert push.end == pytest.approx(2.6, abs=0.15)
    assert push.ci90[0] < 1.2 < push.ci90[1]
    assert BESIDE_PUSHES in found.warnings


def test_windows_that_follow_each_other_are_joined():
    recording = record(rows=300, episodes=2)
    push = Push(1, "cart_force", 7.0, 8.0, FORCE, "N", 1.4, (1.0, 1.8), 1e-6)
    rows = prepare(recording, CartPole(), pushes=[push]).rows
    assert rows.shape[0] > 3
    state = torch.where(rows.inside[..., None] > 0, initial_states(rows, CartPole()), torch.nan)
    whole, states = joined(rows, state)
    assert whole.shape[0] == 3
    assert whole.inside.sum() == rows.inside.sum()
    for window, episode in enumerate(whole.episode.tolist()):
        used = whole.inside[window] > 0
        row = whole.first[window] + torch.arange(int(used.sum()))
        expected = torch.tensor(recording.episodes[episode].state)[row]
        torch.testing.assert_close(whole.measured[window, used], expected)
        torch.testing.assert_close(whole.time[window, used], torch.tensor(recording.episodes[episode].time)[row])
        torch.testing.assert_close(states[window, used][:, [0, 2]], expected)
    assert states.isfinite().all()
    assert (whole.time.diff(dim=1) > 0).all()
    assert whole.duration.shape == whole.shape
