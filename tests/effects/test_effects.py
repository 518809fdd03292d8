import importlib
import importlib.util
import math
import pickle
import pkgutil

import pytest
import torch
from hypothesis import given, settings, strategies as st

import visadapt.effects
from tests.effects.registry import LIBRARY
from visadapt.effects import EFFECTS, CameraEffect, ConstantForce, Effect, Role, Stage
from visadapt.effects.laws import StribeckLaw
from visadapt.systems import SYSTEMS, CartPole
from visadapt.world import World

NAMED = sorted(LIBRARY.keys() - {"residual"})
"""The effects with parameters; the residual, a network, has tests of its own in test_world.py."""

PAIRS = [
    (name, system)
    for name in NAMED
    for system in (kind() for kind in SYSTEMS.values())
    if isinstance(system, EFFECTS[name].systems)
]
"""Every effect with every system that it acts on."""

SMOOTH = [(name, system) for name, system in PAIRS if not EFFECTS[name].no_gradient]

PERIOD, STEPS = 0.05, 3
CART_POLE = CartPole()

STRONG = {
    "actuator_saturation": {"limit": 0.3},
    "gust": {"start": 0.02, "end": 0.1, "force": 5.0},
    "friction_patch": {"start": -1.0, "end": 1.0, "coefficient": 10.0},
    "frozen_zone": {"start": -0.3, "end": 0.4},
    "occlusion": {"left": 1.0, "top": 2.0, "right": 7.5, "bottom": 6.0, "grey": 0.2},
    "ground_effect": {"radius": 0.5, "ground": 0.0},
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


def drawn(name, system, test, examples=4, batch=None):
    """Runs `test` on parameters of the effect; on the vehicles, whose steps cost more, on fewer."""

    @settings(max_examples=examples if isinstance(system, CartPole) else 2)
    @given(from_table(name, batch))
    def run(values):
        test(values)

    run()


def world_of(*effects, system=CART_POLE):
    if isinstance(system, CartPole):
        return World(system, effects, PERIOD, "rk4", substeps=3)
    return World(system, effects, PERIOD, "midpoint", substeps=1)


def inputs(batch, system=CART_POLE, seed=0):
    """States (batch, n_state) and actions (STEPS, batch, n_action), away from the limits of the command."""
    generator = torch.Generator().manual_seed(seed)
    state = torch.randn(batch, len(system.states), generator=generator, dtype=torch.float64)
    actions = torch.rand(STEPS, batch, len(system.actions), generator=generator, dtype=torch.float64)
    if isinstance(system, CartPole):
        state *= 0.5
    else:
        # Upright, just above the ground, and so slow that the strongest drag is not stiff.
        state = 0.1 * state + torch.tensor([0.0, 0.0, 0.5, 2.0, 0.0, 0.0, 1.0, *[0.0] * 6], dtype=torch.float64)
    return state, 1.8 * actions - 0.9


def draw(state):
    """Smooth frames (B, 8, 10) of states, so that differences meet no kinks of bilinear interpolation alone."""
    column, row = torch.arange(10).to(state) - 4.5, torch.arange(8).to(state)[:, None] - 3.5
    x, theta = state[:, 0, None, None], state[:, 2, None, None]
    return 0.5 + 0.3 * torch.sin(0.3 * column - x) * torch.cos(0.4 * row + theta)


def readings(world, state, actions):
    """What is measured (STEPS + 1, B, n_state) of a run, or what is seen of it (STEPS + 1, B, pixels)."""
    generator = torch.Generator().manual_seed(1)
    camera = any(effect.stage is Stage.CAMERA for effect in world.effects)

    def read(at):
        if not camera:
            return world.measure(at, generator)
        frame, at = world.show(at, draw, generator)
        return frame.flatten(1), at

    measured, at = read(world.start(state))
    seen = [measured]
    for action in actions:
        measured, at = read(world.step(at, action))
        seen.append(measured)
    return torch.stack(seen)


def source_of(name):
    """Nothing; for an effect on frames a camera that changes none, so that frames are what is read."""
    return [CameraEffect()] if EFFECTS[name].stage is Stage.CAMERA else []


def assert_gradients_agree(function, point, limits):
    """Gradients against finite differences, at kinks too: there they lie between the slopes on both sides.

    `function` maps (N, D) to (N,), each row for itself; `limits` (2, D) are values which no difference steps over.
    """
    point = point.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(function(point).sum(), point)
    point, h = point.detach(), 1e-6
    count, size = point.shape
    steps = torch.cat((-h * torch.eye(size), torch.zeros(1, size), h * torch.eye(size))).to(point)
    values = function((point[:, None] + steps).clamp(*limits).flatten(0, 1)).unflatten(0, (count, -1))
    below, centre, above = values[:, :size], values[:, size, None], values[:, size + 1 :]
    slopes = torch.stack(((centre - below) / h, (above - centre) / h))
    outside = torch.stack((point - h < limits[0], point + h > limits[1]))
    slopes = torch.where(outside, slopes.flip(0), slopes)
    tolerance = 1e-4 * (1 + slopes.abs().amax(0))
    wrong = (gradient < slopes.amin(0) - tolerance) | (gradient > slopes.amax(0) + tolerance)
    assert not wrong.any(), (wrong.nonzero().tolist(), gradient[wrong], slopes[:, wrong])


@pytest.mark.parametrize("name", NAMED)
class TestStatements:
    """What every effect says of itself, whoever writes it."""

    def test_it_says_which_systems_it_acts_on(self, name):
        assert any(issubclass(system, EFFECTS[name].systems) for system in SYSTEMS.values())

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

    def test_roles_fit_their_units(self, name):
        effect = EFFECTS[name]
        units = {Role.FREQUENCY: "Hz", Role.PHASE: "rad"}
        for parameter in effect.table:
            assert parameter.unit == units.get(parameter.role, parameter.unit)
            # A unit of frequency, and the names by which roles once went, state the role.
            assert (parameter.unit == "Hz") == (parameter.role is Role.FREQUENCY)
            assert (parameter.name in ("start", "end", "phase")) == (
                parameter.role in (Role.START, Role.END, Role.PHASE)
            )
        edges = [parameter for parameter in effect.table if parameter.is_edge]
        assert effect.region() == (tuple(edges) or None)
        assert len({(edge.unit, edge.low, edge.high) for edge in edges}) <= 1

    def test_experiments_and_separations_are_about_effects_that_there_are(self, name):
        effect = EFFECTS[name]
        for other, experiment in effect.settled_by.items():
            assert experiment
            assert name not in EFFECTS[other].settled_by
            assert any(issubclass(system, effect.systems) for system in EFFECTS[other].systems)
        assert not effect.separable_on or effect.indistinguishable_from

    def test_unknown_and_missing_parameters_are_named(self, name):
        with pytest.raises(ValueError, match=f"{name} takes the parameters .*; got colour"):
            EFFECTS[name](colour=1.0)
        with pytest.raises(ValueError, match=f"{name} takes the parameters .*; got none"):
            EFFECTS[name]()


@pytest.mark.parametrize(("name", "system"), PAIRS, ids=lambda part: getattr(part, "name", part))
class TestContract:
    """What every effect promises on every system that it acts on."""

    def test_neutral_parameters_change_nothing(self, name, system):
        state, actions = inputs(4, system)
        without = readings(world_of(*source_of(name), system=system), state, actions)

        def test(values):
            values = values | {p.name: p.neutral for p in EFFECTS[name].table if p.neutral is not None}
            with_it = readings(world_of(build(name, values), system=system), state, actions)
            torch.testing.assert_close(with_it, without, rtol=0, atol=1e-12)

        drawn(name, system, test)

    def test_it_does_something(self, name, system):
        values = STRONG.get(name, {p.name: p.low + 0.8 * (p.high - p.low) for p in EFFECTS[name].table})
        state, actions = inputs(4, system)
        with_it = readings(world_of(build(name, values), system=system), state, actions)
        assert (with_it - readings(world_of(*source_of(name), system=system), state, actions)).abs().max() > 1e-4

    def test_it_pickles(self, name, system):
        state, actions = inputs(2, system)

        def test(values):
            effect = build(name, values)
            copy = pickle.loads(pickle.dumps(effect))
            assert type(copy) is type(effect)
            own, other = (readings(world_of(e, system=system), state, actions) for e in (effect, copy))
            assert torch.equal(own, other)

        drawn(name, system, test, 2)

    def test_device_and_dtype_come_from_the_tensors(self, name, system):
        values = {p.name: 0.5 * (p.low + p.high) for p in EFFECTS[name].table}
        world = world_of(EFFECTS[name](**values), system=system)
        state, actions = inputs(2, system)
        assert readings(world, state, actions).dtype == torch.float64
        assert readings(world, state.float(), actions.float()).dtype == torch.float32

    def test_what_its_linear_parameters_add_is_proportional_to_them(self, name, system):
        table = EFFECTS[name].table
        linear = [p for p in table if p.linear]
        values = STRONG.get(name, {p.name: p.low + 0.7 * (p.high - p.low) for p in table})
        (state, actions), h = inputs(4, system), PERIOD

        def added(share):
            """What the effect adds when its linear parameters have gone a share of the way from neutral."""
            own = values | {p.name: p.neutral + share * (values[p.name] - p.neutral) for p in linear}
            effect = build(name, own)
            if effect.stage is Stage.DYNAMICS:
                return effect.load(torch.linspace(0.03, 0.09, 4, dtype=torch.float64), state, system)
            if effect.stage is Stage.ACTUATION:
                commands = actions.transpose(0, 1)
                return effect.apply_to(commands, effect.memory(commands, h), h)[0] - commands
            if effect.stage is Stage.CAMERA:
                return effect.apply_to(draw(state), effect.memory(state, h), torch.Generator())[0] - draw(state)
            return effect.apply_to(state, effect.memory(state, h), h, torch.Generator())[0] - state

        if linear:
            assert added(1.0).abs().max() > 1e-3
            torch.testing.assert_close(added(0.0), torch.zeros_like(added(0.0)), rtol=0, atol=1e-12)
            torch.testing.assert_close(added(0.3), 0.3 * added(1.0), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("name", "system"), SMOOTH, ids=lambda part: getattr(part, "name", part))
class TestSmoothContract:
    """What every effect promises but those that say why they have no gradient."""

    def test_gradients_agree_with_finite_differences(self, name, system):
        """In the state, the commands and its parameters, one of each for every row."""
        table = EFFECTS[name].table
        n, m = len(system.states), len(system.actions)
        # Every reading counts, each with its own weight.
        size = 80 if EFFECTS[name].stage is Stage.CAMERA else n
        weights = torch.linspace(-1, 1, size * (STEPS + 1), dtype=torch.float64).reshape(STEPS + 1, 1, size)

        def total(point):
            state, actions, values = point.split((n, STEPS * m, len(table)), 1)
            effect = EFFECTS[name](**{p.name: 0.0 for p in table})
            for p, value in zip(table, values.unbind(1), strict=True):
                delattr(effect, p.name)
                setattr(effect, p.name, value)
            actions = actions.unflatten(1, (STEPS, m)).movedim(1, 0)
            return (readings(world_of(effect, system=system), state, actions) * weights).sum((0, 2))

        # Beyond the value that switches an effect off there may be none at all: a negative delay.
        free = torch.full((n + STEPS * m,), math.inf, dtype=torch.float64)
        low = [p.low if p.neutral == p.low else -math.inf for p in table]
        high = [p.high if p.neutral == p.high else math.inf for p in table]
        ranges = free.new_tensor([low, high])
        limits = torch.cat((torch.stack((-free, free)), ranges), 1)
        state, actions = inputs(2, system)

        def test(values):
            given = torch.tensor([values[p.name] for p in table], dtype=torch.float64).expand(2, -1)
            if issubclass(EFFECTS[name], StribeckLaw) and (given[0, 0] - given[0, 1]).abs() < 1e-5:
                # Beside the corner, to either side of which another of the two frictions is the larger one.
                given = given + torch.tensor([0.0, 1e-3, 0.0], dtype=torch.float64)
            assert_gradients_agree(total, torch.cat((state, actions.movedim(0, 1).flatten(1), given), 1), limits)

        drawn(name, system, test)

    def test_a_row_does_not_depend_on_its_batch(self, name, system):
        """Nor on whether its parameters are scalars or entries of (B,)."""
        batch = 2
        state, actions = inputs(batch, system)

        def test(values):
            together = readings(world_of(build(name, values), system=system), state, actions)
            for b in range(batch):
                own = build(name, {key: value[b] for key, value in values.items()})
                alone = readings(world_of(own, system=system), state[b : b + 1], actions[:, b : b + 1])
                torch.testing.assert_close(together[:, b], alone[:, 0], rtol=1e-10, atol=1e-12)

        drawn(name, system, test, batch=batch)


def test_an_effect_without_gradient_says_why():
    assert {name: EFFECTS[name].no_gradient for name in NAMED if EFFECTS[name].no_gradient} == {
        "dropout": "whether a row is lost is a random yes or no",
        "frame_drop": "whether a frame is lost is a random yes or no",
    }


@pytest.mark.parametrize("module", [m.name for m in pkgutil.iter_modules(visadapt.effects.__path__)])
def test_every_effect_of_every_module_is_a_name_of_the_package(module):
    """A new class is one by itself; a new module needs its line in the package."""
    members = vars(importlib.import_module(f"visadapt.effects.{module}")).values()
    own = [m for m in members if isinstance(m, type) and issubclass(m, Effect) and "name" in vars(m)]
    for effect in own:
        assert getattr(visadapt.effects, effect.__name__, None) is effect
        assert EFFECTS[effect.name] is effect


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
