"""Recordings of lab machines: clock, encoders and derived velocities, as the file shows them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from datasets.blind.chain import NEUTRAL, Actuation
from datasets.blind.drafts import Draft, draw_case, lines
from datasets.blind.gaps import DIFFICULTIES, draw_kinds
from datasets.blind.kinds import INSEPARABLE, KINDS
from datasets.blind.plant import MAX_FORCE, nominal
from datasets.blind.rigs import Rig, draw_rig, late_rows, late_steps
from datasets.blind.simulation import simulate
from datasets.blind.table import ROWS

COUNTS = (1e-4, 2 * np.pi / 4096)
ROWS_OF, EPISODES = 60, 2


def barto(s, force):
    """Barto et al. (1983) as they wrote it."""
    _, v, a, w = s
    temp = (force + 0.05 * w**2 * np.sin(a)) / 1.1
    acceleration = (9.8 * np.sin(a) - np.cos(a) * temp) / (0.5 * (4 / 3 - 0.1 * np.cos(a) ** 2 / 1.1))
    return [v, temp - 0.05 * acceleration * np.cos(a) / 1.1, w, acceleration]


def record(rig, noise=(0.0, 0.0, 0.0, 0.0), **effects):
    case = draw_case(np.random.default_rng(5), ROWS_OF, EPISODES, np.array(noise), rig, False, 0.5)
    case.effects = effects
    (run,) = simulate([case], 50)
    return case, run


def table(case, run):
    """The file's columns by name, of its first episode."""
    header, *rows = lines(Draft(np.random.default_rng(0), "none", case, run))
    values = np.array([[float(cell) for cell in row.split(",")] for row in rows])
    return dict(zip(header.split(","), values[values[:, 0] == 0].T, strict=True))


@pytest.fixture
def unsteady():
    return Rig(0.02, late_steps(np.random.default_rng(1), ROWS_OF, EPISODES, 0.004), COUNTS, "absent")


def test_a_command_acts_from_its_stamp_to_the_next(unsteady):
    case, run = record(unsteady)
    told = table(case, run)
    assert np.diff(told["time"]).min() > 0.02
    assert 0.0235 < np.diff(told["time"]).max() <= 0.024
    state = run.true[0, :, 0]
    for row in range(20):
        span = told["time"][row : row + 2]
        force = MAX_FORCE * told["command"][row]
        solved = solve_ivp(lambda t, s, force=force: barto(s, force), span, state, method="DOP853", rtol=1e-10)
        state = solved.y[:, -1]
        # Half a count of the encoder, and what little the two solvers differ.
        assert abs(told["x"][row + 1] - state[0]) < 0.5e-4 + 1e-5
        assert abs(told["theta"][row + 1] - state[2]) < np.pi / 4096 + 1e-5


def test_encoders_count_whole_steps(unsteady):
    told = table(*record(unsteady))
    for name, count in zip(("x", "theta"), COUNTS, strict=True):
        counted = told[name] / count
        np.testing.assert_allclose(counted, np.round(counted), atol=1e-2)
        assert len(np.unique(np.round(counted))) > 10


def test_rows_off_the_grid_do_not_fall_behind():
    told = table(*record(Rig(late=late_rows(np.random.default_rng(1), ROWS_OF, EPISODES, 0.01))))
    behind = told["time"] - 0.05 * np.arange(ROWS_OF)
    assert behind.min() >= 0
    assert 0.005 < behind.max() <= 0.01


@pytest.mark.parametrize(("velocities", "constant"), [("differences", 0.0), ("filtered", 0.04)])
def test_velocities_are_derived_from_the_positions_that_the_file_shows(unsteady, velocities, constant):
    told = table(*record(replace(unsteady, velocities=velocities, time_constant=constant)))
    passed = np.diff(told["time"])
    for name in ("x", "theta"):
        expected = [0.0]
        for change, lasted in zip(np.diff(told[name]), passed, strict=True):
            weight = 1 - np.exp(-lasted / constant) if constant else 1.0
            expected.append(expected[-1] + weight * (change / lasted - expected[-1]))
        # Positions are written to 0.1 um and 0.1 urad.
        np.testing.assert_allclose(told[f"{name}_dot"], expected, atol=2e-5)


def test_a_late_reading_is_of_the_state_that_long_before(unsteady):
    exact = replace(unsteady, counts=(0.0, 0.0), velocities="measured")
    case, run = record(exact, measurement_delay={"delay": 0.03})
    told, times = table(case, run), run.times[:, 0]
    seen = np.interp(times - 0.03, times, run.true[:, 0, 0])
    # A straight line between rows is off by a'' h^2 / 8.
    np.testing.assert_allclose(told["x"], seen, atol=2e-3)
    assert np.abs(told["x"] - run.true[:, 0, 0]).max() > 4e-3


def test_a_delay_counts_from_a_commands_own_stamp():
    chain = {name: np.array([value]) for name, value in NEUTRAL.items()} | {"actuator_delay.delay": np.array([0.0123])}
    actuation, heard = Actuation(chain, 1), []
    for stamp, command, until in ((0.0, 1.0, 0.023), (0.023, 0.0, 0.043)):
        actuation.push(stamp, np.array([command]))
        heard += [actuation(t, 1e-3)[0] for t in np.arange(stamp, until - 5e-4, 1e-3)]
    np.testing.assert_allclose(heard, [0.0] * 12 + [0.7] + [1.0] * 22 + [0.3] + [0.0] * 7, atol=1e-8)


def test_a_cart_that_sticks_stands_still_while_its_pole_swings():
    plant, times = nominal(1), np.arange(0.0, 0.5, 1e-3)
    plant.dry_forces.append((np.array([0]), {}, lambda p, t, s: np.array([3.0])))
    state, angles = np.array([[0.0], [0.0], [0.1], [0.0]]), []
    for t in times:
        angles.append(state[2, 0])
        state = plant.step(t, state, np.array([1.0]), 1e-3)
    assert state[1, 0] == 0.0
    # A hundredth of a count.
    assert abs(state[0, 0]) < 1e-6
    # The pole alone, about a pivot that is held: 4/3 l theta'' = g sin(theta).
    alone = solve_ivp(
        lambda t, s: [s[1], 9.8 * np.sin(s[0]) / (4 / 3 * 0.5)], (0, 0.5), [0.1, 0.0], t_eval=times, rtol=1e-10
    )
    np.testing.assert_allclose(angles, alone.y[0], atol=1e-3)


def test_dry_friction_turns_round_where_the_velocity_does():
    ends = []
    for steps in (50, 500):
        plant, state, h = nominal(1), np.array([[0.0], [0.3], [0.02], [0.1]]), 0.05 / steps
        plant.turns_exactly = True
        plant.dry_forces.append((np.array([0]), {}, lambda p, t, s: np.array([1.3])))
        for force in 6.0 * np.sin(0.2 * np.pi * np.arange(10)):
            for _ in range(steps):
                state = plant.step(0.0, state, np.array([-force]), h)
        ends.append(state[:, 0])
    # A tenth of a count of 0.1 mm, after half a second at 1 ms; turning a substep late misses by more than one.
    assert abs(ends[0][0] - ends[1][0]) < 1e-5


def test_lab_machines_differ_and_last_as_long_as_asked():
    drawn = [draw_rig(np.random.default_rng(seed), 20.0, 4) for seed in range(60)]
    assert {rig.period for rig, _ in drawn} == {0.01, 0.02, 0.05}
    assert {rig.velocities for rig, _ in drawn} == {"absent", "measured", "differences", "filtered"}
    assert {rig.late is None for rig, _ in drawn} == {True, False}
    for rig, rows in drawn:
        times, lengths = rig.clock(rows, 4)
        assert 19.5 < 4 * rows * rig.period < 20.5
        assert lengths.min() >= 0.8 * rig.period - 1e-6
        assert lengths.max() <= rig.longest + 1e-6
        np.testing.assert_allclose(np.diff(times, axis=0), lengths[:-1], atol=1e-12)


def test_pairs_of_a_lab_set_are_dry_friction_and_another_that_is_not_one_effect_with_it():
    rng = np.random.default_rng(0)
    others = set()
    for _ in range(300):
        first, second = draw_kinds(rng, "pair", "all", DIFFICULTIES["rig"].in_pairs)
        assert first == "coulomb_friction"
        others.add(second)
    assert not others & {"constant_force", "actuator_bias", "directional_friction", "stribeck_friction"}
    assert len(others) > 15


def test_the_table_shows_every_effect_that_two_others_imitate():
    singles = {next(iter(row.effects)) for row in ROWS if len(row.effects) == 1}
    assert all(together <= singles for together in INSEPARABLE if len(together) == 3)
    assert {effect for row in ROWS for effect in row.effects} <= KINDS.keys()
