"""The planned experiment: it tells apart what a recording left open, keeps to the ranges, and says where none does."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch

import visadapt as va
from visadapt.diagnosis import excitations, planning
from visadapt.diagnosis.result import Cause, Estimate, Gap, RecordingSummary, Where
from visadapt.effects import catalogue as effects

STATES = ("x", "x_dot", "theta", "theta_dot")
NOISE = np.array([0.005, 0.02, 0.009, 0.05])
SOURCE = va.World(va.CartPole())


@pytest.fixture(autouse=True)
def few_excitations(monkeypatch):
    """One frequency of six and one binary sequence of four, for the time it takes."""
    monkeypatch.setattr(excitations, "CYCLES", (0.4,))
    monkeypatch.setattr(excitations, "BIT_ROWS", (4,))


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


@pytest.mark.parametrize(
    ("log_odds", "best"),
    [
        ([[9.0, 0.0], [8.0, 7.0]], (1, [0, 1])),  # tells both
        ([[30.0, 0.0], [0.0, 40.0]], (1, [1])),  # none tells both
        ([[1.0, 0.0], [2.0, 1.0]], (1, [0, 1])),  # none tells any
        ([[9.0, -0.1], [-math.inf, -math.inf]], (0, [0])),  # one that is not admitted
    ],
)
def test_the_excitation_that_tells_most_is_the_best(log_odds, best):
    assert planning._best(torch.tensor(log_odds)) == best


def test_the_file_is_what_is_added_over_time(tmp_path):
    time, added = 0.05 * np.arange(3), np.array([[0.1], [-0.2], [0.3]])
    path = tmp_path / "plan.csv"
    va.Plan((("gust",), ("spring",)), "a sine", time, added, ("command",), 12.0, 5.0).write(path)
    assert path.read_text().splitlines() == ["time,command", "0,0.1", "0.05,-0.2", "0.1,0.3"]


@dataclass(frozen=True)
class Tank(va.System):
    """A tank with a hole that a pump fills, which never runs backwards."""

    area: float = 0.015
    name = "tank_with_a_pump"
    prediction_time = 30.0
    states = (va.Variable("level", "m", 0.0, 0.6),)
    actions = (va.Variable("voltage", "V", 0.0, 12.0),)
    loads = (va.Variable("inflow", "m3/s", -5e-5, 5e-5),)
    coordinates = ((None, 0),)

    def derivative(self, state, command, load):
        out = 5e-5 * (2 * 9.81 * state.clamp(min=1e-4)).sqrt()
        return (1e-5 * command - out + load) / self.area


def test_a_machine_without_a_policy_is_excited_about_the_commands_recorded():
    tank = Tank()
    world, generator = va.World(tank, (), 4.0).double(), torch.Generator().manual_seed(0)
    commands = 6 + torch.randn(60, 1, 1, generator=generator, dtype=torch.float64)
    at = world.start(torch.tensor([[0.07]], dtype=torch.float64))
    levels: list[np.ndarray] = []
    for command in commands:
        levels.append(at.state[0].numpy() + 0.001 * np.random.default_rng(len(levels)).normal(size=1))
        at = world.step(at, command)
    episode = va.Episode(4.0 * np.arange(60), commands[:, 0].numpy(), np.stack(levels))
    recording = va.Recording((episode,), ("level",), 4.0, ("run.csv",))
    effects.catalogue(tank)
    bias, gain = ("voltage.actuator_bias", "offset", -1.0), ("voltage.actuator_gain", "scale", 0.8)
    planned = va.plan(ambiguous(bias, gain), recording, va.World(tank, (), 4.0), samples=40)
    assert 0 <= planned.added.min() < 5
    assert 7 < planned.added.max() <= 12
    assert f": command {planned.excitation}, for " in str(planned)
    assert f", about voltage {float(commands.mean()):.3g} V)" in planned.excitation
    assert not planned.alike
    # What does exactly the same as the first explanation does not hide what tells the others apart.
    leak = "inflow.constant_load", "force", -1e-5
    with_leak = va.plan(ambiguous(bias, leak, gain), recording, va.World(tank, (), 4.0), samples=40)
    assert (with_leak.explanations, with_leak.alike) == (planned.explanations, ((leak[0],),))
    assert with_leak.log_odds == pytest.approx(planned.log_odds, rel=0.1)
    assert str(with_leak).endswith(f"; it does not tell it from {leak[0]}")


def test_a_pole_that_falls_needs_the_policy(pushed):
    found = ambiguous(("viscous_friction", "coefficient", 1.0), ("quadratic_drag", "coefficient", 1.0))
    with pytest.raises(ValueError, match="leaves the ranges of its states under every excitation"):
        va.plan(found, pushed, SOURCE)
