import math
import pickle

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn
from torch.func import functional_call

from tests.worlds import Mass, columns, run
from visadapt.effects import EFFECTS, ActuatorDelay, ConstantForce, Effect, PeriodicForce, ViscousFriction
from visadapt.systems import CartPole
from visadapt.world import World

NAMED = sorted(EFFECTS.keys() - {"residual"})
"""The effects with parameters; the residual, a network, has tests of its own in test_world.py."""

PERIOD, STEPS = 0.05, 3


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


class Steps(nn.Module):
    """A few steps of a world as one function of its parameters, the state and the actions."""

    def __init__(self, world):
        super().__init__()
        self.world = world

    def forward(self, state, actions):
        return run(self.world, state, actions)[-1]


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


@pytest.mark.parametrize("name", NAMED)
class TestContract:
    """What every effect promises, whoever writes it."""

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
    def test_gradients_agree_with_finite_differences(self, name, data):
        world = Steps(world_of(build(name, data.draw(from_table(name)))))
        parameters = dict(world.named_parameters())
        limits = {p.name: (p.low, p.high) for p in EFFECTS[name].table}
        state, actions = inputs(2)
        weights = torch.tensor([1.0, -0.7, 0.4, 0.3], dtype=torch.float64)

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
    def test_neutral_parameters_change_nothing(self, name, data):
        values = data.draw(from_table(name))
        values |= {p.name: p.neutral for p in EFFECTS[name].table if p.neutral is not None}
        state, actions = inputs(4)
        torch.testing.assert_close(
            run(world_of(build(name, values)), state, actions), run(world_of(), state, actions), rtol=0, atol=1e-12
        )

    def test_it_does_something(self, name):
        values = {p.name: p.low + 0.8 * (p.high - p.low) for p in EFFECTS[name].table}
        state, actions = inputs(4)
        moved = run(world_of(build(name, values)), state, actions) - run(world_of(), state, actions)
        assert moved[-1].abs().max() > 1e-4

    @given(data=st.data())
    @settings(max_examples=10)
    def test_a_row_does_not_depend_on_its_batch(self, name, data):
        """Nor on whether its parameters are scalars or entries of (B,)."""
        batch = 3
        values = data.draw(from_table(name, batch))
        state, actions = inputs(batch)
        together = run(world_of(build(name, values)), state, actions)
        for b in range(batch):
            own = {key: value[b] for key, value in values.items()}
            alone = run(world_of(build(name, own)), state[b : b + 1], actions[:, b : b + 1])
            torch.testing.assert_close(together[:, b], alone[:, 0], rtol=1e-10, atol=1e-12)

    @given(data=st.data())
    @settings(max_examples=5)
    def test_it_pickles(self, name, data):
        effect = build(name, data.draw(from_table(name)))
        copy = pickle.loads(pickle.dumps(effect))
        state, actions = inputs(2)
        assert type(copy) is type(effect)
        assert torch.equal(run(world_of(copy), state, actions), run(world_of(effect), state, actions))

    def test_device_and_dtype_come_from_the_tensors(self, name):
        values = {p.name: 0.5 * (p.low + p.high) for p in EFFECTS[name].table}
        world = world_of(EFFECTS[name](**values))
        state, actions = inputs(2)
        assert run(world, state, actions).dtype == torch.float64
        assert run(world, state.float(), actions.float()).dtype == torch.float32


def test_two_effects_cannot_share_a_name():
    with pytest.raises(ValueError, match=r"'constant_force' is taken by visadapt\.effects\.forces\.ConstantForce"):
        type("Mine", (Effect,), {"name": "constant_force"})
    assert EFFECTS["constant_force"] is ConstantForce


class TestActuatorDelay:
    ACTIONS = (0.6, -0.9, 0.3, 0.8, -0.2)

    def velocities(self, delay, substeps):
        """x_dot after each period of a mass of 2 kg under the delayed commands."""
        world = World(Mass(), [ActuatorDelay(delay=delay).double()], PERIOD, "rk4", substeps)
        return run(world, columns(0, 0, 0, 0), [columns(a) for a in self.ACTIONS])[1:, 0, 1].tolist()

    def impulse(self, delay, time):
        """Integral over the time of command(t - delay), the commands held over a period each and 0 before."""
        total = 0.0
        for k, action in enumerate(self.ACTIONS):
            total += action * (min(max(time - delay - k * PERIOD, 0.0), PERIOD))
        return total

    @pytest.mark.parametrize("substeps", [1, 4, 5])
    @pytest.mark.parametrize("delay", [0.0, 0.05, 0.1, 0.02, 0.013, 0.0771, 0.3])
    def test_the_velocity_is_that_of_the_delayed_command(self, delay, substeps):
        expected = [self.impulse(delay, (k + 1) * PERIOD) / 2.0 for k in range(len(self.ACTIONS))]
        assert self.velocities(delay, substeps) == pytest.approx(expected, abs=1e-8)

    def test_a_delay_of_whole_periods_is_the_same_commands_later(self):
        state, actions = inputs(2)
        late = torch.cat((torch.zeros_like(actions[:2]), actions[:1]))
        torch.testing.assert_close(
            run(world_of(ActuatorDelay(delay=2 * PERIOD)), state, actions),
            run(world_of(), state, late),
            atol=1e-6,
            rtol=0,
        )

    @pytest.mark.parametrize("count", range(1, 61))
    def test_delays_of_whole_substeps_in_single_precision(self, count):
        """Where 0.35 / 0.05 is 7 in one precision and 6.9999999 in another, the memory must still reach."""
        world = World(Mass(), [ActuatorDelay(delay=count * 0.01)], PERIOD, "euler", 5)
        actions = torch.ones(14, 1, 1)
        reached = run(world, torch.zeros(1, 4), actions)[-1, 0, 1].detach()
        assert float(reached) == pytest.approx((0.7 - count * 0.01) / 2.0, abs=1e-5)

    @pytest.mark.parametrize("delay", [-0.01, float("nan")])
    def test_a_negative_delay_is_an_error(self, delay):
        with pytest.raises(ValueError, match="delay must not be negative, got"):
            world_of(ActuatorDelay(delay=delay)).start(columns(0, 0, 0, 0))


class TestForces:
    def test_a_positive_constant_force_pushes_towards_positive_x(self):
        state = columns(0, 0, 0, 0)
        end = run(world_of(ConstantForce(force=3.0).double(), system=Mass()), state, [columns(0.0)] * 4)[-1, 0]
        assert end[:2].tolist() == pytest.approx([0.5 * 1.5 * 0.2**2, 1.5 * 0.2])

    def test_a_constant_force_is_like_a_constant_command(self):
        state, actions = inputs(3)
        pushed = run(world_of(ConstantForce(force=3.0)), state, actions)
        torch.testing.assert_close(pushed, run(world_of(), state, actions + 3.0 / 30.0))

    def test_viscous_friction_lets_a_speed_die_away_exponentially(self):
        world = World(Mass(), [ViscousFriction(coefficient=5.0).double()], PERIOD, "rk4", 20)
        for start in (0.8, -0.8):
            seen = run(world, columns(0, start, 0, 0), [columns(0.0)] * 8)[:, 0, 1].tolist()
            expected = [start * math.exp(-5.0 / 2.0 * k * PERIOD) for k in range(9)]
            assert seen == pytest.approx(expected, rel=1e-7)

    @given(data=st.data())
    @settings(max_examples=20)
    def test_a_periodic_force_is_its_formula_and_acts_on_the_cart_alone(self, data):
        v = data.draw(from_table("periodic_force"))
        time = torch.linspace(0, 3, 7, dtype=torch.float64)
        effect = build("periodic_force", v)
        v = {key: float(value) for key, value in effect.state_dict().items()}
        load = effect.load(time, torch.zeros(7, 4, dtype=torch.float64)).detach()
        for t, (force, torque) in zip(time.tolist(), load.tolist(), strict=True):
            expected = v["amplitude"] * math.cos(2 * math.pi * v["frequency"] * t + v["phase"]) + v["offset"]
            assert force == pytest.approx(expected, rel=1e-9, abs=1e-9)
            assert torque == 0.0

    def test_the_phase_of_a_periodic_force_counts_from_the_start_of_the_episode(self):
        # The impulse of 2 (sin t + 1) N over T is 2 (1 - cos T + T).
        effect = PeriodicForce(amplitude=2.0, frequency=1 / (2 * math.pi), phase=-math.pi / 2, offset=2.0)
        seen = run(World(Mass(), [effect], PERIOD, "rk4", 5), columns(0, 0, 0, 0), [columns(0.0)] * 60)[
            :, 0, 1
        ].tolist()
        for k in (1, 20, 60):
            elapsed = k * PERIOD
            assert seen[k] == pytest.approx((1 - math.cos(elapsed) + elapsed), abs=1e-6)
