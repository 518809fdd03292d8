import math

import pytest
import torch
from hypothesis import given, settings, strategies as st

from tests.effects.registry import LIBRARY
from tests.effects.test_effects import build, from_table, inputs, world_of
from tests.worlds import Mass, columns, run
from visadapt.effects import (
    EFFECTS,
    ActuationEffect,
    ActuatorBacklash,
    ActuatorBias,
    ActuatorDeadzone,
    ActuatorDelay,
    ActuatorGain,
    ActuatorLag,
    ActuatorSaturation,
    ConstantForce,
)
from visadapt.systems import CartPole
from visadapt.world import World

PERIOD = 0.05
CHAIN = sorted(name for name, effect in LIBRARY.items() if issubclass(effect, ActuationEffect))


def acting(effect, values, substep=0.01):
    """What acts of a list of commands, as a list."""
    commands = torch.tensor(values, dtype=torch.float64)[None, :, None]
    effect = effect.double()
    out, _ = effect.apply_to(commands, effect.memory(commands, substep), substep)
    return out[0, :, 0].tolist()


def test_a_delay_remembers_enough_where_the_clock_bursts():
    held = torch.full((1, 60), 0.01, dtype=torch.float64)
    held[0, 20], held[0, 21:36] = 0.015, 0.004
    commands = torch.rand(1, 60, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    effect = ActuatorDelay(delay=0.03).double()
    world = World(CartPole(), [effect], 0.01, substeps=1)
    whole = world.actuate(commands, held)
    (memory,) = world.memories(torch.zeros(1, 4, dtype=torch.float64), commands, held=held)
    for row in range(60):
        alone, _ = effect.apply_to(commands[:, [row]], memory[:, row], held[:, [row]])
        torch.testing.assert_close(alone[:, 0], whole[:, row, 0])


@pytest.mark.parametrize("name", CHAIN)
@given(data=st.data())
@settings(max_examples=10)
def test_an_episode_at_once_is_the_same_as_step_by_step(name, data):
    effect = build(name, data.draw(from_table(name, 3)))
    generator = torch.Generator().manual_seed(2)
    actions = 2 * torch.rand(3, 11, 1, generator=generator, dtype=torch.float64) - 1
    commands = actions.repeat_interleave(4, 1)
    whole, last = effect.apply_to(commands, effect.memory(commands[:, :4], 0.0125), 0.0125)
    memory, parts = effect.memory(commands[:, :4], 0.0125), []
    for k in range(11):
        part, memory = effect.apply_to(commands[:, 4 * k : 4 * k + 4], memory, 0.0125)
        parts.append(part)
    torch.testing.assert_close(torch.cat(parts, 1), whole, rtol=0, atol=1e-12)
    torch.testing.assert_close(memory, last, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", CHAIN)
def test_on_an_unsteady_clock_it_is_what_fine_equal_substeps_give(name):
    fine = 0.001
    effect = build(name, {p.name: p.low + 0.3 * (p.high - p.low) for p in EFFECTS[name].table})
    # Each of 12 commands is held for 40 to 60 ms, in two substeps.
    half = torch.randint(20, 31, (12,), generator=torch.Generator().manual_seed(4))
    held = half.repeat_interleave(2)
    commands = 2 * torch.rand(1, 12, 1, generator=torch.Generator().manual_seed(5), dtype=torch.float64) - 1
    memory = effect.memory(commands[:, :2], 0.025)
    unsteady, _ = effect.apply_to(commands.repeat_interleave(2, 1), memory, fine * held[None].double())
    every = commands.repeat_interleave(2 * half, 1)
    steady, _ = effect.apply_to(every, effect.memory(every[:, :1], fine), fine)
    impulses = torch.stack([part.sum(1) for part in steady.split(held.tolist(), 1)], 1)
    found = unsteady * held[None, :, None]
    if name == "actuator_delay":  # substeps of a period give each other some of their impulse
        impulses, found = (each.unflatten(1, (-1, 2)).sum(2) for each in (impulses, found))
    torch.testing.assert_close(found, impulses, rtol=0, atol=1e-7)


@pytest.mark.parametrize("name", CHAIN)
def test_signals_of_several_motors_do_not_mix(name):
    effect = build(name, {p.name: p.low + 0.3 * (p.high - p.low) for p in EFFECTS[name].table})
    generator = torch.Generator().manual_seed(3)
    commands = 2 * torch.rand(2, 9, 3, generator=generator, dtype=torch.float64) - 1
    together, _ = effect.apply_to(commands, effect.memory(commands, 0.01), 0.01)
    for k in range(3):
        one = commands[..., k : k + 1]
        alone, _ = effect.apply_to(one, effect.memory(one, 0.01), 0.01)
        torch.testing.assert_close(together[..., k : k + 1], alone)


def test_the_chain_runs_in_the_stated_order_whatever_the_order_of_the_list():
    effects = [ActuatorBias(offset=0.2), ActuatorGain(scale=2.0), ActuatorSaturation(limit=0.5)]
    effects += [ActuatorDeadzone(width=0.1)]
    for listed in (effects, effects[::-1]):
        world = World(Mass(), [effect.double() for effect in listed], PERIOD)
        reached = run(world, columns(0, 0, 0, 0), [columns(0.9)])[1, 0, 1]
        # 0.9 - 0.1 = 0.8, cut to 0.5, doubled to 1.0, and 0.2 more; a mass of 2 kg.
        assert float(reached.detach()) == pytest.approx(1.2 * PERIOD / 2.0)


class TestActuatorDelay:
    ACTIONS = (0.6, -0.9, 0.3, 0.8, -0.2)

    def states(self, delay, substeps):
        """States after each period of a mass of 2 kg under the delayed commands."""
        world = World(Mass(), [ActuatorDelay(delay=delay).double()], PERIOD, "rk4", substeps)
        return run(world, columns(0, 0, 0, 0), [columns(a) for a in self.ACTIONS])[1:, 0]

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
        assert self.states(delay, substeps)[:, 1].tolist() == pytest.approx(expected, abs=1e-8)

    def displacement(self, delay, time):
        """Integral of that impulse over the time."""
        total = 0.0
        for k, action in enumerate(self.ACTIONS):
            since = max(time - delay - k * PERIOD, 0.0)
            total += action * 0.5 * (since**2 - max(since - PERIOD, 0.0) ** 2)
        return total

    @pytest.mark.parametrize("substeps", [2, 3, 8])
    @pytest.mark.parametrize("delay", [0.0, 0.05, 0.013, 0.047, 0.0771, 0.3])
    def test_the_position_is_that_of_the_delayed_command(self, delay, substeps):
        expected = [self.displacement(delay, (k + 1) * PERIOD) / 2.0 for k in range(len(self.ACTIONS))]
        assert self.states(delay, substeps)[:, 0].tolist() == pytest.approx(expected, abs=1e-8)

    @pytest.mark.parametrize(
        ("other", "acts"),
        [(ActuatorBacklash(width=0.1), 0.35), (ActuatorSaturation(limit=0.3), 0.3), (ActuatorDeadzone(width=0.1), 0.3)],
        ids=lambda value: value.name if isinstance(value, ActuationEffect) else "",
    )
    def test_nothing_ratchets_on_a_delay_of_a_part_of_a_substep(self, other, acts):
        world = World(CartPole(), [ActuatorDelay(delay=0.0025).double(), other.double()], substeps=10)
        acting = world.actuate(torch.tensor([0.0, 0.4, 0.4]).double()[None, :, None])[0, :, :, 0].detach()
        assert float(acting[1].mean()) == pytest.approx(0.95 * acts)
        torch.testing.assert_close(acting[2], torch.full((10,), acts, dtype=torch.float64))

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
        assert float(reached.detach()) == pytest.approx((0.7 - count * 0.01) / 2.0, abs=1e-5)

    @pytest.mark.parametrize("delay", [-0.01, float("nan")])
    def test_a_negative_delay_is_an_error(self, delay):
        with pytest.raises(ValueError, match="delay must not be negative, got"):
            world_of(ActuatorDelay(delay=delay)).start(columns(0, 0, 0, 0))


class TestActuatorLag:
    @pytest.mark.parametrize("time_constant", [0.0, 1e-9, 1e-4, 0.004, 0.05, 0.3])
    @pytest.mark.parametrize("substeps", [1, 4])
    def test_the_velocity_is_that_of_the_step_response(self, time_constant, substeps):
        world = World(Mass(), [ActuatorLag(time_constant=time_constant).double()], PERIOD, "rk4", substeps)
        seen = run(world, columns(0, 0, 0, 0), [columns(0.8)] * 6)[:, 0, 1].tolist()
        t = torch.arange(7, dtype=torch.float64) * PERIOD
        # The integral of 1 - exp(-t / T).
        expected = [
            0.4 * (s - (time_constant * -math.expm1(-s / time_constant) if time_constant else 0.0)) for s in t.tolist()
        ]
        assert seen == pytest.approx(expected, abs=1e-8)

    def test_a_vanishing_lag_has_the_slope_of_its_limit(self):
        # For a small time constant T the mean over a substep h is command + (previous - command) T / h.
        lag = ActuatorLag(time_constant=0.0).double()
        commands = torch.tensor([0.5, -0.3, 0.9], dtype=torch.float64)[None, :, None]
        out, _ = lag.apply_to(commands, lag.memory(commands, 0.01), 0.01)
        torch.testing.assert_close(out, commands)
        slopes = [
            float(torch.autograd.grad(value, list(lag.parameters()), retain_graph=True)[0]) for value in out[0, :, 0]
        ]
        assert slopes == pytest.approx([-50.0, 80.0, -120.0])

    @pytest.mark.parametrize("time_constant", [0.0, 1e-12, 1e-5, 1e3])
    def test_gradients_are_finite_in_single_precision(self, time_constant):
        lag = ActuatorLag(time_constant=time_constant)
        commands = torch.linspace(-1, 1, 500)[None, :, None].requires_grad_()
        out, _ = lag.apply_to(commands, lag.memory(commands, 0.01), 0.01)
        grads = torch.autograd.grad(out.square().sum(), [*lag.parameters(), commands])
        assert all(bool(grad.isfinite().all()) for grad in grads)


class TestActuatorBacklash:
    @given(
        width=st.floats(0, 1),
        commands=st.lists(st.floats(-1, 1), min_size=1, max_size=40),
    )
    @settings(max_examples=50)
    def test_it_is_the_recurrence(self, width, commands):
        effect = ActuatorBacklash(width=width)
        half = float(effect.double().state_dict()["width"]) / 2
        follows, expected = 0.0, []
        for command in commands:
            follows = min(max(follows, command - half), command + half)
            expected.append(follows)
        assert acting(effect, commands) == pytest.approx(expected, abs=1e-12)

    def test_a_reversal_crosses_the_whole_play(self):
        commands = [0.0, 0.25, 0.5, 0.4, 0.2, 0.1, -0.2, -0.1, 0.2, 0.3]
        expected = [0.0, 0.05, 0.3, 0.3, 0.3, 0.3, 0.0, 0.0, 0.0, 0.1]
        assert acting(ActuatorBacklash(width=0.4), commands) == pytest.approx(expected, abs=1e-6)

    def test_no_play_has_the_slope_of_a_little(self):
        effect = ActuatorBacklash(width=0.0).double()
        commands = torch.tensor([0.5, 0.5, -0.3, 0.9], dtype=torch.float64)[None, :, None]
        out, _ = effect.apply_to(commands, effect.memory(commands, 0.01), 0.01)
        slopes = [
            float(torch.autograd.grad(value, list(effect.parameters()), retain_graph=True)[0]) for value in out[0, :, 0]
        ]
        assert slopes == [-0.5, -0.5, 0.5, -0.5]


def test_a_dead_zone_takes_its_width_from_every_command():
    expected = [-0.7, 0.0, 0.0, 0.0, 0.2]
    assert acting(ActuatorDeadzone(width=0.2), [-0.9, -0.2, 0.0, 0.1, 0.4]) == pytest.approx(expected, abs=1e-7)


def test_a_dead_zone_of_no_width_has_the_slope_of_a_little():
    effect = ActuatorDeadzone(width=0.0).double()
    commands = torch.tensor([0.5, -0.3], dtype=torch.float64)[None, :, None]
    out, _ = effect.apply_to(commands, effect.memory(commands, 0.01), 0.01)
    slopes = [
        float(torch.autograd.grad(value, list(effect.parameters()), retain_graph=True)[0]) for value in out[0, :, 0]
    ]
    assert slopes == [-1.0, 1.0]


def test_saturation_cuts_on_both_sides():
    assert acting(ActuatorSaturation(limit=0.3), [-0.9, -0.2, 0.3, 0.8]) == pytest.approx([-0.3, -0.2, 0.3, 0.3])


def test_gain_and_bias_are_a_straight_line():
    assert acting(ActuatorGain(scale=0.5), [-0.9, 0.4]) == pytest.approx([-0.45, 0.2])
    assert acting(ActuatorBias(offset=-0.1), [-0.9, 0.4]) == pytest.approx([-1.0, 0.3])


def test_a_bias_is_a_constant_force_of_so_many_newtons():
    state, actions = inputs(3)
    system = CartPole(max_force=12.0)
    torch.testing.assert_close(
        run(world_of(ActuatorBias(offset=0.2).double(), system=system), state, actions),
        run(world_of(ConstantForce(force=2.4).double(), system=system), state, actions),
        rtol=1e-6,
        atol=1e-6,
    )


def test_a_gain_is_both_masses_divided_by_it():
    state, actions = inputs(3)
    torch.testing.assert_close(
        run(world_of(ActuatorGain(scale=0.5).double()), state, actions),
        run(world_of(system=CartPole(cart_mass=2.0, pole_mass=0.2)), state, actions),
    )
