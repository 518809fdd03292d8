"""The blind recordings: their physics against an independent solver, and the seal on their key."""

import hashlib
import json
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from datasets.blind.chain import NEUTRAL, Actuation, Sensing
from datasets.blind.drafts import CART_REACH, POLE_REACH, lines
from datasets.blind.gaps import Settings, key_text, main, make
from datasets.blind.kinds import FOREIGN, KINDS, LATER, NAMED, REST, drawn
from datasets.blind.plant import MAX_FORCE, PERIOD, nominal, predict
from datasets.blind.simulation import Case, simulate
from visadapt.effects.base import Stage
from visadapt.effects.catalogue import catalogue
from visadapt.systems import CartPole


def barto(t, s, force, torque=0.0):
    """Barto et al. (1983) as they wrote it, with a torque at the pivot."""
    _, v, a, w = s
    total, pl = 1.1, 0.05
    temp = (force + pl * w**2 * np.sin(a)) / total
    acceleration = (9.8 * np.sin(a) - np.cos(a) * temp + torque / pl) / (0.5 * (4 / 3 - 0.1 * np.cos(a) ** 2 / total))
    return [v, temp - pl * acceleration * np.cos(a) / total, w, acceleration]


def solve(start, commands, push, torque=lambda t, s: 0.0, first=0):
    """States at the rows from `first` on, by scipy's Runge-Kutta of order 8; push(t, s, row) is the force in N."""
    states = [np.asarray(start)]
    for row in range(first, first + len(commands)):
        span = row * PERIOD, (row + 1) * PERIOD
        solution = solve_ivp(
            lambda t, s, row=row: barto(t, s, push(t, s, row), torque(t, s)),
            span,
            states[-1],
            method="DOP853",
            rtol=1e-10,
            atol=1e-12,
            max_step=0.002,
        )
        states.append(solution.y[:, -1])
    return np.array(states[:-1])


COUNTS: dict[Literal["easy", "hard"], int] = {"easy": 1, "hard": 2}


@pytest.fixture(scope="module")
def drafts():
    return {kind: make(Settings(Path("unused"), kind, count, seed=3)) for kind, count in COUNTS.items()}


def cut(drafts):
    """A recording's case without its effects, cut to 2 s."""
    case = drafts["hard"][0].case
    rows = 40
    driver = case.driver
    driver = type(driver)(
        driver.gain, None, driver.start, driver.excitation[:rows], driver.reference[:rows], driver.description
    )
    return Case(driver, {}, case.noise[:rows], case.loss_draws[:rows])


@pytest.fixture
def bare(drafts):
    return cut(drafts)


@pytest.fixture(scope="module")
def quiet(drafts):
    """The run of the case without effects."""
    return simulate([cut(drafts)], 10)[0]


def law(effects):
    """The same effects, written down a second time."""
    p = {name: dict(parameters) for name, parameters in effects.items()}

    def force(t, s, u):
        total = MAX_FORCE * u * p.get("actuator_gain", {}).get("scale", 1.0)
        total -= p.get("viscous_friction", {}).get("coefficient", 0.0) * s[1]
        if gust := p.get("gust"):
            total += gust["force"] * (gust["start"] <= t < gust["end"])
        if wave := p.get("periodic_force"):
            total += wave["amplitude"] * np.cos(2 * np.pi * wave["frequency"] * t + wave["phase"]) + wave["offset"]
        if dry := p.get("coulomb_friction"):
            total -= dry["force"] * np.tanh(s[1] / 1e-4)
        return total

    def torque(t, s):
        return -p.get("pole_damping", {}).get("coefficient", 0.0) * s[3]

    return force, torque


@pytest.mark.parametrize(
    "effects",
    [
        {},
        {"viscous_friction": {"coefficient": 2.0}, "pole_damping": {"coefficient": 0.02}},
        {"gust": {"start": 0.5, "end": 1.2, "force": 1.5}, "actuator_gain": {"scale": 0.8}},
        {"periodic_force": {"amplitude": 1.0, "frequency": 1.3, "phase": 0.4, "offset": -0.3}},
    ],
    ids=lambda effects: "+".join(effects) or "none",
)
def test_trajectories_are_those_of_an_independent_solver(bare, effects):
    bare.effects = effects
    run = simulate([bare], 50)[0]
    force, torque = law(effects)
    u = run.commands[:, 0]
    # Anew every half second, since the pole's instability multiplies any error by 3,000 in 2 s.
    for first in range(0, len(u), 10):
        own = slice(first, first + 10)
        expected = solve(run.true[first, :, 0], u[own], lambda t, s, row: force(t, s, u[row]), torque, first)
        # A fiftieth of the easy set's noise.
        np.testing.assert_allclose(run.true[own, :, 0], expected, atol=2e-5)


def test_dry_friction_stops_a_coasting_cart_and_holds_it():
    plant = nominal(1)
    plant.dry_forces.append((np.array([0]), {}, lambda p, t, s: np.array([2.2])))
    state = np.array([[0.0], [0.5], [np.pi], [0.0]])  # hanging, so that the pole's own motion stays small
    for k in range(1000):
        state = plant.step(k * 1e-3, state, np.array([0.0]), 1e-3)
    assert state[1, 0] == 0.0
    # 1.1 kg against 2.2 N: 0.5^2 / (2 * 2) m, a little more or less for the pole that swings on.
    assert state[0, 0] == pytest.approx(0.0625, abs=0.01)


def test_dry_friction_while_sliding_is_coulombs_law():
    plant = nominal(1)
    plant.dry_forces.append((np.array([0]), {}, lambda p, t, s: np.array([1.0])))
    state = np.array([[0.0], [2.0], [0.05], [0.0]])
    expected = solve(state[:, 0], np.zeros(6), lambda t, s, row: -1.0)
    rows = [state[:, 0]]
    for row in range(5):
        for k in range(50):
            state = plant.step(row * PERIOD + k * 1e-3, state, np.array([0.0]), 1e-3)
        rows.append(state[:, 0])
    np.testing.assert_allclose(rows, expected, atol=1e-5)


def test_a_tilted_track_balances_along_gravity():
    plant = nominal(1)
    plant.tilt[:] = 0.1
    state = np.array([[0.0], [0.0], [0.1], [0.0]])
    holding = 1.1 * 9.8 * np.sin(0.1)  # N uphill
    for _ in range(500):
        state = plant.step(0.0, state, np.array([holding]), 1e-3)
    np.testing.assert_allclose(state[:, 0], [0.0, 0.0, 0.1, 0.0], atol=1e-9)


def chain(**values):
    return {name: np.array([values.get(name.replace(".", "__"), value)]) for name, value in NEUTRAL.items()}


def test_a_delay_may_be_any_fraction():
    actuation = Actuation(chain(actuator_delay__delay=0.0123), 1)
    actuation.push(0.0, np.array([1.0]))
    heard = [actuation(k * 1e-3, 1e-3)[0] for k in range(50)]
    np.testing.assert_allclose(heard, [0.0] * 12 + [0.7] + [1.0] * 37, atol=1e-8)


def test_the_actuation_chain_has_its_order():
    values = {
        "actuator_backlash__width": 0.1,
        "actuator_deadzone__width": 0.2,
        "actuator_saturation__limit": 0.5,
        "actuator_gain__scale": 2.0,
        "actuator_bias__offset": 0.3,
    }
    actuation = Actuation(chain(**values), 1)
    heard = []
    for row, command in enumerate((0.5, 0.45, 1.0, -1.0)):
        actuation.push(row * PERIOD, np.array([command]))
        heard.append(float(actuation(row * PERIOD, 1e-3)[0]))
    # 0.5 -> 0.45 behind the play -> 0.25 -> 0.5 -> 0.8; then the play holds; then the limit, both ways.
    np.testing.assert_allclose(heard, [0.8, 0.8, 1.3, -0.7], atol=1e-8)


def test_a_lag_answers_a_step_exponentially_from_the_bias():
    actuation = Actuation(chain(actuator_lag__time_constant=0.02, actuator_bias__offset=0.1), 1)
    actuation.push(0.0, np.array([1.0]))
    heard = [actuation(k * 1e-3, 1e-3)[0] for k in range(20)]
    assert actuation.lagged[0] == pytest.approx(0.1 + 1 - np.exp(-1))
    assert heard[0] == pytest.approx(0.1 + 1 - 20 * (1 - np.exp(-0.05)))


def test_sensors():
    parameters = chain(
        sensor_scale__position=2.0, angle_offset__offset=0.1, frozen_zone__start=0.2, frozen_zone__end=0.3
    )
    sensing = Sensing(parameters, np.zeros((4, 1)), 1e-3)
    quiet, kept = np.zeros((4, 1)), np.ones(1)
    first, _ = sensing.read(0.0, np.array([[1.0], [0.5], [0.0], [3.0]]), quiet, kept)
    np.testing.assert_allclose(first[:, 0], [2.0, 1.0, 0.1, 3.0])
    inside, _ = sensing.read(0.05, np.array([[1.5], [0.5], [0.25], [4.0]]), quiet, kept)
    np.testing.assert_allclose(inside[:, 0], [3.0, 1.0, 0.1, 4.0])


def test_predictions_agree_with_an_independent_solver():
    start, commands = np.array([0.1, -0.3, 0.05, -0.1]), np.linspace(-0.02, 0.05, 10)
    expected = solve(start, [*commands, 0.0], lambda t, s, row: MAX_FORCE * [*commands, 0.0][row])[-1]
    # Coarser than the recordings, for a measure of strength: a twentieth of the easy set's noise.
    predicted = predict(start[:, None], commands[:, None])[:, 0]
    np.testing.assert_allclose(predicted[[0, 2]], expected[[0, 2]], atol=5e-5)


def test_recordings_stay_up_and_strengths_are_in_range(drafts):
    for kind, (weakest, strongest) in {"easy": (2, 30), "hard": (0.7, 6)}.items():
        for draft in drafts[kind]:
            x, theta = draft.run.reach
            assert x <= CART_REACH
            assert theta <= POLE_REACH
            assert all(0.9 * weakest <= strength <= 1.1 * strongest for strength in draft.strengths.values())


def test_kinds_are_named_once_and_shared_by_no_side():
    assert len(KINDS) == len(NAMED) + len(REST) + len(LATER) + len(FOREIGN)
    assert len(FOREIGN) >= 10


@pytest.mark.parametrize("kind", [k.name for k in NAMED + REST + LATER + FOREIGN])
def test_every_kind_acts(bare, quiet, kind):
    rng = np.random.default_rng(0)
    effect = KINDS[kind]
    bare.effects = {kind: effect.build(effect.high, effect.draw(rng, 2.0))}
    run = simulate([bare], 10)[0]
    changed = run.clean if effect.stage == "sensing" else run.true
    against = run.true if effect.stage == "sensing" else quiet.true
    assert np.abs(changed - against)[:, [0, 2]].max() > 1e-4


def test_every_effect_of_the_catalogue_is_drawn_once():
    assert sorted(k.name for k in drawn("single", "all") + REST) == sorted(
        # Tests register effects of their own; recordings of states show nothing of a camera.
        effect.name
        for effect in catalogue(CartPole())
        if effect.__module__.startswith("visadapt.") and effect.stage is not Stage.CAMERA
    )


def test_a_set_of_the_rest_has_what_no_recording_shows():
    (draft,) = make(Settings(Path("unused"), "easy", 1, seed=1, effects="rest"))
    assert draft.mixture == "none"
    offset = draft.case.effects["position_offset"]["offset"]
    np.testing.assert_allclose(draft.run.clean[:, 0] - draft.run.true[:, 0], offset)
    np.testing.assert_allclose(draft.run.clean[:, 1:], draft.run.true[:, 1:])


def test_the_key_is_sealed_and_everything_repeats(tmp_path, capsys, drafts):
    settings = Settings(tmp_path / "sealed", "hard", COUNTS["hard"], seed=3)
    main(settings)
    key = (tmp_path / "sealed.key.json").read_text()
    assert key == key_text(settings, drafts["hard"])
    assert capsys.readouterr().out.splitlines()[0] == f"SHA-256 of the key: {hashlib.sha256(key.encode()).hexdigest()}"
    files = sorted(path.name for path in settings.out.iterdir())
    assert files == ["0000.csv", "0001.csv"]
    assert [answer["file"] for answer in json.loads(key)["recordings"]] == files
    for file, draft in zip(files, drafts["hard"], strict=True):
        assert (settings.out / file).read_text().splitlines() == list(lines(draft))
    header, first = (settings.out / "0000.csv").read_text().splitlines()[:2]
    assert header == "episode,time,x,theta,command"
    assert first.startswith("0,0.00,")


def test_strengths_must_rise():
    with pytest.raises(ValueError, match="strengths are 6 and 2, must be positive and rise"):
        make(Settings(Path("unused"), "hard", 1, strengths=(6.0, 2.0)))


def test_the_key_may_not_lie_among_the_recordings(tmp_path):
    with pytest.raises(ValueError, match="must not lie in the folder"):
        main(Settings(tmp_path, "hard", 1, key=tmp_path / "key.json"))
