"""The planned experiment: it tells apart what a recording left open, keeps to the ranges, and says where none does."""

import math

import numpy as np
import pytest
import torch

import visadapt as va
from visadapt.diagnosis import planning
from visadapt.diagnosis.result import Cause, Estimate, Gap, RecordingSummary, Where

STATES = ("x", "x_dot", "theta", "theta_dot")
NOISE = np.array([0.005, 0.02, 0.009, 0.05])
SOURCE = va.World(va.CartPole())


@pytest.fixture(autouse=True)
def few_excitations(monkeypatch):
    """One frequency of six and one binary sequence of four, for the time it takes."""
    monkeypatch.setattr(planning, "CYCLES", (0.4,))
    monkeypatch.setattr(planning, "BIT_ROWS", (4,))


@pytest.fixture(scope="module")
def policy():
    return va.load_policy(va.shipped("cartpole_states"))


@pytest.fixture(scope="module")
def pushed(policy):
    """A recording under a constant force."""
    return recorded(policy, va.effects.ConstantForce(force=1.0), 60, 0)


def recorded(policy, effect, steps, seed, **excitation):
    """Noisy states of a target with an effect, and the commands."""
    target = va.SyntheticTarget(lambda batch, generator: [effect])
    rng, generator = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    runs = va.run(target, policy, 1, steps, generator, **excitation)
    episodes = tuple(
        va.Episode(e.time, e.action.astype(float), e.state + NOISE * rng.normal(size=e.state.shape))
        for e in (run.episode for run in runs)
    )
    return va.Recording(episodes, STATES, 0.05, ("run.csv",))


def ambiguous(*causes):
    """A diagnosis that cannot tell its causes apart: (effect, parameter, value) each."""
    names = [name for name, _, _ in causes]
    found = tuple(
        Cause(name, {p: Estimate(value, "", (math.nan, math.nan))}, 0.5, 1.0, 1.0, False, tuple(set(names) - {name}))
        for name, p, value in causes
    )
    gap = Gap("error", before=1.5, after=1.0, floor=1.0, black_box=1.0, closed=1.0)
    return va.Diagnosis("cartpole", RecordingSummary(1, 60, 0.05), "ambiguous", Where({}, {}), found, (), gap, "")


def test_it_tells_drag_from_friction_where_the_recording_did_not(policy):
    truth = va.effects.ViscousFriction(coefficient=0.3)
    catalogue = [va.effects.ViscousFriction, va.effects.QuadraticDrag]
    gentle = recorded(policy, truth, 120, 0, exploration=0.1)
    found = va.diagnose(gentle, SOURCE, catalogue)
    assert found.verdict == "ambiguous"
    planned = va.plan(found, gentle, SOURCE, policy, samples=120)
    assert planned.settles
    assert not planned.log_odds < planned.white
    settled = va.diagnose(recorded(policy, truth, 120, 1, added=torch.from_numpy(planned.added)), SOURCE, catalogue)
    assert (settled.verdict, [cause.effect for cause in settled.causes]) == ("identified", ["viscous_friction"])


def test_no_motion_tells_a_bias_of_the_motor_from_a_force(policy, pushed):
    found = ambiguous(("constant_force", "force", 1.0), ("actuator_bias", "offset", 1.0 / va.CartPole().max_force))
    planned = va.plan(found, pushed, SOURCE, policy, samples=60)
    assert not planned.settles
    assert str(planned).startswith("no excitation was found that tells constant_force from actuator")


def test_the_file_is_what_is_added_over_time(tmp_path):
    time, added = 0.05 * np.arange(3), np.array([[0.1], [-0.2], [0.3]])
    path = tmp_path / "plan.csv"
    va.Plan((("gust",), ("spring",)), "a sine", time, added, ("command",), 12.0, 5.0).write(path)
    assert path.read_text().splitlines() == ["time,command", "0,0.1", "0.05,-0.2", "0.1,0.3"]


def test_a_pole_that_falls_needs_the_policy(pushed):
    found = ambiguous(("viscous_friction", "coefficient", 1.0), ("quadratic_drag", "coefficient", 1.0))
    with pytest.raises(ValueError, match="leaves the ranges of its states under every excitation"):
        va.plan(found, pushed, SOURCE)
