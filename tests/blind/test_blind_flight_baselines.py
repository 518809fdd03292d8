"""The baselines on flights: their one-step model leaves noise alone of flights by the library, and finds what acts."""

import numpy as np
import pytest
import torch

from benchmarks.blind.baselines import BASELINES, core, refit
from benchmarks.blind.fitting import fit
from benchmarks.blind.flight_onestep import flight_candidates, read_flights
from datasets.blind.flight_control import PERIODS
from datasets.blind.flights import NOISE
from visadapt.effects import EFFECTS
from visadapt.systems import SYSTEMS, FixedWing, Quadrotor
from visadapt.world import World


def flown(path, name, effect=None, **parameters):
    """The path of a recording of two noisy flights by the library."""
    system, period = SYSTEMS[name](), PERIODS[name]
    effects = [EFFECTS[effect](**parameters).double()] if effect else []
    world = World(system, effects, period, substeps=3).requires_grad_(False)
    generator = torch.Generator().manual_seed(0)
    state, middle = torch.zeros(2, 13, dtype=torch.float64), torch.zeros(2, 4, dtype=torch.float64)
    if isinstance(system, FixedWing):
        state, middle = system.trim(torch.full((2,), 11.5, dtype=torch.float64))
    elif isinstance(system, Quadrotor):
        state = torch.eye(13, dtype=torch.float64)[[6, 6]]
        middle[:, 0] = system.hover()
    at = world.start(state)
    lines = [",".join(["episode", "time", *(v.name for v in (*system.states, *system.actions))])]
    for row in range(30):
        action = middle + 0.15 * torch.randn(2, 4, generator=generator, dtype=torch.float64)
        read = at.state + torch.as_tensor(NOISE) * torch.randn(2, 13, generator=generator, dtype=torch.float64)
        for k in range(2):
            values = (period * row, *read[k].tolist(), *action[k].tolist())
            lines.append(",".join([str(k), *(f"{value:.7f}" for value in values)]))
        at = world.step(at, action)
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("name", PERIODS)
def test_of_a_flight_of_the_source_noise_is_left(name, tmp_path):
    path = flown(tmp_path / "flight.csv", name)
    guess = BASELINES["chance"](path)
    assert {effect for entry in guess["ranking"] for effect in entry["effects"]} <= set(core(name))
    data = read_flights(path)
    assert np.mean(np.square(data.residual(data.neutral)), 1) == pytest.approx(np.ones(13), abs=0.5)
    assert fit(data, ()).chi2 / data.size == pytest.approx(1, abs=0.15)


@pytest.mark.parametrize(
    ("name", "effect", "parameters"),
    [
        ("quadrotor", "linear_drag", {"coefficient": 0.6}),
        ("quadrotor", "periodic_force", {"amplitude": 1.5, "frequency": 0.5, "phase": 1.0, "offset": 0.0}),
        ("quadrotor", "actuator_delay", {"delay": 0.04}),
        ("fixed_wing", "lift_slope", {"scale": 0.7}),
    ],
)
def test_the_effect_that_acts_fits_to_its_own_size(name, effect, parameters, tmp_path):
    data = read_flights(flown(tmp_path / "flight.csv", name, effect, **parameters))
    (own,) = (candidate for candidate in flight_candidates(name) if candidate.effect == effect)
    found = fit(data, (own,))
    assert found.bic < fit(data, ()).bic
    assert found.chi2 / data.size == pytest.approx(1, abs=0.15)
    first = next(iter(parameters))
    value = np.hypot(found.values["periodic_force.cosine"], found.values["periodic_force.sine"])
    value = value if effect == "periodic_force" else found.values[f"{effect}.{first}"]
    assert value == pytest.approx(parameters[first], rel=0.15)


@pytest.mark.parametrize("name", PERIODS)
def test_what_is_tried_is_the_core_of_the_catalogue(name):
    assert sorted(candidate.effect for candidate in flight_candidates(name)) == core(name)


def test_refit_names_a_thrust_that_is_off_and_its_twin(tmp_path):
    answer = refit(flown(tmp_path / "flight.csv", "quadrotor", "thrust_gain", scale=0.93))
    assert (answer["system"], answer["verdict"]) == ("quadrotor", "ambiguous")
    cause = answer["causes"][0]
    assert (cause["effect"], cause["indistinguishable_from"]) == ("thrust_gain", ["payload"])
    # Its ridge shares the loss among gains that look alike.
    assert 0.9 < cause["parameters"]["scale"]["value"] < 0.99
