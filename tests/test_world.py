import math

import pytest
import torch
from torch import nn
from torch.func import functional_call

from tests.own_systems import DoublePendulum, Pendulum
from tests.worlds import Mass, columns, run
from visadapt.effects import (
    EFFECTS,
    ActuatorBias,
    ActuatorDelay,
    ActuatorGain,
    ActuatorLag,
    AngleOffset,
    CameraShift,
    CartMass,
    ConstantForce,
    Dropout,
    Effect,
    FrictionPatch,
    Gust,
    MeasurementDelay,
    PoleDamping,
    PoleMass,
    QuadraticDrag,
    Residual,
    RotorDrag,
    RotorEfficiency,
    SensorScale,
    Spring,
    ViscousFriction,
)
from visadapt.effects.catalogue import catalogue
from visadapt.history import History
from visadapt.systems import CartPole, Quadrotor
from visadapt.world import World


class Linear(nn.Module):
    """A residual network that is a matrix on the last observation and the action being executed."""

    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.linspace(-1, 1, 20, dtype=torch.float64).reshape(4, 5))

    def forward(self, history):
        return torch.cat((history.observations[:, -1], history.actions[:, -1]), 1) @ self.weight.T


def inputs(batch=3, steps=4, seed=0):
    generator = torch.Generator().manual_seed(seed)
    state = 0.3 * torch.randn(batch, 4, generator=generator, dtype=torch.float64)
    return state, 1.8 * torch.rand(steps, batch, 1, generator=generator, dtype=torch.float64) - 0.9


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"integrator": "leapfrog"}, "unknown integrator 'leapfrog'; there are euler, midpoint, rk3, rk4"),
        ({"period": 0.0}, "positive, got 0.0 s"),
        ({"period": float("nan")}, "positive, got nan s"),
        ({"substeps": 0}, "positive, got 0.05 s and 0"),
    ],
)
def test_settings_that_make_no_world(settings, message):
    with pytest.raises(ValueError, match=message):
        World(CartPole(), **settings)


def test_a_mass_moves_as_newton_says():
    world = World(Mass(), period=0.1, integrator="rk4", substeps=3)
    states = run(world, columns(1.0, 0.5, 0, 0), [columns(0.8)] * 5)
    elapsed = torch.arange(6, dtype=torch.float64) * 0.1
    torch.testing.assert_close(states[:, 0, 0], 1.0 + 0.5 * elapsed + 0.5 * 0.4 * elapsed**2)
    torch.testing.assert_close(states[:, 0, 1], 0.5 + 0.4 * elapsed)


@pytest.mark.parametrize("substeps", [1, 7])
def test_the_clock_runs_a_period_a_step_and_starts_at_zero_in_every_row(substeps):
    world = World(CartPole(), period=0.04, substeps=substeps)
    at = world.start(torch.zeros(2, 4, dtype=torch.float64))
    assert at.time.tolist() == [0.0, 0.0]
    for k in range(1, 4):
        at = world.step(at, torch.zeros(2, 1, dtype=torch.float64))
        assert at.time.tolist() == pytest.approx([0.04 * k] * 2)


@pytest.mark.parametrize(
    "effect",
    [Gust(start=0.11, end=0.135, force=10.0), FrictionPatch(start=0.01, end=0.04, coefficient=40.0)],
    ids=lambda effect: effect.name,
)
def test_steps_resolve_where_an_effect_sets_in(effect):
    state, actions = columns(0.0, 0.3, 0.0, 0.0), [columns(0.0)] * 6

    def end(world):
        return run(world, state, actions)[-1]

    exact = end(World(CartPole(), [effect.double()], substeps=100))
    acted = (end(World(CartPole())) - exact).abs().max()
    for world in (World(CartPole(), [effect]), World(CartPole()).with_effects([effect])):
        assert (end(world) - exact).abs().max() < 0.02 * acted
    assert World(CartPole(), [effect], substeps=1).substeps == 1


@pytest.mark.parametrize("integrator", ["euler", "midpoint", "rk3", "rk4"])
def test_more_substeps_come_closer_to_the_same_motion(integrator):
    state, actions = inputs()
    exact = run(World(CartPole(), substeps=100), state, actions)[-1]
    errors = [
        float((run(World(CartPole(), integrator=integrator, substeps=n), state, actions)[-1] - exact).abs().max())
        for n in (1, 4, 16)
    ]
    assert errors[0] > 2 * errors[1] > 4 * errors[2]


def test_a_step_is_pure():
    world = World(CartPole(), [ActuatorDelay(delay=0.07), ConstantForce(force=2.0)], substeps=2)
    state, actions = inputs()
    at = world.step(world.start(state), actions[0])
    before = (at.time.clone(), at.state.clone(), at.memory[0].clone())
    once, again = world.step(at, actions[1]), world.step(at, actions[1])
    assert torch.equal(once.state, again.state)
    assert torch.equal(once.memory[0], again.memory[0])
    assert all(torch.equal(a, b) for a, b in zip(before, (at.time, at.state, at.memory[0]), strict=True))


def test_commands_beyond_one_are_cut():
    state, _ = inputs()
    world = World(CartPole())
    strong = run(world, state, [torch.full((3, 1), 4.0, dtype=torch.float64)])
    assert torch.equal(strong, run(world, state, [torch.ones(3, 1, dtype=torch.float64)]))


def test_loads_of_several_effects_add_up():
    state, actions = inputs()
    together = World(CartPole(), [ConstantForce(force=2.0), ConstantForce(force=1.5)])
    torch.testing.assert_close(
        run(together, state, actions), run(World(CartPole(), [ConstantForce(force=3.5)]), state, actions)
    )


def test_the_order_of_effects_in_the_list_does_not_matter():
    state, actions = inputs()
    effects = [ViscousFriction(coefficient=2.0), ActuatorDelay(delay=0.06)]
    one, other = World(CartPole(), effects, substeps=2), World(CartPole(), effects[::-1], substeps=2)
    torch.testing.assert_close(run(one, state, actions), run(other, state, actions))


def test_rows_can_be_taken_from_either_of_two_world_states():
    world = World(CartPole(), [ActuatorDelay(delay=0.07)], substeps=2)
    state, actions = inputs()
    old = world.step(world.start(state), actions[0])
    fresh = world.start(-state)
    keep = torch.tensor([True, False, True])
    mixed = old.where(keep, fresh)
    after, kept, restarted = (world.step(at, actions[1]).state for at in (mixed, old, fresh))
    torch.testing.assert_close(after, torch.where(keep[:, None], kept, restarted))
    assert mixed.time.tolist() == pytest.approx([0.05, 0.0, 0.05])


def test_a_detached_world_state_has_the_same_values_and_no_graph():
    state, actions = inputs()
    at = World(CartPole(), [ActuatorDelay(delay=0.07)]).start(state.requires_grad_())
    at = World(CartPole(), [ActuatorDelay(delay=0.07)]).step(at, actions[0])
    assert at.state.requires_grad
    assert not at.detach().state.requires_grad
    assert torch.equal(at.detach().state, at.state)


class TestMeasuring:
    def test_without_sensing_effects_the_reading_is_the_state(self):
        world = World(CartPole(), [ActuatorDelay(delay=0.07), ConstantForce(force=2.0)])
        state, actions = inputs()
        at = world.step(world.start(state), actions[0])
        measured, after = world.measure(at)
        assert torch.equal(measured, at.state)
        assert all(torch.equal(a, b) for a, b in zip(at.memory, after.memory, strict=True))

    def test_sensing_changes_what_is_read_and_not_what_happens(self):
        state, actions = inputs()
        effects = [AngleOffset(offset=0.1), MeasurementDelay(delay=0.06), ActuatorDelay(delay=0.03)]
        world, blind = World(CartPole(), effects), World(CartPole(), effects[2:])
        at, unread = world.start(state), blind.start(state)
        for action in actions:
            _, at = world.measure(at)
            at, unread = world.step(at, action), blind.step(unread, action)
            assert torch.equal(at.state, unread.state)
        assert (world.measure(at)[0] - at.state).abs().max() > 0.05

    def test_reading_is_pure_and_rows_can_be_taken_from_either_of_two_worlds(self):
        state, actions = inputs()
        world = World(CartPole(), [MeasurementDelay(delay=0.07), ActuatorDelay(delay=0.03)])
        old = world.step(world.measure(world.start(state))[1], actions[0])
        fresh = world.start(-state)
        keep = torch.tensor([True, False, True])
        mixed, kept, restarted = (world.measure(at)[0] for at in (old.where(keep, fresh), old, fresh))
        torch.testing.assert_close(mixed, torch.where(keep[:, None], kept, restarted))
        assert torch.equal(world.measure(old)[0], kept)

    def test_effects_of_a_stage_act_in_their_order_whatever_that_of_the_list(self):
        gain, bias, late = ActuatorGain(scale=2.0), ActuatorBias(offset=0.1), MeasurementDelay(delay=0.02)
        offset, lost = AngleOffset(offset=0.1), Dropout(rate=1.0)
        state, actions = inputs()
        seen = []
        for effects in ([gain, bias, late, offset, lost], [lost, bias, offset, gain, late]):
            world = World(CartPole(), effects)
            measured, at = world.measure(world.start(state), torch.Generator())
            at = world.step(at, 0.3 * actions[0])
            seen.append((at.state, measured, world.measure(at, torch.Generator())[0]))
        for one, other in zip(*seen, strict=True):
            assert torch.equal(one, other)
        # 2 u + 0.1, not 2 (u + 0.1).
        alone = World(CartPole()).step(World(CartPole()).start(state), 0.6 * actions[0] + 0.1)
        torch.testing.assert_close(seen[0][0], alone.state)

    def test_an_effect_that_states_no_order_acts_last(self):
        class Doubled(ActuatorGain):
            order = Effect.order

        world = World(CartPole(), [Doubled(scale=2.0), ActuatorBias(offset=0.1), ActuatorLag(time_constant=0.0)])
        state, actions = inputs()
        alone = World(CartPole()).step(World(CartPole()).start(state), 2 * (0.3 * actions[0] + 0.1))
        torch.testing.assert_close(world.step(world.start(state), 0.3 * actions[0]).state, alone.state)


def test_rows_of_unequal_duration_are_those_of_worlds_with_these_periods():
    effects = [ConstantForce(force=2.0), ActuatorLag(time_constant=0.1)]
    commands = torch.tensor([[0.6], [-0.3], [0.9]], dtype=torch.float64)
    held = torch.tensor([0.04, 0.05, 0.07], dtype=torch.float64)
    state = torch.tensor([[0.1, -0.4, 0.05, 0.3]], dtype=torch.float64).repeat(3, 1)
    world = World(CartPole(), effects, period=0.05, substeps=2).double()
    acting = world.actuate(commands[:, None], held[:, None])[:, 0]
    together = world.integrate(torch.zeros(3).double(), state, acting, held)
    for k in range(3):
        alone = World(CartPole(), effects, period=float(held[k]), substeps=2).double()
        expected = alone.step(alone.start(state[:1]), commands[k, None]).state
        torch.testing.assert_close(together[k, None], expected, rtol=0, atol=1e-12)


def test_the_load_of_an_instant_is_that_of_all_effects_on_the_altered_system():
    effects = [ConstantForce(force=2.0), ViscousFriction(coefficient=3.0), CartMass(scale=2.0)]
    world = World(CartPole(), effects)
    load = world.requires_grad_(False).load(world.start(columns(0, -0.5, 0, 0)))
    assert load[0].tolist() == pytest.approx([3.5, 0.0])
    altered = world.altered(load)
    assert isinstance(altered, CartPole)
    assert float(altered.cart_mass) == 2.0
    assert world.system == CartPole()


class TestResidual:
    SCALE = torch.tensor([0.1, 1.0, 0.2, 2.0], dtype=torch.float64)

    def test_it_adds_its_scaled_output_to_the_state_after_the_period(self):
        network, (state, actions) = Linear(), inputs()
        history = History.start(state, 1)
        world = World(CartPole(), [Residual(network, self.SCALE)])
        added = world.step(world.start(state), actions[0], history).state - run(World(CartPole()), state, actions)[1]
        expected = self.SCALE * (torch.cat((state, actions[0]), 1) @ network.weight.T)
        torch.testing.assert_close(added, expected)

    def test_it_sees_the_action_being_executed_and_those_before(self):
        seen = []

        class Watch(nn.Module):
            def forward(self, history):
                seen.append(history.actions[0, :, 0].tolist())
                return torch.zeros_like(history.observations[:, -1])

        world = World(CartPole(), [Residual(Watch(), self.SCALE)])
        state, _ = inputs()
        history, at = History.start(state, 1), world.start(state)
        for value in (0.1, 0.2):
            action = torch.full((3, 1), value, dtype=torch.float64)
            at = world.step(at, action, history)
            history = history.acting(action).observing(at.state)
        assert seen == [[0, 0, 0, 0, 0.1], [0, 0, 0, 0.1, 0.2]]

    def test_gradients_agree_with_finite_differences(self):
        class TwoSteps(nn.Module):
            def __init__(self):
                super().__init__()
                self.world = World(CartPole(), [Residual(Linear(), TestResidual.SCALE)])

            def forward(self, state, first, second):
                history, at = History.start(state, 1), self.world.start(state)
                for action in (first, second):
                    at = self.world.step(at, action, history)
                    history = history.acting(action).observing(at.state)
                return at.state

        steps = TwoSteps()
        (key, weight), *none = steps.named_parameters()
        assert not none
        state, actions = inputs(2)
        values = [value.detach().clone().requires_grad_() for value in (state, actions[0], actions[1], weight)]
        assert torch.autograd.gradcheck(lambda *v: functional_call(steps, {key: v[3]}, v[:3]), values)

    def test_without_a_history_it_says_what_is_missing(self):
        world = World(CartPole(), [Residual(Linear(), self.SCALE)])
        state, actions = inputs()
        with pytest.raises(ValueError, match="needs the history"):
            world.step(world.start(state), actions[0])


@pytest.mark.parametrize(
    ("system", "effects", "period"),
    [
        (Quadrotor(roll_gain=100.0), [], 0.1),
        (CartPole(cart_mass=0.2, pole_mass=0.02), [ViscousFriction(coefficient=30.0)], 0.05),
        (CartPole(), [QuadraticDrag(coefficient=20.0)], 0.05),
        (CartPole(), [PoleMass(scale=0.02), PoleDamping(coefficient=0.2)], 0.05),
    ],
    ids=["gain", "light", "drag", "damping"],
)
def test_steps_follow_a_system_that_its_parameters_or_effects_make_fast(system, effects, period):
    rigid = isinstance(system, Quadrotor)
    state = torch.eye(13)[6:7] if rigid else torch.tensor([[0.0, 5.0, 0.1, 2.0]])
    action = torch.tensor([[0.0, 0.5, 0.0, 0.0]]) if rigid else torch.tensor([[0.1]])
    world, exact = World(system, effects, period), World(system, effects, period, substeps=100)
    at, reference = world.start(state.double()), exact.start(state.double())
    for _ in range(3):
        at, reference = world.step(at, action.double()), exact.step(reference, action.double())
    torch.testing.assert_close(at.state, reference.state, rtol=0.02, atol=0.01)
    assert World(system, [], period).with_effects(effects).substeps == world.substeps


def test_effects_may_come_from_an_iterator():
    world = World(CartPole(), (effect for effect in [Gust(start=0.1, end=0.2, force=1.0)]))
    assert [effect.name for effect in world.effects] == ["gust"]
    assert world.substeps == 4


def test_parameters_of_one_effect_may_be_one_for_all_rows_or_one_for_each():
    state, action = torch.randn(2, 13, generator=torch.Generator().manual_seed(0)).double(), torch.zeros(2, 4).double()
    state[:, 6:10] = torch.tensor([1.0, 0, 0, 0])
    drags = [RotorDrag(coefficient_x=x, coefficient_y=0.3, coefficient_z=0.2) for x in (torch.tensor([0.1, 0.4]), 0.4)]
    together, alone = (World(Quadrotor(), [drag], 0.1) for drag in drags)
    after = together.step(together.start(state), action).state
    torch.testing.assert_close(after[1:], alone.step(alone.start(state[1:]), action[1:]).state)
    seen = CameraShift(dx=torch.tensor([1.0, 2.0]), dy=0.5).motion(state)
    torch.testing.assert_close(seen[1], CameraShift(dx=2.0, dy=0.5).motion(state))


def test_time_does_not_drift_in_single_precision():
    world = World(Mass(), period=0.001)
    at, action = world.start(torch.zeros(1, 4), torch.tensor([59.0])), torch.zeros(1, 1)
    for _ in range(1000):
        at = world.step(at, action)
    assert float(at.time) == pytest.approx(60.0, abs=1e-5)


@pytest.mark.parametrize("effect", [ActuatorDelay(delay=0.07), MeasurementDelay(delay=0.12)])
def test_a_batch_may_be_empty(effect):
    world = World(CartPole(), [effect])
    measured, at = world.measure(world.start(torch.zeros(0, 4)))
    assert world.measure(world.step(at, torch.zeros(0, 1)))[0].shape == measured.shape == (0, 4)


def test_the_states_have_the_precision_of_those_that_were_given():
    world = World(CartPole(cart_mass=torch.tensor([1.0, 2.0], dtype=torch.float64)))
    assert world.step(world.start(torch.zeros(2, 4)), torch.zeros(2, 1)).state.dtype == torch.float32


def test_an_episode_cannot_start_from_states_without_the_commands_between_them():
    with pytest.raises(ValueError, match="start with states needs the commands between them"):
        World(CartPole()).start(torch.zeros(1, 4), torch.tensor([0.1]), states=torch.zeros(1, 3, 4))


def test_an_effect_of_another_system_is_refused():
    with pytest.raises(TypeError, match="spring acts on a cartpole, not on a quadrotor"):
        World(Quadrotor(), [Spring(stiffness=1.0, rest=0.0)])
    with pytest.raises(TypeError, match="rotor_efficiency acts on a quadrotor, not on a cartpole"):
        World(CartPole(), [RotorEfficiency(scale_1=1.0, scale_2=1.0, scale_3=1.0, scale_4=1.0)])


def test_on_a_system_of_ones_own_so_is_one_that_would_act_on_other_columns():
    with pytest.raises(TypeError, match="friction_patch acts on a cartpole, not on a pendulum"):
        World(Pendulum(), [FrictionPatch(start=-0.1, end=0.1, coefficient=1.0)])
    with pytest.raises(TypeError, match="sensor_scale acts on a cartpole, not on a double_pendulum"):
        World(DoublePendulum(), [SensorScale(position=1.1, angle=1.0)])
    state, action = torch.full((1, 2), 0.1), torch.zeros(1, 1)
    for effect in catalogue(Pendulum()):  # those that are made for it, and those that act on every system
        world = World(Pendulum(), [effect(**{each.name: each.high for each in effect.table})])
        assert world.step(world.start(state), action).state.isfinite().all()


def test_on_a_system_of_ones_own_with_the_same_columns_one_of_a_cart_pole_acts():
    state, action = torch.tensor([[0.0, 1.0, 0.0, 0.0]]), torch.zeros(1, 1)
    world = World(Mass(), [FrictionPatch(start=-1.0, end=1.0, coefficient=2.0)])
    after = world.step(world.start(state), action).state.detach()
    assert float(after[0, 1]) == pytest.approx(math.exp(-2 / 2 * 0.05), rel=1e-5)


REMEMBERING = {
    "actuator_delay": {"delay": 0.07},
    "actuator_lag": {"time_constant": 0.08},
    "actuator_backlash": {"width": 0.2},
    "actuator_bias": {"offset": 0.1},
    "measurement_delay": {"delay": 0.08},
    "frozen_zone": {"start": -0.1, "end": 0.1},
    "gust": {"start": 0.2, "end": 0.5, "force": 3.0},
    "periodic_force": {"amplitude": 2.0, "frequency": 0.8, "phase": 0.3, "offset": 1.0},
}


@pytest.mark.parametrize(
    "chosen", [*([name] for name in REMEMBERING), list(REMEMBERING)], ids=lambda c: "+".join(c)[:40]
)
def test_an_episode_goes_on_from_any_of_its_rows_as_if_it_had_never_stopped(chosen):
    state, actions = inputs(steps=12)
    world = World(CartPole(), [EFFECTS[name](**REMEMBERING[name]) for name in chosen], substeps=3)

    def measure(at):
        measured, at = world.measure(at)
        return measured, at

    measured, at = measure(world.start(state))
    went, read = [at], [measured]
    for action in actions:
        measured, at = measure(world.step(at, action))
        went.append(at)
        read.append(measured)
    # Each row of the batch goes on from another row of its episode.
    begin = [3, 7, 10]
    time = torch.tensor([went[k].time[b] for b, k in enumerate(begin)], dtype=torch.float64)
    there = torch.stack([went[k].state[b] for b, k in enumerate(begin)])
    states = torch.stack([each.state for each in went], 1)
    measured, at = measure(world.start(there, time, actions.movedim(0, 1), states))
    for ahead in range(3):
        rows = [k + ahead for k in begin]
        torch.testing.assert_close(at.state, torch.stack([went[k].state[b] for b, k in enumerate(rows)]))
        torch.testing.assert_close(measured, torch.stack([read[k][b] for b, k in enumerate(rows)]))
        if ahead < 2:
            measured, at = measure(world.step(at, torch.stack([actions[k][b] for b, k in enumerate(rows)])))


def test_a_batch_steps_under_a_batch_of_parameter_values_and_the_gradient_reaches_them():
    state, actions = inputs(batch=1)
    world = World(CartPole(), [ViscousFriction(coefficient=0.0), ActuatorDelay(delay=0.0), AngleOffset(offset=0.0)])
    assert [parameter.name for parameter in world.table] == ["coefficient", "delay", "offset"]
    values = torch.tensor([[0.5, 0.02, 0.0], [2.0, 0.06, 0.01]], dtype=torch.float64, requires_grad=True)
    batch = world.with_values(values)
    at = batch.start(state.expand(2, -1))
    for action in actions:
        at = batch.step(at, action.expand(2, -1))
    read, _ = batch.measure(at)
    for row in range(2):
        alone = world.with_values(values[row])
        here = alone.start(state)
        for action in actions:
            here = alone.step(here, action)
        torch.testing.assert_close(read[row], alone.measure(here)[0][0])
    (gradient,) = torch.autograd.grad(read.sum(), values)
    assert bool((gradient.abs() > 0).all())
