"""The contract of named effects: hidden in a finely integrated target and recorded, each is found again.

Every effect with every system that it acts on, whoever wrote it: new ones are tested as they register. Parameters must
lie within what the noise allows: 3 standard deviations of the fit's own covariance, and COARSE.
"""

from typing import Any

import pytest
import torch

from visadapt.effects import EFFECTS, FrozenZone, PositionOffset
from visadapt.effects.base import Stage
from visadapt.estimation.effect_fit import fit_effects
from visadapt.estimation.fit_states import neutral
from visadapt.systems import SYSTEMS, CartPole, FixedWing, Quadrotor
from visadapt.targets.synthetic import fine_world

COARSE = 0.005
"""Share of a parameter by which it may be off since the fit integrates more coarsely than the target."""

SHARE = 0.15
"""Of the way from neutral to the end of its range, where a parameter is hidden that HIDDEN does not name."""

HIDDEN = {
    "actuator_delay": {"delay": 0.07},
    "actuator_backlash": {"width": 0.2},
    "actuator_saturation": {"limit": 0.4},
    "wind": {"velocity_x": 3.0, "velocity_y": -2.0, "velocity_z": 1.0, "coefficient": 0.4},
    "periodic_wind": {"amplitude": 4.0, "frequency": 3.0, "phase": 0.5, "direction": 0.4, "coefficient": 0.4},
    "periodic_force": {"amplitude": 3.0, "frequency": 3.0, "phase": 0.5, "offset": 1.0},
    "gust": {"start": 0.2, "end": 0.55, "force": 4.0},
    "spring": {"stiffness": 8.0, "rest": 0.1},
    "friction_patch": {"start": -0.1, "end": 0.2, "coefficient": 8.0},
    "ground_effect": {"radius": 0.3, "ground": 0.2},
    "quadratic_drag": {"coefficient": 0.2},
    "measurement_delay": {"delay": 0.07},
    "dropout": {"rate": 0.2},
    "frozen_zone": {"start": -0.02, "end": 0.05},
    "sensor_scale": {"position": 1.1, "angle": 0.9},
    "position_offset": {"offset": 0.1},
}

PAIRS = [
    pytest.param(name, kind, id=f"{name}-{kind.name}")
    for name in sorted(EFFECTS.keys() - {"residual"})
    for kind in SYSTEMS.values()
    # States show nothing of a camera.
    if issubclass(kind, EFFECTS[name].systems) and EFFECTS[name].stage is not Stage.CAMERA
]


def hidden(kind):
    """The parameters (P,) of an effect in the target."""
    named = HIDDEN.get(kind.name, {})

    def value(p):
        if p.neutral is None:
            return 0.5 * (p.low + p.high)
        return p.neutral + SHARE * ((p.high if p.high > p.neutral else p.low) - p.neutral)

    return {p.name: named.get(p.name, value(p)) for p in kind.table}


def made(kind, values):
    return kind(**values).double().requires_grad_(False)


class Cart:
    episodes, rows, period = 10, 14, 0.05
    noise = torch.tensor([1e-3, 5e-3, 1e-3, 5e-3], dtype=torch.float64)
    gains = torch.tensor([0.08, 0.12, 1.3, 0.3], dtype=torch.float64)

    def start(self, generator):
        spread = torch.tensor([0.2, 0.3, 0.03, 0.1], dtype=torch.float64)
        return spread * torch.randn(self.episodes, 4, generator=generator, dtype=torch.float64)

    def command(self, state, push):
        return (state @ self.gains)[:, None] + 0.25 * push


class Hover:
    episodes, rows, period = 8, 10, 0.02
    noise = torch.full((13,), 5e-4, dtype=torch.float64)

    def start(self, generator):
        state = torch.zeros(self.episodes, 13, dtype=torch.float64)
        state[:, :6] = torch.randn(self.episodes, 6, generator=generator, dtype=torch.float64)
        state[:, 2] = 0.7 + 0.2 * state[:, 2]
        state[:, 6] = 1.0
        return state

    def command(self, state, push):
        return 0.3 * push


class Glide(Hover):
    def start(self, generator):
        trim = FixedWing().trim(torch.tensor([11.5]))[0].double()
        off = torch.zeros(self.episodes, 13, dtype=torch.float64)
        off[:, 3:6] = torch.randn(self.episodes, 3, generator=generator, dtype=torch.float64)
        return trim + off


SETUPS: dict[str, Any] = {"cartpole": Cart(), "quadrotor": Hover(), "fixed_wing": Glide()}


def record(kind, effects, seed=0):
    """What sensors read, the true states (E, T, n), and the commands (E, T, n_action), of episodes of the target."""
    setup, system = SETUPS[kind.name], kind()
    generator = torch.Generator().manual_seed(seed)
    world = fine_world(system, effects, setup.period)
    at = world.start(setup.start(generator))
    read: list[torch.Tensor] = []
    clean: list[torch.Tensor] = []
    true, given = [], []
    for row in range(setup.rows):
        if row % 6 == 0:
            push = torch.randn(setup.episodes, len(system.actions), generator=generator, dtype=torch.float64)
        measured, at = world.measure(at, generator)
        noisy = measured + setup.noise * torch.randn(measured.shape, generator=generator, dtype=torch.float64)
        read.append(torch.where(held(effects, measured, clean[-1], at.state), read[-1], noisy) if row else noisy)
        clean.append(measured)
        true.append(at.state)
        given.append(setup.command(at.state, push).clamp(-1, 1))
        at = world.step(at, given[-1])
    return tuple(torch.stack(rows, 1) for rows in (read, true, given))


def held(effects, measured, last, state):
    """Which readings (E, n) repeat the last ones exactly, noise and all, as those of real sensors that are held do."""
    out = (measured == last).all(1, keepdim=True).expand(-1, measured.shape[1]).clone()
    for effect in effects:
        if isinstance(effect, FrozenZone):
            # The effect's own edges are smooth, so that near them its readings do not repeat to the last digit.
            out[:, 2:] |= ((state[:, 2] > effect.start) & (state[:, 2] < effect.end))[:, None]
    return out


def fitted(kind, *effects, seed=0):
    """The fit from neutral values, the true states, and what sensors read."""
    measured, true, commands = record(kind, [made(each, hidden(each)) for each in effects], seed)
    starts = [made(each, dict(zip((p.name for p in each.table), neutral(each), strict=True))) for each in effects]
    return fit_effects(kind(), starts, list(measured), list(commands), SETUPS[kind.name].period), true, measured


def assert_found(fit, effect):
    truth = torch.tensor(list(hidden(effect).values()), dtype=torch.float64)
    width = torch.tensor([p.high - p.low for p in effect.table], dtype=torch.float64)
    allowed = 3 * fit.covariance[effect].diagonal().sqrt() + COARSE * torch.minimum(width, truth.abs())
    assert ((fit.values[effect] - truth).abs() <= allowed).all(), (fit.values[effect], truth, allowed)


@pytest.mark.parametrize(("name", "kind"), PAIRS)
def test_an_effect_that_was_recorded_is_found_again(name, kind):
    fit, true, measured = fitted(kind, EFFECTS[name])
    assert_found(fit, EFFECTS[name])
    if name != "position_offset":
        smoothed, read = (
            (states - true).square().mean((0, 1)).sqrt() for states in (torch.stack(fit.states), measured)
        )
        assert (smoothed < 0.9 * read).all(), (smoothed, read)


def test_an_offset_that_no_data_show_is_said_to_be_unknown():
    fit, _, _ = fitted(CartPole, PositionOffset)
    (parameter,) = PositionOffset.table
    assert float(fit.covariance[PositionOffset].sqrt()) > 0.05 * (parameter.high - parameter.low)


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        (CartPole, ["viscous_friction", "actuator_delay", "periodic_force"]),
        (CartPole, ["angle_offset", "frozen_zone", "coulomb_friction", "dropout"]),
        (Quadrotor, ["linear_drag", "actuator_lag", "constant_force"]),
    ],
    ids=lambda value: "+".join(value) if isinstance(value, list) else value.name,
)
def test_several_at_once_are_found_together(kind, names):
    effects = [EFFECTS[name] for name in names]
    fit, _, _ = fitted(kind, *effects)
    for effect in effects:
        assert_found(fit, effect)


def test_the_values_that_effects_have_are_one_of_the_starts():
    """From far off, a search would do: from the true values no other ones are found."""
    effect = EFFECTS["periodic_force"]
    measured, _, commands = record(CartPole, [made(effect, hidden(effect))])
    fit = fit_effects(CartPole(), [made(effect, hidden(effect))], list(measured), list(commands), Cart.period)
    assert_found(fit, effect)


def test_two_that_passive_data_cannot_tell_apart_are_refused():
    pair = [made(EFFECTS[name], {"delay": 0.0}) for name in ("measurement_delay", "actuator_delay")]
    with pytest.raises(ValueError, match="cannot tell apart measurement_delay and actuator_delay"):
        fit_effects(CartPole(), pair, [torch.zeros(3, 4)], [torch.zeros(3, 1)], 0.05)
