"""Diagnosis of a quadrotor and a fixed wing: the right name and size, on recordings made with the cause withheld."""

from __future__ import annotations

import dataclasses
import importlib
import json

import numpy as np
import pytest
import torch

from visadapt import diagnose
from visadapt.cli.main import main
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.search.search import Search
from visadapt.diagnosis.search.searched_effects import searched
from visadapt.effects import ActuatorDelay, ConstantForce, LiftSlope, LinearDrag, PositioningDelay, ThrustGain, Wind
from visadapt.effects.catalogue import catalogue
from visadapt.estimation.profiles import PROFILES
from visadapt.recordings import Episode, Recording
from visadapt.systems import CartPole, FixedWing, Quadrotor
from visadapt.world import World

NOISE = torch.tensor([0.01] * 3 + [0.02] * 3 + [0.0025] * 4 + [0.005] * 3, dtype=torch.float64)
PERIODS = {"quadrotor": 0.1, "fixed_wing": 0.05}


def record(system, effects=(), episodes=5, rows=25, seed=0):
    """Episodes with random steps around hovering, or level flight at 11.5 m/s; all 13 states."""
    period = PERIODS[system.name]
    generator = torch.Generator().manual_seed(seed)
    world = World(system, [effect.double() for effect in effects], period=period, substeps=10)
    state = torch.zeros(episodes, 13, dtype=torch.float64)
    state[:, 6] = 1
    middle = torch.zeros(episodes, 4, dtype=torch.float64)
    if isinstance(system, FixedWing):
        state, middle = system.trim(torch.full((episodes,), 11.5, dtype=torch.float64))
    else:
        middle[:, 0] = system.hover()
    at = world.start(state)
    states, actions = [], []
    action = middle
    with torch.no_grad():
        for row in range(rows):
            if row % 4 == 0:
                action = (middle + 0.4 * torch.randn(episodes, 4, generator=generator, dtype=torch.float64)).clamp(
                    -1, 1
                )
            states.append(at.state)
            actions.append(action)
            at = world.step(at, action)
    clean = torch.stack(states, 1)
    seen = (clean + NOISE * torch.randn(clean.shape, generator=generator, dtype=torch.float64)).numpy()
    commands = torch.stack(actions, 1).numpy()
    time = period * np.arange(rows)
    return Recording(
        tuple(Episode(time, commands[k], seen[k]) for k in range(episodes)),
        tuple(variable.name for variable in system.states),
        period,
        tuple(f"episode {k}" for k in range(episodes)),
    )


def diagnosed(system, effects=(), candidates=None):
    source = World(system, period=PERIODS[system.name])
    return diagnose(record(system, effects), source, catalogue=candidates)


def test_each_profile_covers_the_columns_of_its_system():
    for kind, profile in PROFILES.items():
        n = len(kind.states)
        assert len(profile.initial_variance) == n
        assert len(profile.driven_columns) == len(kind.loads)
        assert sorted(column for sensor in profile.sensors for column in sensor) == list(range(n))
        names = {variable.name for variable in (*kind.states, *getattr(kind, "actions", ()))} | {"time"}
        assert {*profile.region_variables.values(), *profile.plotted_variables} <= names


def test_effects_may_be_separable_on_one_system_only():
    names = {kind: {e.name for e in searched(catalogue(kind()), kind())} for kind in (CartPole, Quadrotor)}
    assert not {"constant_force", "actuator_bias"} <= names[CartPole]
    assert {"constant_force", "actuator_bias"} <= names[Quadrotor]
    assert not {"thrust_gain", "payload"} <= names[Quadrotor]


def test_a_quadrotor_without_effects_has_no_gap():
    result = diagnosed(Quadrotor(), candidates=[LinearDrag, ThrustGain, ActuatorDelay])
    assert result.verdict == "no_gap"
    assert result.gap.before == pytest.approx(result.gap.floor, rel=0.1)


def test_a_wind_is_found_without_a_grid():
    truth = {"velocity_x": 3.0, "velocity_y": -1.5, "velocity_z": 0.5, "coefficient": 0.4}
    result = diagnosed(Quadrotor(), [Wind(**truth)], [LinearDrag, ConstantForce, Wind, ThrustGain])
    assert [cause.effect for cause in result.causes] == ["wind"]
    for name, estimate in result.causes[0].parameters.items():
        half = (estimate.ci90[1] - estimate.ci90[0]) / 2
        assert estimate.value == pytest.approx(truth[name], abs=3 * half)
    assert result.gap.closed > 0.9


def test_a_wing_s_lift_slope_is_named_with_its_size():
    result = diagnosed(FixedWing(), [LiftSlope(scale=0.8)], [LinearDrag, ConstantForce, LiftSlope, ThrustGain])
    assert [cause.effect for cause in result.causes] == ["lift_slope"]
    estimate = result.causes[0].parameters["scale"]
    assert estimate.value == pytest.approx(0.8, abs=1.5 * (estimate.ci90[1] - estimate.ci90[0]))
    assert result.where.stages["dynamics"] == 1.0


@pytest.mark.parametrize(
    ("system", "effect", "true"),
    [(Quadrotor(), LinearDrag(coefficient=0.5), 0.5), (FixedWing(), LiftSlope(scale=0.8), 0.8)],
)
def test_flights_need_not_be_equally_long(system, effect, true):
    whole = record(system, [effect])
    cut = [
        Episode(one.time[:rows], one.action[:rows], one.state[:rows])
        for one, rows in zip(whole.episodes, (25, 24, 22, 17, 11), strict=True)
    ]
    result = diagnose(
        dataclasses.replace(whole, episodes=tuple(cut)), World(system, period=whole.period), [type(effect)]
    )
    assert [cause.effect for cause in result.causes] == [effect.name]
    (estimate,) = result.causes[0].parameters.values()
    assert estimate.value == pytest.approx(true, abs=1.5 * (estimate.ci90[1] - estimate.ci90[0]))


@pytest.mark.parametrize("system", [Quadrotor(), FixedWing()])
def test_velocities_that_lag_behind_their_positions_are_left_out(system):
    whole = record(system, rows=60)
    episodes = []
    for one in whole.episodes:
        state = one.state.copy()
        for row in range(1, len(state)):  # a filter of two periods
            state[row, 3:6] = state[row - 1, 3:6] + (one.state[row, 3:6] - state[row - 1, 3:6]) / 3
        episodes.append(dataclasses.replace(one, state=state))
    lagging = dataclasses.replace(whole, episodes=tuple(episodes))
    result = diagnose(lagging, World(system, period=whole.period), [ThrustGain, LinearDrag])
    assert sum("left out" in warning for warning in result.warnings) == 3
    assert result.verdict == "no_gap"


def test_a_flight_goes_on_before_the_first_fix_of_a_window():
    """At 11.5 m/s it is 3 m farther from fix to fix."""
    whole = record(FixedWing(), rows=60)
    read = np.ones((60, 13), bool)
    read[:, :6] = (np.arange(60) % 6 == 0)[:, None]
    fixes = dataclasses.replace(whole, usable=(read,) * len(whole.episodes))
    result = diagnose(fixes, World(FixedWing(), period=whole.period), [ThrustGain, LinearDrag])
    assert result.verdict == "no_gap"
    assert result.recording.noise["x"].value == pytest.approx(0.01, rel=0.2)


@pytest.mark.parametrize("speed", [0.2, 1.0])
def test_a_vehicle_that_hardly_moves_does_not_show_its_drag(speed):
    """The wind draws it away; in 4 s it comes to 0.7 of its speed."""
    system, rows = Quadrotor(), 40
    wind = Wind(velocity_x=speed, velocity_y=0.0, velocity_z=0.0, coefficient=0.3)
    world, generator = World(system, [wind.double()], period=0.1, substeps=10), torch.Generator().manual_seed(0)
    hover = torch.tensor([[system.hover(), 0, 0, 0]], dtype=torch.float64)
    state = torch.zeros(1, 13, dtype=torch.float64)
    state[:, 6] = 1
    at, states = world.start(state), []
    with torch.no_grad():
        for _ in range(rows):
            states.append(at.state[0] + 0.1 * NOISE * torch.randn(13, generator=generator, dtype=torch.float64))
            at = world.step(at, hover)
    seen = torch.stack(states).numpy()
    episode = Episode(0.1 * np.arange(rows), hover.expand(rows, -1).numpy(), seen)
    names = tuple(variable.name for variable in system.states)
    found = diagnose(
        Recording((episode,), names, 0.1, ("run",)), World(system, period=0.1), catalogue=[LinearDrag, Wind]
    )
    assert [cause.effect for cause in found.causes] == ["wind"]
    assert any("the vehicle hardly moves" in warning for warning in found.warnings) == (speed == 0.2)


def test_the_command_reads_a_quadrotor_s_csv(tmp_path, capsys, monkeypatch):
    # Not by its dotted name, which is that of the function.
    module = importlib.import_module("visadapt.diagnosis.diagnose")
    monkeypatch.setattr(module, "all_effects", lambda system: [LinearDrag, ThrustGain])
    recording = record(Quadrotor(), [LinearDrag(coefficient=0.5)], episodes=4)
    columns = ["episode", "time", *recording.measured, *(variable.name for variable in Quadrotor.actions)]
    lines = [",".join(columns)]
    for number, episode in enumerate(recording.episodes):
        for row in zip(episode.time, episode.state, episode.action, strict=True):
            values = (row[0], *row[1], *row[2])
            lines.append(",".join([str(number), *(f"{value:.6f}" for value in values)]))
    path = tmp_path / "flight.csv"
    path.write_text("\n".join(lines) + "\n")
    rig = tmp_path / "rig.toml"
    rig.write_text("[parameters]\nmass = 1.0\n")
    out, page = tmp_path / "out.json", tmp_path / "out.html"
    asked = ["--system", "quadrotor", "--params", str(rig), "--json", str(out), "--report", str(page)]
    assert main(["diagnose", str(path), *asked]) == 0
    assert "linear drag" in capsys.readouterr().out.lower()
    answer = json.loads(out.read_text())
    assert (answer["system"], answer["verdict"]) == ("quadrotor", "identified")
    assert answer["causes"][0]["parameters"]["coefficient"]["value"] == pytest.approx(0.5, rel=0.1)
    assert "force along x" in page.read_text()


def test_a_quaternion_s_sign_does_not_matter():
    recording = record(Quadrotor(), episodes=2)
    flipped = []
    for episode in recording.episodes:
        state = episode.state.copy()
        state[7:15, 6:10] *= -1
        flipped.append(Episode(episode.time, episode.action, state))
    rows, again = (
        prepare(each, Quadrotor()).rows for each in (recording, dataclasses.replace(recording, episodes=tuple(flipped)))
    )
    torch.testing.assert_close(again.measured, rows.measured)


def test_terms_of_theorem_1_need_a_system_with_one_action():
    with pytest.raises(ValueError, match="one action"):
        diagnose(record(Quadrotor(), episodes=1), World(Quadrotor(), period=0.1), policy=lambda state: state[:, :4])


def test_a_satellite_receiver_is_late_by_what_it_is_at_any_speed():
    """Positions and velocities with its noise, 0.2 s late at 11 m/s: 2 m behind from the first row on."""
    whole, late = record(FixedWing(), episodes=3, rows=64), 4
    generator = np.random.default_rng(0)
    episodes = []
    for episode in whole.episodes:
        state = episode.state[late:].copy()
        state[:, :6] = episode.state[:-late, :6] + 0.3 * generator.standard_normal((len(state), 6))
        episodes.append(Episode(episode.time[late:] - episode.time[late], episode.action[late:], state))
    rows = prepare(dataclasses.replace(whole, episodes=tuple(episodes)), FixedWing()).rows
    found = Search(FixedWing(), rows, [PositioningDelay]).single(PositioningDelay)
    assert found.fits.theta.item() == pytest.approx(0.2, abs=0.01)
