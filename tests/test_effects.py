import importlib.util
import math
import pickle

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn
from torch.func import functional_call

from visadapt.effects import EFFECTS, ConstantForce, Effect, Stage
from visadapt.systems import CartPole
from visadapt.world import World

NAMED = sorted(EFFECTS.keys() - {"residual"})
"""The effects with parameters; the residual, a network, has tests of its own in test_world.py."""

ON_CART = [name for name in NAMED if issubclass(CartPole, EFFECTS[name].systems)]

SMOOTH = [name for name in ON_CART if not EFFECTS[name].no_gradient]

PERIOD, STEPS = 0.05, 3

STRONG = {
    "actuator_saturation": {"limit": 0.3},
    "gust": {"start": 0.02, "end": 0.1, "force": 5.0},
    "friction_patch": {"start": -1.0, "end": 1.0, "coefficient": 10.0},
    "frozen_zone": {"start": -0.3, "end": 0.4},
}
"""Parameters that show in a few steps, where 80 % of every range do not."""


def from_table(name, batch=None):
    """Hypothesis strategy: parameters of the effect `name` within their ranges, scalars or lists of `batch`."""

    def draws(parameter):
        numbers = st.floats(parameter.low, parameter.high)
        return numbers if batch is None else st.lists(numbers, min_size=batch, max_size=batch)

    return st.fixed_dictionaries({parameter.name: draws(parameter) for parameter in EFFECTS[name].table})


def build(name, values):
    """The effect in double precision; a list is one value for each row."""
    return EFFECTS[name](**{key: torch.tensor(value) for key, value in values.items()}).double()


def world_of(*effects, system=None):
    return World(system or CartPole(), effects, PERIOD, "rk4", substeps=3)


def inputs(batch, seed=0):
    """States (batch, 4) and actions (STEPS, batch, 1), away from the limits of the command."""
    generator = torch.Generator().manual_seed(seed)
    state = 0.5 * torch.randn(batch, 4, generator=generator, dtype=torch.float64)
    actions = 1.8 * torch.rand(STEPS, batch, 1, generator=generator, dtype=torch.float64) - 0.9
    return state, actions


def readings(world, state, actions):
    """What is measured (STEPS + 1, B, 4) of a run."""
    generator = torch.Generator().manual_seed(1)
    measured, at = world.measure(world.start(state), generator)
    seen = [measured]
    for action in actions:
        measured, at = world.measure(world.step(at, action), generator)
        seen.append(measured)
    return torch.stack(seen)


class Steps(nn.Module):
    """A few steps of a world as one function of its parameters, the state and the actions."""

    def __init__(self, world):
        super().__init__()
        self.world = world

    def forward(self, state, actions):
        return readings(self.world, state, actions)


def assert_gradients_agree(function, values, limits):
    """Gradients against finite differences, at kinks too: there they lie between the slopes on both sides.

    `limits` holds (low, high) for each input, which no difference steps over, or None.
    """
    leaves = [value.detach().clone().requires_grad_() for value in values]
    grads = torch.autograd.grad(function(*leaves), leaves)
    h = 1e-6
    values = [value.detach() for value in values]
    centre = float(function(*values))
    for position, (value, grad, limit) in enumerate(zip(values, grads, limits, strict=True)):
        for place in range(value.numel()):
            slopes = []
            for step in (-h, h):
                moved = value.clone()
                moved.view(-1)[place] += step
                at = float(moved.view(-1)[place])
                if limit is None or limit[0] <= at <= limit[1]:
                    other = [moved if k == position else v for k, v in enumerate(values)]
                    slopes.append((float(function(*other)) - centre) / step)
            tolerance = 1e-4 * (1 + max(abs(slope) for slope in slopes))
            found = float(grad.reshape(-1)[place])
            assert min(slopes) - tolerance <= found <= max(slopes) + tolerance, (position, place, found, slopes)


@pytest.mark.parametrize("name", ON_CART)
class TestContract:
    """What every effect promises, whoever writes it."""

    def test_it_is_at_a_stage_and_those_it_is_mistaken_for_are_mistaken_for_it(self, name):
        assert EFFECTS[name].stage in Stage
        for twin in EFFECTS[name].indistinguishable_from:
            assert name in EFFECTS[twin].indistinguishable_from

    def test_it_states_equation_source_units_and_ranges(self, name):
        effect = EFFECTS[name]
        assert effect.name == name
        assert effect.equation
        assert effect.source
        assert effect.table
        for parameter in effect.table:
            assert parameter.unit
            assert parameter.low < parameter.high
            assert parameter.neutral is None or parameter.low <= parameter.neutral <= parameter.high
        assert any(parameter.neutral is not None for parameter in effect.table)

    def test_unknown_and_missing_parameters_are_named(self, name):
        with pytest.raises(ValueError, match=f"{name} takes the parameters .*; got colour"):
            EFFECTS[name](colour=1.0)
        with pytest.raises(ValueError, match=f"{name} takes the parameters .*; got none"):
            EFFECTS[name]()

    @given(data=st.data())
    @settings(max_examples=10)
    def test_neutral_parameters_change_nothing(self, name, data):
        values = data.draw(from_table(name))
        values |= {p.name: p.neutral for p in EFFECTS[name].table if p.neutral is not None}
        state, actions = inputs(4)
        torch.testing.assert_close(
            readings(world_of(build(name, values)), state, actions),
            readings(world_of(), state, actions),
            rtol=0,
            atol=1e-12,
        )

    def test_it_does_something(self, name):
        values = STRONG.get(name, {p.name: p.low + 0.8 * (p.high - p.low) for p in EFFECTS[name].table})
        state, actions = inputs(4)
        moved = readings(world_of(build(name, values)), state, actions) - readings(world_of(), state, actions)
        assert moved.abs().max() > 1e-4

    @given(data=st.data())
    @settings(max_examples=5)
    def test_it_pickles(self, name, data):
        effect = build(name, data.draw(from_table(name)))
        copy = pickle.loads(pickle.dumps(effect))
        state, actions = inputs(2)
        assert type(copy) is type(effect)
        assert torch.equal(readings(world_of(copy), state, actions), readings(world_of(effect), state, actions))

    def test_device_and_dtype_come_from_the_tensors(self, name):
        values = {p.name: 0.5 * (p.low + p.high) for p in EFFECTS[name].table}
        world = world_of(EFFECTS[name](**values))
        state, actions = inputs(2)
        assert readings(world, state, actions).dtype == torch.float64
        assert readings(world, state.float(), actions.float()).dtype == torch.float32

    def test_what_its_linear_parameters_add_is_proportional_to_them(self, name):
        table = EFFECTS[name].table
        linear = [p for p in table if p.linear]
        values = STRONG.get(name, {p.name: p.low + 0.7 * (p.high - p.low) for p in table})
        (state, actions), h = inputs(4), PERIOD

        def added(share):
            """What the effect adds when its linear parameters have gone a share of the way from neutral."""
            own = values | {p.name: p.neutral + share * (values[p.name] - p.neutral) for p in linear}
            effect = build(name, own)
            if effect.stage is Stage.DYNAMICS:
                return effect.load(torch.linspace(0.03, 0.09, 4, dtype=torch.float64), state, CartPole())
            if effect.stage is Stage.ACTUATION:
                commands = actions.transpose(0, 1)
                return effect.apply_to(commands, effect.memory(commands, h), h)[0] - commands
            return effect.apply_to(state, effect.memory(state, h), h, torch.Generator())[0] - state

        if linear:
            assert added(1.0).abs().max() > 1e-3
            torch.testing.assert_close(added(0.0), torch.zeros_like(added(0.0)), rtol=0, atol=1e-12)
            torch.testing.assert_close(added(0.3), 0.3 * added(1.0), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", SMOOTH)
class TestSmoothContract:
    """What every effect promises but those that say why they have no gradient."""

    @given(data=st.data())
    @settings(max_examples=10)
    def test_gradients_agree_with_finite_differences(self, name, data):
        world = Steps(world_of(build(name, data.draw(from_table(name)))))
        parameters = dict(world.named_parameters())
        # Beyond the value that switches an effect off there may be none at all: a negative delay.
        limits = {
            p.name: (p.low if p.neutral == p.low else -math.inf, p.high if p.neutral == p.high else math.inf)
            for p in EFFECTS[name].table
        }
        state, actions = inputs(2)
        # Every reading counts, each with its own weight.
        weights = torch.linspace(-1, 1, 8 * (STEPS + 1), dtype=torch.float64).reshape(STEPS + 1, 2, 4)

        def total(state, actions, *values):
            out = functional_call(world, dict(zip(parameters, values, strict=True)), (state, actions))
            return (out * weights).sum()

        assert_gradients_agree(
            total,
            [state, actions, *parameters.values()],
            [None, None, *(limits[key.rsplit(".", 1)[1]] for key in parameters)],
        )

    @given(data=st.data())
    @settings(max_examples=10)
    def test_a_row_does_not_depend_on_its_batch(self, name, data):
        """Nor on whether its parameters are scalars or entries of (B,)."""
        batch = 3
        values = data.draw(from_table(name, batch))
        state, actions = inputs(batch)
        together = readings(world_of(build(name, values)), state, actions)
        for b in range(batch):
            own = {key: value[b] for key, value in values.items()}
            alone = readings(world_of(build(name, own)), state[b : b + 1], actions[:, b : b + 1])
            torch.testing.assert_close(together[:, b], alone[:, 0], rtol=1e-10, atol=1e-12)


def test_an_effect_without_gradient_says_why():
    assert {name: EFFECTS[name].no_gradient for name in set(ON_CART) - set(SMOOTH)} == {
        "dropout": "whether a row is lost is drawn, yes or no"
    }


def test_the_catalogue_is_complete():
    assert set(NAMED) == {
        *("actuator_gain", "actuator_bias", "actuator_delay", "actuator_lag", "actuator_deadzone"),
        *("actuator_saturation", "actuator_backlash", "constant_force", "periodic_force", "gust"),
        *("viscous_friction", "coulomb_friction", "quadratic_drag", "friction_patch", "spring", "pole_damping"),
        *("track_tilt", "cart_mass", "pole_mass", "pole_length", "angle_offset", "position_offset"),
        *("measurement_delay", "sensor_scale", "frozen_zone", "dropout", "linear_drag"),
    }


def test_an_effect_in_a_file_of_its_own_joins_by_being_imported(tmp_path):
    path = tmp_path / "my_rig.py"
    path.write_text(
        """
from visadapt.effects import DynamicsEffect, Parameter


class Fan(DynamicsEffect):
    name = "fan"
    equation = "F = force"
    source = "the lab"
    table = (Parameter("force", "N", 0.0, 2.0, 0.0, linear=True),)

    def load(self, time, state, system):
        return super().load(time, state, system) + self.value("force", state)
"""
    )
    spec = importlib.util.spec_from_file_location("my_rig", path)
    try:
        spec.loader.exec_module(importlib.util.module_from_spec(spec))
        state, actions = inputs(2)
        moved = readings(world_of(build("fan", {"force": 1.0})), state, actions)
        assert (moved - readings(world_of(), state, actions)).abs().max() > 1e-3
    finally:
        EFFECTS.pop("fan", None)


def test_two_effects_cannot_share_a_name():
    with pytest.raises(ValueError, match=r"'constant_force' is taken by visadapt\.effects\.forces\.ConstantForce"):
        type("Mine", (Effect,), {"name": "constant_force"})
    assert EFFECTS["constant_force"] is ConstantForce
