"""The blind flights: their physics against the library's, which is other code; sealed, and told by their columns."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.blind.flight_onestep import system_of
from benchmarks.blind.scoring import sizes
from datasets.blind import flights
from datasets.blind.flight_kinds import NAMED, NEUTRAL, REST, named
from datasets.blind.flight_plants import PLANTS, RESTING, Motion, quadrotor, step
from datasets.blind.flight_sensing import sensed
from datasets.blind.flights import ACTIONS, NOISE, STATES, Settings, as_states, lines, main, make
from visadapt.effects import EFFECTS, DynamicsEffect
from visadapt.effects.catalogue import catalogue
from visadapt.systems import SYSTEMS
from visadapt.systems.rigid_body import rotation
from visadapt.world import World

SYSTEM_NAMES = tuple(PLANTS)


@pytest.mark.parametrize("system", SYSTEM_NAMES)
def test_columns_are_the_library_s(system):
    assert tuple(variable.name for variable in SYSTEMS[system].states) == STATES
    assert tuple(variable.name for variable in SYSTEMS[system].actions) == ACTIONS[system]


@pytest.mark.parametrize(
    ("kind", "system"),
    [(kind, system) for kind, systems in NAMED + REST for system in systems],
    ids=lambda x: getattr(x, "name", x),
)
def test_an_effect_is_the_catalogue_s(kind, system):
    """The derivative of a random motion with the effect, by both codes."""
    rng = np.random.default_rng(0)
    parameters = kind.build(kind.high / 2, kind.draw(rng, 10.0))
    effect = EFFECTS[kind.name](**parameters).double()
    assert isinstance(SYSTEMS[system](), effect.systems)
    if not isinstance(effect, DynamicsEffect):
        return
    generator = torch.Generator().manual_seed(1)
    count = 6
    state = torch.randn(count, 13, generator=generator, dtype=torch.float64)
    state[:, 3] += 12.0
    state[:, 6:10] = torch.nn.functional.normalize(0.3 * state[:, 6:10] + torch.tensor([1.0, 0, 0, 0]), dim=1)
    command = torch.rand(count, 4, generator=generator, dtype=torch.float64) - 0.5
    time = torch.full((count,), 0.7, dtype=torch.float64)
    with torch.no_grad():
        at = World(SYSTEMS[system](), [effect]).start(state)
        world = World(SYSTEMS[system](), [effect])
        at = type(at)(time, state, at.memory)
        altered = world.system_at(at)
        expected = altered.derivative(state, command, world.load(at))
    p = {
        name: np.full(
            count, parameters.get(name.split(".")[1], neutral) if name.split(".")[0] == kind.name else neutral
        )
        for name, neutral in NEUTRAL.items()
    }
    motion = Motion(
        state[:, :3].numpy(), state[:, 3:6].numpy(), rotation(state[:, 6:10]).numpy(), state[:, 10:].numpy(), RESTING
    )
    found = PLANTS[system](p, 0.7, motion, command.numpy())
    np.testing.assert_allclose(found.velocity, expected[:, 3:6].numpy(), atol=1e-5)
    np.testing.assert_allclose(found.rates, expected[:, 10:].numpy(), atol=1e-5)
    np.testing.assert_allclose(as_states(motion, None)[:, 6:10], state[:, 6:10].numpy(), atol=1e-5)


@pytest.mark.parametrize("kind", [kind for kind, _ in NAMED + REST], ids=lambda kind: kind.name)
def test_every_named_effect_has_a_size_that_is_scored(kind):
    parameters = kind.build(kind.high, kind.draw(np.random.default_rng(0), 10.0))
    assert sizes(kind.name).keys() <= parameters.keys() == {p.name for p in EFFECTS[kind.name].table}


@pytest.mark.parametrize("system", SYSTEM_NAMES)
def test_every_effect_of_the_catalogue_is_drawn_once(system):
    # Tests register effects of their own.
    own = [effect for effect in catalogue(SYSTEMS[system]()) if effect.__module__.startswith("visadapt.")]
    effects = sorted(effect.name for effect in own)
    assert sorted(kind.name for kind in named("all", system)) == effects
    assert sorted(kind.name for kind in named("core", system) + named("rest", system)) == effects


@pytest.mark.parametrize("kind", ["attitude_offset", "rate_offset", "positioning_delay"])
def test_sensors_read_as_the_catalogue_s(kind):
    """Readings of three rows, of which the vehicle's positions are known at their halves too, by both codes."""
    period, generator = 0.1, torch.Generator().manual_seed(0)
    state = 0.3 * torch.randn(2, 13, generator=generator, dtype=torch.float64)
    state[:, 6] += 1.0
    world = World(SYSTEMS["quadrotor"](), (), period / 2)
    command = torch.zeros(2, 4, dtype=torch.float64)
    parameters = {
        "attitude_offset": {"roll": 0.1, "pitch": -0.2, "yaw": 0.3},
        "rate_offset": {"x": 0.1, "y": -0.2, "z": 0.3},
        "positioning_delay": {"delay": period / 2},
    }[kind]
    reads = World(SYSTEMS["quadrotor"](), [EFFECTS[kind](**parameters).double()], period, substeps=2)
    with torch.no_grad():
        halves = [world.start(state)]
        for _ in range(5):
            halves.append(world.step(halves[-1], command))
        at, expected = reads.start(state), []
        for _ in range(3):
            seen, at = reads.measure(at)
            expected.append(seen.numpy())
            at = reads.step(at, command)
    path = np.stack([half.state.numpy() for half in halves])
    p = {name: np.full(2, parameters.get(name.removeprefix(f"{kind}."), neutral)) for name, neutral in NEUTRAL.items()}
    found = sensed(p, path[::2], path[..., :6], period / 2)
    # The library interpolates between rows.
    np.testing.assert_allclose(found, expected, atol=1e-3 if kind == "positioning_delay" else 1e-7)


def test_lagging_motors_are_the_catalogue_s():
    """Two seconds of a quadrotor under steps of the command, by both codes."""
    constant, period, substeps = 0.06, 0.1, 20
    effect = EFFECTS["motor_lag"](time_constant=constant).double()
    world = World(SYSTEMS["quadrotor"](), [effect], period, substeps=substeps)
    state = torch.zeros(1, 13, dtype=torch.float64)
    state[:, 6] = 1.0
    at = world.start(state)
    p = {name: np.full(1, neutral) for name, neutral in NEUTRAL.items()}
    p["motor_lag.time_constant"][:] = constant
    motion = Motion(np.zeros((1, 3)), np.zeros((1, 3)), np.eye(3)[None], np.zeros((1, 3)), RESTING)
    rng = np.random.default_rng(0)
    for row in range(20):
        command = rng.uniform(-0.5, 0.5, (1, 4))
        with torch.no_grad():
            at = world.step(at, torch.as_tensor(command))
        for k in range(substeps):
            now = row * period + k * period / substeps
            motion = step(quadrotor, p, now, motion, command, period / substeps)
    # The library's substep has the mean of a lagging command, and the two lag gyroscopic torques differently.
    np.testing.assert_allclose(as_states(motion, at.state[:, 6:10].numpy()), at.state.numpy(), atol=2e-3)


def test_a_dropout_repeats_rows_at_its_rate():
    drafts = make(Settings(Path("unused"), "fixed_wing", 6, seed=2, effects="rest"))
    dropped = [draft for draft in drafts if draft.kind is not None and draft.kind.name == "dropout"]
    assert dropped
    for draft in dropped:
        repeats = (draft.readings[1:] == draft.readings[:-1]).all(-1)
        assert repeats.mean() == pytest.approx(draft.effects["dropout"]["rate"], abs=0.05)
        assert draft.strength == pytest.approx(draft.target, rel=0.25)
        moves = np.abs(np.diff(draft.readings, axis=0))[~repeats]
        assert (moves > 0.01 * NOISE).mean() > 0.9


def test_a_set_is_sealed_and_the_same_again(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(flights, "ROWS", 25)  # of 100, for the time it takes
    settings = Settings(tmp_path / "sealed", "fixed_wing", 3, seed=2)
    main(settings)
    assert "SHA-256" in capsys.readouterr().out
    key = json.loads((tmp_path / "sealed.key.json").read_text())
    files = sorted((tmp_path / "sealed").iterdir())
    assert [file.name for file in files] == [recording["file"] for recording in key["recordings"]]
    assert system_of(files[0]) == "fixed_wing"
    again = "\n".join(lines(make(settings)[0], "fixed_wing")) + "\n"
    assert files[0].read_text() == again
    with pytest.raises(ValueError, match="must not lie"):
        main(Settings(tmp_path, "quadrotor", 1, key=tmp_path / "key.json"))


def test_a_cart_pole_s_recording_is_told_by_its_columns(tmp_path):
    path = Path(tmp_path / "cart.csv")
    path.write_text("episode,time,x,theta,command\n0,0,0,0,0\n")
    assert system_of(path) == "cartpole"
