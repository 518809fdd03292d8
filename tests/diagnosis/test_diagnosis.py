"""What a user asks of a diagnosis: the right name, size and verdict, on recordings made with the cause withheld."""

import dataclasses
import functools

import numpy as np
import pytest
import torch

from tests.diagnosed import NOISE, record
from visadapt import diagnose
from visadapt.diagnosis.report.text import as_text
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.words import A_ROW_LATE, PART_LATE
from visadapt.effects import (
    ActuatorBacklash,
    ActuatorBias,
    ActuatorDelay,
    ActuatorGain,
    AngleDelay,
    AngleOffset,
    CartMass,
    ConstantForce,
    CoulombFriction,
    Dropout,
    DynamicsEffect,
    FrictionPatch,
    FrozenZone,
    Gust,
    Parameter,
    PeriodicForce,
    PoleDamping,
    PoleFriction,
    PoleMass,
    PositionDelay,
    QuadraticDrag,
    ViscousFriction,
)
from visadapt.effects.forces import CartForce
from visadapt.recordings import Episode
from visadapt.systems import CartPole
from visadapt.world import World

SOURCE = World(CartPole())

IMITATING = [ViscousFriction, CoulombFriction, QuadraticDrag, PoleMass, AngleOffset, ConstantForce]
IMITATING += [ActuatorBacklash, ActuatorGain, ActuatorDelay, ActuatorBias]
"""Effects that imitate each other."""

STICKING = [FrozenZone, Dropout, AngleOffset, AngleDelay, ViscousFriction]
"""Ways to read what was, and others."""


def names(result):
    return {cause.effect for cause in result.causes}


def with_repeats(recording, marks, columns):
    """The recording with readings of some columns replaced, in marked rows, by those of the row before."""
    episodes = []
    for episode, own in zip(recording.episodes, marks, strict=True):
        state = episode.state.copy()
        for row in np.flatnonzero(own):
            state[row, columns] = state[row - 1, columns]
        episodes.append(Episode(episode.time, episode.action, state))
    return dataclasses.replace(recording, episodes=tuple(episodes))


@pytest.fixture(scope="module")
def plain():
    """A recording of the source."""
    return record()


@functools.cache
def found_among_imitations(effect, **values):
    """The diagnosis of a recording with one effect."""
    return diagnose(record([effect(**values)]), SOURCE, IMITATING)


def test_a_recording_of_the_source_has_no_gap(plain):
    result = diagnose(plain, SOURCE)
    assert result.verdict == "no_gap"
    assert result.causes == ()
    assert result.gap.before == pytest.approx(result.gap.floor, rel=0.05)


def test_the_noise_of_each_sensor_that_was_read_is_said(plain):
    found = diagnose(plain, SOURCE, ())
    noise = found.recording.noise
    assert noise.keys() == {"x", "theta"}
    assert (noise["x"].unit, noise["theta"].unit) == ("m", "rad")
    assert [one.value for one in noise.values()] == pytest.approx([0.002, 0.002], rel=0.15)
    assert "noise, standard deviation: x 0.0" in as_text(found)


def test_a_source_with_effects_is_refused_by_their_names(plain):
    world = World(CartPole(), [ViscousFriction(coefficient=0.8), AngleOffset(offset=0.02)])
    with pytest.raises(ValueError, match="the world has viscous_friction and angle_offset; give the source without"):
        diagnose(plain, world)


@pytest.mark.parametrize(("step", "verdict"), [(0.002, "no_gap"), (0.1, "unexplained")])
def test_a_gap_may_hide_in_coarse_steps_of_an_encoder(step, verdict, plain):
    read = [np.stack((e.state[:, 0], step * np.round(e.state[:, 1] / step)), 1) for e in plain.episodes]
    episodes = tuple(Episode(e.time, e.action, state) for e, state in zip(plain.episodes, read, strict=True))
    result = diagnose(dataclasses.replace(plain, episodes=episodes), SOURCE, IMITATING)
    assert result.verdict == verdict
    assert result.causes == ()
    assert any(f"theta is read in steps of {step:g} rad" in warning for warning in result.warnings) == (step == 0.1)
    assert ("finer steps" in result.next_experiment) == (step == 0.1)


def test_a_gap_may_hide_in_the_noise_of_a_velocity_that_is_read_wrong():
    whole = record(measured=("x", "x_dot", "theta", "theta_dot"))
    wrong = [np.stack((e.state[:, 0], 1.2 * e.state[:, 1], *e.state[:, 2:].T), 1) for e in whole.episodes]
    episodes = tuple(Episode(e.time, e.action, state) for e, state in zip(whole.episodes, wrong, strict=True))
    result = diagnose(dataclasses.replace(whole, episodes=episodes), SOURCE, IMITATING)
    assert result.verdict == "unexplained"
    assert "error of the reading of x dot" in result.next_experiment


def test_one_effect_that_explains_as_much_as_two_is_listed_beside_them():
    hidden = [Gust(start=0.4, end=1.3, force=-0.25), ActuatorBias(offset=-0.0015)]
    recording = record(hidden, episodes=6, rows=50, seed=4, noise=(0.005, 0.01, 0.009, 0.01))
    result = diagnose(recording, SOURCE, [PeriodicForce, Gust, ActuatorBias])
    assert result.verdict == "ambiguous"
    alike = {cause.effect: set(cause.indistinguishable_from) for cause in result.causes}
    both = {"gust", "actuator_bias"}
    assert alike == {"periodic_force": both, "gust": {"periodic_force"}, "actuator_bias": {"periodic_force"}}
    assert len(result.causes) == 3
    assert {effect.name for effect in result.effects()} in (both, {"periodic_force"})
    assert str(result).startswith("ambiguous: Either ")


def test_on_a_heavy_machine_effects_are_found_beyond_the_ranges_of_a_light_one():
    """Ten times the default's masses: within its ranges a patch of friction and dry friction in the hinge are named."""
    heavy = CartPole(cart_mass=10.0, pole_mass=1.0, max_force=300.0)
    hidden = [ViscousFriction(coefficient=40.0), PoleDamping(coefficient=0.5)]
    rivals = [FrictionPatch, PoleFriction, CoulombFriction]
    recording = record(hidden, episodes=3, rows=40, system=heavy)
    result = diagnose(recording, World(heavy), [ViscousFriction, PoleDamping, *rivals])
    found = {cause.effect: cause.parameters["coefficient"] for cause in result.causes}
    assert result.verdict == "identified"
    assert found.keys() == {"viscous_friction", "pole_damping"}
    assert found["viscous_friction"].value == pytest.approx(40.0, rel=0.05)
    assert found["pole_damping"].value == pytest.approx(0.5, rel=0.2)


@pytest.mark.parametrize(
    ("effect", "name", "truth"),
    [(ViscousFriction, "coefficient", 0.8), (AngleOffset, "offset", 0.02), (ActuatorBacklash, "width", 0.05)],
    ids=["viscous_friction", "angle_offset", "actuator_backlash"],
)
def test_one_effect_is_named_with_its_size(effect, name, truth):
    if effect is AngleOffset:
        result = diagnose(record([AngleOffset(offset=truth)]), SOURCE)  # among all effects there are
    else:
        result = found_among_imitations(effect, **{name: truth})
    assert effect.name in names(result)
    cause = next(c for c in result.causes if c.effect == effect.name)
    assert cause.parameters.keys() == {name}
    estimate = cause.parameters[name]
    assert estimate.value == pytest.approx(truth, rel=0.2)
    assert estimate.ci90[0] < estimate.value < estimate.ci90[1]
    assert result.gap.closed > 0.9
    for shown in result.figures.predictions:
        assert np.sqrt(np.nanmean((shown.corrected - shown.measured) ** 2)) < 3 * NOISE[0]


def diagnosed_push():
    few = [ConstantForce, ActuatorBias, ActuatorGain, ViscousFriction, Dropout]
    return diagnose(record([ConstantForce(force=0.5)]), SOURCE, few)


@pytest.fixture(scope="module")
def pushed():
    return diagnosed_push()


def test_effects_that_no_data_can_separate_are_named_together(pushed):
    result = pushed
    assert result.verdict == "ambiguous"
    assert {"constant_force", "actuator_bias"} <= names(result)
    force, bias = (next(c for c in result.causes if c.effect == n) for n in ("constant_force", "actuator_bias"))
    assert bias.effect in force.indistinguishable_from
    assert force.parameters["force"].value == pytest.approx(0.5, rel=0.1)
    assert bias.parameters["offset"].value == pytest.approx(0.5 / 30, rel=0.1)
    assert "motor" in result.next_experiment


def test_twins_have_intervals_of_the_same_relative_width():
    clean = record([ConstantForce(force=2.0)], measured=[v.name for v in CartPole.states], noise=(1e-6,) * 4)
    result = diagnose(clean, World(CartPole()), catalogue=[ActuatorBias, ConstantForce, ViscousFriction])
    offset, force = (next(iter(cause.parameters.values())) for cause in result.causes)
    assert force.value == pytest.approx(2.0, rel=1e-3)
    widths = [(each.ci90[1] - each.ci90[0]) / each.value for each in (offset, force)]
    assert widths[1] == pytest.approx(widths[0], rel=0.3), "noise of the fit without either widened the second's"


def test_two_simultaneous_effects_are_both_named(only_effects):
    only_effects("viscous_friction", "coulomb_friction", "actuator_gain", "cart_mass", "actuator_lag")
    result = diagnose(record([ViscousFriction(coefficient=1.5), ActuatorGain(scale=0.8)]), SOURCE)
    assert "viscous_friction" in names(result)
    assert names(result) & {"actuator_gain", "cart_mass"}
    assert sum(result.where.stages.values()) == pytest.approx(1)


def test_a_heavier_cart_is_not_a_weaker_motor_with_a_lighter_pole(only_effects):
    only_effects("cart_mass", "actuator_gain", "pole_mass", "pole_length")
    result = diagnose(record([CartMass(scale=1.8)], rows=40, measured=("x", "x_dot", "theta", "theta_dot")), SOURCE)
    assert names(result) == {"cart_mass"}
    assert result.causes[0].parameters["scale"].value == pytest.approx(1.8, rel=0.02)
    assert result.causes[0].gap_reopened > 0.9


def test_two_large_effects_are_both_named(only_effects):
    only_effects("coulomb_friction", "stribeck_friction", "actuator_gain", "cart_mass")
    effects = [CoulombFriction(force=3.0), ActuatorGain(scale=0.7)]
    result = diagnose(record(effects, episodes=2, measured=("x", "x_dot", "theta", "theta_dot")), SOURCE)
    carrying = {cause.effect: cause for cause in result.causes if not cause.slight}
    assert carrying.keys() == {"coulomb_friction", "actuator_gain"}
    assert carrying["coulomb_friction"].parameters["force"].value == pytest.approx(3.0, rel=0.02)


def test_the_region_of_a_friction_patch_is_found(only_effects):
    only_effects("friction_patch", "viscous_friction", "spring", "actuator_gain")
    result = diagnose(record([FrictionPatch(start=-0.1, end=0.15, coefficient=6.0)], episodes=6), SOURCE)
    assert names(result) == {"friction_patch"}
    region = result.where.regions[0]
    assert region.variable == "x"
    assert region.start == pytest.approx(-0.1, abs=0.03)
    assert region.end == pytest.approx(0.15, abs=0.03)


def test_an_effect_outside_the_catalogue_is_unexplained():
    class Cogging(CartForce):
        table = (Parameter("force", "N", 0.0, 5.0, 0.0),)

        def push(self, time, state, system):
            return self.value("force", state) * (60 * state[:, 0]).sin()

    result = diagnose(record([Cogging(force=1.0)], episodes=2, rows=40), SOURCE)
    assert result.verdict == "unexplained"
    assert result.causes == ()
    assert "cart force" in result.next_experiment


def test_lost_rows_are_counted():
    generator = np.random.default_rng(0)
    whole = record(episodes=6)
    lost = [(generator.random(len(e.time)) < 0.1) & (np.arange(len(e.time)) > 0) for e in whole.episodes]
    result = diagnose(with_repeats(whole, lost, [0, 1]), SOURCE, STICKING)
    assert names(result) == {"dropout"}
    rate = sum(marks.sum() for marks in lost) / sum(len(marks) - 1 for marks in lost)
    assert result.causes[0].parameters["rate"].value == pytest.approx(rate)
    assert result.causes[0].parameters["rate"].ci90[0] < rate < result.causes[0].parameters["rate"].ci90[1]


def test_a_heavier_pole_is_named_with_what_else_moves_alike():
    result = diagnose(record([PoleMass(scale=3.0)]), SOURCE, catalogue=[PoleMass, ViscousFriction])
    assert names(result) == {"pole_mass"}
    assert any("weigh the pole" in warning for warning in result.warnings)
    other = found_among_imitations(ViscousFriction, coefficient=0.8)
    assert not any("weigh the pole" in warning for warning in other.warnings)


def test_a_late_sensor_is_named_with_its_delay(only_effects):
    late = ("angle_delay", "position_delay", "measurement_delay", "actuator_delay", "actuator_lag")
    only_effects(*late, "angle_offset", "viscous_friction")
    result = diagnose(record([AngleDelay(delay=0.02)]), SOURCE)
    assert names(result) == {"angle_delay"}
    low, high = result.causes[0].parameters["delay"].ci90
    assert low < 0.02 < high < 0.03


@pytest.mark.parametrize("others", [[], [CoulombFriction(force=1.5)]])
def test_a_sensor_later_than_a_row_is_found_also_where_the_joint_stops(only_effects, others):
    only_effects("coulomb_friction", "position_delay", "angle_delay")
    measured, noise = ("x", "x_dot", "theta", "theta_dot"), (2e-4, 0.005, 5e-4, 0.005)
    recording = record([*others, PositionDelay(delay=0.08)], 2, 40, measured=measured, noise=noise)
    result = diagnose(recording, SOURCE)
    assert names(result) == {"position_delay", *(effect.name for effect in others)}
    delay = next(cause for cause in result.causes if cause.effect == "position_delay")
    assert delay.parameters["delay"].value == pytest.approx(0.08, abs=0.002)


def test_a_sensor_that_stands_still_is_found_with_its_zone():
    whole = record(episodes=6)
    still = [(e.state[:, 1] > 0.02) & (e.state[:, 1] < 0.06) & (np.arange(len(e.time)) > 0) for e in whole.episodes]
    result = diagnose(with_repeats(whole, still, [1]), SOURCE, STICKING)
    assert names(result) == {"frozen_zone"}
    region = result.where.regions[0]
    assert region.variable == "theta"
    assert region.start == pytest.approx(0.02, abs=0.006)
    assert region.end == pytest.approx(0.06, abs=0.006)


def test_velocities_differentiated_from_positions_are_left_out():
    whole = record([ViscousFriction(coefficient=0.8)], measured=("x", "x_dot", "theta", "theta_dot"))
    assert prepare(whole, CartPole()).warnings == ()
    episodes = []
    for episode in whole.episodes:
        state = episode.state.copy()
        for k in (1, 3):
            state[:, k] = np.diff(state[:, k - 1], prepend=state[0, k - 1]) / 0.05
        episodes.append(Episode(episode.time, episode.action, state))
    prepared = prepare(dataclasses.replace(whole, episodes=tuple(episodes)), CartPole())
    assert [warning.split()[0] for warning in prepared.warnings] == ["x_dot", "theta_dot"]
    assert prepared.rows.channels == (0, 2)


@pytest.mark.parametrize("effects", [(), (ViscousFriction(coefficient=2.0), CoulombFriction(force=1.0))])
def test_commands_recorded_a_row_late_are_moved_up(effects):
    whole = record(effects)
    late = [np.concatenate((each.action[:1], each.action[:-1])) for each in whole.episodes]
    episodes = [dataclasses.replace(each, action=action) for each, action in zip(whole.episodes, late, strict=True)]
    prepared = prepare(dataclasses.replace(whole, episodes=tuple(episodes)), CartPole())
    assert [warning for warning in prepared.warnings if A_ROW_LATE in warning]
    rows = len(late[0]) - 1  # the last command is not known
    assert torch.equal(prepared.rows.command[:, :rows], prepare(whole, CartPole()).rows.command[:, :rows])


@pytest.mark.parametrize("effects", [(), (ViscousFriction(coefficient=2.0),)])
def test_commands_whose_stamps_are_late_by_part_of_a_row_are_moved_by_it(effects):
    # Commands a row late, and a delay of less than a row: each acts 0.02 s before the row that it is in.
    whole = record([*effects, ActuatorDelay(delay=0.03)])
    late = [np.concatenate((each.action[:1], each.action[:-1])) for each in whole.episodes]
    episodes = [dataclasses.replace(each, action=action) for each, action in zip(whole.episodes, late, strict=True)]
    recording = dataclasses.replace(whole, episodes=tuple(episodes), command_period=whole.period)
    prepared = prepare(recording, CartPole(), [ActuatorDelay, ViscousFriction, ActuatorGain])
    (said,) = [warning for warning in prepared.warnings if PART_LATE in warning]
    assert float(said.split()[3]) == pytest.approx(0.02, abs=0.003)


@pytest.fixture(scope="module")
def forced():
    """A recording of a cart that is pushed steadily."""
    return record([ConstantForce(force=1.0)], rows=40)


@pytest.mark.parametrize(
    ("name", "states", "command"), [("angle", (1, -1), 1), ("command", (1, 1), -1), ("position", (-1, 1), 1)]
)
def test_a_quantity_of_opposite_sign_is_inverted_and_the_cause_keeps_its_own(name, states, command, forced):
    turned = tuple(Episode(e.time, command * e.action, e.state * np.array(states)) for e in forced.episodes)
    result = diagnose(dataclasses.replace(forced, episodes=turned), SOURCE, catalogue=[ConstantForce, AngleOffset])
    assert any(f"the {name} has the opposite sign" in warning for warning in result.warnings)
    assert f"gap to the simulator. That holds with the {name} inverted: as it is, " in str(result)
    assert not any(A_ROW_LATE in warning for warning in result.warnings)
    assert names(result) == {"constant_force"}
    assert result.causes[0].parameters["force"].value == pytest.approx(1.0, rel=0.05)


def test_an_effect_of_the_users_own_is_found():
    class Magnet(DynamicsEffect):
        table = (Parameter("torque", "N m", -1.0, 1.0, 0.0, linear=True),)
        equation = "Q_theta = torque cos(3 theta)"

        def load(self, time, state, system):
            import torch

            torque = self.value("torque", state) * (3 * state[:, 2] + 20 * state[:, 0]).cos()
            return torch.stack((torch.zeros_like(torque), torque), -1)

    Magnet.name = "magnet_of_ours"
    result = diagnose(record([Magnet(torque=0.05)]), SOURCE, catalogue=[Magnet, ViscousFriction, ConstantForce])
    assert names(result) == {"magnet_of_ours"}
    assert result.causes[0].parameters["torque"].value == pytest.approx(0.05, rel=0.1)


def test_a_repeated_diagnosis_is_equal(pushed):
    assert diagnosed_push().to_json() == pushed.to_json()


def test_probabilities_sum_to_one(pushed):
    assert sum(ranked.probability for ranked in pushed.ranking) == pytest.approx(1)
    assert all(0 <= cause.probability <= 1 for cause in pushed.causes)


def test_error_grows_with_the_horizon(pushed):
    growth = pushed.figures.growth
    assert growth is not None
    before, after, _, floor = (curve.values for curve in growth.curves)
    assert before[-1] > 3 * before[0]
    assert after[-1] == pytest.approx(floor[-1], rel=0.1)


@pytest.mark.parametrize(("episodes", "held_out"), [(1, "on held-out stretches,"), (2, "on held-out episodes,")])
def test_the_gap_says_what_was_held_out(episodes, held_out):
    result = diagnose(record([ConstantForce(force=1.0)], episodes), SOURCE, catalogue=[ConstantForce])
    assert held_out in result.gap.measure
