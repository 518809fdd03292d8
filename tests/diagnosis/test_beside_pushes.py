"""What acts beside a push in one of several episodes, which no effect does, and which would hide all else."""

import dataclasses
import math

import pytest

import visadapt as va
from tests.diagnosis.test_pushes import drive
from visadapt.diagnosis.report.text import as_text
from visadapt.diagnosis.result import Push
from visadapt.diagnosis.search.preparation import prepare
from visadapt.effects import ActuatorSaturation, ViscousFriction
from visadapt.recordings import Recording
from visadapt.systems import CartPole
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
    assert found.verdict == ("identified" if effects else "no_gap")
    assert [cause.effect for cause in found.causes] == [effect.name for effect in effects]
    for cause in found.causes:
        assert cause.parameters["coefficient"].value == pytest.approx(1.5, abs=0.02)
    assert found.gap.after < 1.2 * found.gap.floor  # encoders count: their noise is not white
    (push,) = found.where.pushes
    impulse = FORCE * 0.11 * math.sqrt(2 * math.pi)
    assert push.episode == 1
    assert push.start == pytest.approx(8 - 2.45 * 0.11, abs=0.1)
    assert push.ci90[0] < impulse < push.ci90[1]
    assert any("the rows within pushes were left out" in warning for warning in found.warnings)
    assert "nothing touches the machine" in found.next_experiment
    assert effects or "No gap beside the pushes" in as_text(found)


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
