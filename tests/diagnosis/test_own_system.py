"""A diagnosis of a system of one's own: a friction, a gain, a delay, and nothing, of a driven pendulum."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from tests.own_systems import Pendulum
from visadapt.diagnosis import diagnose
from visadapt.diagnosis.report.html import as_html
from visadapt.diagnosis.search.heldout import held_out
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.search.search import Search
from visadapt.diagnosis.words import plain
from visadapt.effects.catalogue import catalogue
from visadapt.estimation.fit_states import with_effect
from visadapt.recordings import Episode, Recording, RecordingError, load_recording, write_recording
from visadapt.systems import Variable
from visadapt.world import World

PERIOD = 0.02
BY_NAME = {effect.name: effect for effect in catalogue(Pendulum())}
SEARCHED = [
    BY_NAME[name]
    for name in (
        *("joint.viscous_friction", "joint.coulomb_friction", "joint.spring", "joint.constant_load", "inertia.scale"),
        *("torque.actuator_gain", "torque.actuator_bias", "torque.actuator_delay", "torque.actuator_lag"),
        *("sensors.measurement_delay", "angle.sensor_offset", "joint.transmission_compliance"),
    )
]
IMITATING = [
    BY_NAME[name]
    for name in (
        *("joint.viscous_friction", "joint.coulomb_friction", "inertia.scale", "torque.actuator_gain"),
        *("torque.actuator_delay", "sensors.measurement_delay", "joint.transmission_compliance"),
    )
]


def recording(*effects):
    """Two episodes of 2 s of the pendulum under torques of up to 1.6 N m."""
    world = World(Pendulum(), effects, PERIOD, "midpoint", 10).double()
    generator = torch.Generator().manual_seed(1)
    noise = torch.tensor([1e-3, 1e-2], dtype=torch.float64)
    episodes = []
    for episode in range(2):
        time = PERIOD * np.arange(100)
        torque = 0.8 * np.sin((3 + episode) * time) + 0.8 * np.sin(9 * time + episode)
        at = world.start(torch.zeros(1, 2, dtype=torch.float64))
        rows = []
        for command in torch.from_numpy(torque)[:, None, None]:
            row, at = world.measure(at)
            rows.append(row[0] + noise * torch.randn(2, dtype=torch.float64, generator=generator))
            at = world.step(at, command)
        episodes.append(Episode(time, torque[:, None], torch.stack(rows).detach().numpy()))
    return Recording(tuple(episodes), ("angle", "rate"), PERIOD, ("one", "two"))


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("joint.coulomb_friction", {"torque": 0.1}),
        ("torque.actuator_gain", {"scale": 0.8}),
        ("torque.actuator_delay", {"delay": 0.03}),
        ("joint.transmission_compliance", {"compliance": 0.006}),
    ],
)
def test_what_is_there_is_found(name, values):
    found = diagnose(recording(BY_NAME[name](**values)), World(Pendulum(), period=PERIOD), IMITATING)
    first = found.causes[0]
    assert first.effect == name
    ((parameter, value),) = values.items()
    assert first.parameters[parameter].value == pytest.approx(value, rel=0.05)
    carrying = [cause.effect for cause in found.causes if not cause.slight]
    late = name == "torque.actuator_delay"
    assert carrying == ([name, "sensors.measurement_delay"] if late else [name])
    assert found.verdict == ("ambiguous" if late else "identified")
    if late:
        assert "time command and sensor against one clock" in found.next_experiment
    page = as_html(found, {})
    assert f"{math.floor(100 * found.gap.closed)}" in page
    assert plain(first.effect) in page


def test_nothing_is_found_where_nothing_is():
    found = diagnose(recording(), World(Pendulum(), period=PERIOD), SEARCHED)
    assert (found.verdict, found.causes) == ("no_gap", ())


@pytest.mark.parametrize("catalogue", [None, SEARCHED])
def test_a_system_that_does_not_say_what_its_loads_act_on_is_refused(catalogue):
    @dataclass(frozen=True)
    class Bare(Pendulum):
        name = "bare_pendulum"
        coordinates = ()  # type: ignore[assignment]

    with pytest.raises(
        ValueError, match=r"^bare_pendulum cannot be diagnosed: its coordinates are \(\); a pair .* right$"
    ):
        diagnose(recording(), World(Bare(), period=PERIOD), catalogue)


SLOWER = 32.0


@dataclass(frozen=True)
class SlowPendulum(Pendulum):
    """The pendulum with so much inertia that it moves SLOWER times as slowly."""

    inertia: float | torch.Tensor = SLOWER**2 * Pendulum.inertia

    name = "slow_pendulum"
    prediction_time = SLOWER * Pendulum.prediction_time
    states = (Pendulum.states[0], Variable("rate", "rad/s", -12.0 / SLOWER, 12.0 / SLOWER))


def slowed(recorded):
    """The same motion, SLOWER times as slow."""
    by_column = np.array([1.0, SLOWER])
    episodes = [Episode(SLOWER * e.time, e.action, e.state / by_column) for e in recorded.episodes]
    return Recording(tuple(episodes), recorded.measured, SLOWER * recorded.period, recorded.sources)


def test_rows_of_a_slow_machine_may_be_far_apart(tmp_path):
    path = tmp_path / "run.h5"
    write_recording(path, slowed(recording()).episodes, ["angle", "rate"], ["torque"])
    assert load_recording(path, SlowPendulum()).period == pytest.approx(SLOWER * PERIOD)
    right = (
        r"rows are 0\.64 s apart; 0\.0001 to 0\.1667 s are right \(.* milliseconds\?\); the class of a slower machine"
    )
    with pytest.raises(RecordingError, match=right + r" states a prediction_time above 0\.5 s$"):
        load_recording(path, Pendulum())


def test_a_push_of_a_slow_machine_is_the_fast_one_s_slowed():
    slow = {effect.name: effect for effect in catalogue(SlowPendulum())}["joint.push"]
    states = []
    for system, effect, period in (
        (Pendulum(), BY_NAME["joint.push"], PERIOD),
        (SlowPendulum(), slow, SLOWER * PERIOD),
    ):
        scale = period / PERIOD
        world = (
            World(system, [effect(start=0.313 * scale, end=0.514 * scale, torque=0.5)], period, substeps=8)
            .double()
            .requires_grad_(False)
        )
        at, angles = world.start(torch.zeros(1, 2).double()), []
        for _ in range(50):
            at = world.step(at, torch.zeros(1, 1).double())
            angles.append(float(at.state[0, 0]))
        states.append(angles)
    np.testing.assert_allclose(states[1], states[0], rtol=1e-9)
    assert max(states[0]) > 0.1


def test_a_machine_that_moves_slowly_is_diagnosed_as_a_fast_one():
    slow = {effect.name: effect for effect in catalogue(SlowPendulum())}
    assert slow["joint.push"].table[1].high == SLOWER * BY_NAME["joint.push"].table[1].high
    fast = recording(BY_NAME["torque.actuator_delay"](delay=0.03))
    found = diagnose(
        slowed(fast), World(SlowPendulum(), period=SLOWER * PERIOD), [slow[effect.name] for effect in IMITATING]
    )
    assert found.verdict == "ambiguous"
    assert found.causes[0].effect == "torque.actuator_delay"
    assert found.causes[0].parameters["delay"].value == pytest.approx(SLOWER * 0.03, rel=0.05)
    expected = diagnose(fast, World(Pendulum(), period=PERIOD), IMITATING)
    assert found.gap.before == pytest.approx(expected.gap.before, rel=0.02)
    assert found.gap.closed == pytest.approx(expected.gap.closed, abs=0.01)


@dataclass(frozen=True)
class Balanced(Pendulum):
    """A pendulum that has no inertia left where `counterweight` is 1 or more."""

    counterweight: float | torch.Tensor = 0.5

    name = "balanced"

    def derivative(self, state, command, load):
        rate, acceleration = super().derivative(state, command, load).unbind(-1)
        return torch.stack((rate, acceleration / (1 - torch.as_tensor(self.counterweight)).sqrt()), -1)


def test_a_set_that_cannot_be_simulated_predicts_badly_and_does_not_end_the_diagnosis():
    system = Balanced()
    rows = prepare(recording(), system).rows
    (scale,) = (effect for effect in catalogue(system) if effect.name == "counterweight.scale")
    source = Search(system, rows, [scale]).source.fits
    right, impossible = (with_effect(source, [factor]) for factor in (1.0, 3.0))
    sets = [((scale,), fits) for fits in (right, impossible)]
    expected, errors = held_out(system, rows, sets, lambda errors: errors.rms(torch.ones(2).double()))
    assert errors.isfinite().all()
    assert (errors[-1] > 10 * expected[-1]).all()
