import math
from dataclasses import dataclass, replace

import pytest
import scipy.linalg
import torch

import visadapt as va
from tests.own_systems import Drive, Pendulum
from visadapt.estimation.linearise import linearise_step
from visadapt.targets.synthetic import fine_world
from visadapt.tasks.linear_quadratic import linear_quadratic
from visadapt.tasks.regulate import TaskFileError

TILTED = va.Regulate(
    Pendulum(), goal={"angle": 0.5}, tolerance={"angle": 0.1, "rate": 1.0}, limits={"angle": 1.0}, seconds=2.0
)


def test_the_goal_is_held_by_the_command_that_balances_the_weight():
    weight = Pendulum().moment * 9.81 * math.sin(0.5)
    assert TILTED.held.tolist() == pytest.approx([weight], rel=1e-9)


def test_a_speed_is_a_goal_where_no_tolerance_asks_for_a_position():
    speeds = {"motor_rate": 20.0, "disc_rate": 20.0}
    task = va.Regulate(Drive(), goal=speeds, tolerance={"motor_rate": 1.0, "disc_rate": 1.0})
    assert task.held.tolist() == pytest.approx([Drive().friction * 20.0], rel=1e-6)
    with pytest.raises(ValueError, match="goal: no command within its range holds it: there disc changes by 20 rad/s"):
        replace(task, tolerance={**task.tolerance, "disc": 0.1})


@dataclass(frozen=True)
class Tanks(va.System):
    """A pump fills the upper tank, which drains into the lower one, which drains away."""

    drain: float = 0.1  # 1/s

    name = "tanks"
    states = (va.Variable("upper", "m", 0.0, 0.5), va.Variable("lower", "m", 0.0, 0.5))
    actions = (va.Variable("pump", "V", 0.0, 12.0),)
    loads = (va.Variable("inlet", "m/s", -0.01, 0.01),)
    coordinates = ((None, 0),)

    def derivative(self, state, command, load):
        upper, lower = (self.drain * state).unbind(-1)
        return torch.stack((0.002 * command[:, 0] + load[:, 0] - upper, upper - lower), -1)


def test_a_level_is_held_by_the_one_before_it():
    held = va.Regulate(Tanks(), goal={"upper": 0.2, "lower": 0.2}, tolerance={"lower": 0.01}).held
    assert held.tolist() == pytest.approx([10.0], rel=1e-4)
    with pytest.raises(ValueError, match=r"^goal: no command within its range holds it: there lower changes by -0"):
        va.Regulate(Tanks(), goal={"upper": 0.3, "lower": 0.3}, tolerance={"lower": 0.01})


def test_a_goal_at_which_the_derivative_is_not_finite_is_refused():
    class Orifice(Tanks):
        name = "orifice_tanks"

        def derivative(self, state, command, load):
            return super().derivative(state.sqrt(), command, load)

    with pytest.raises(ValueError, match=r"^goal: the derivative of a orifice_tanks is not finite there"):
        va.Regulate(Orifice(), goal={"upper": -0.1}, tolerance={"lower": 0.01})


@dataclass(frozen=True)
class Greenhouse(va.System):
    """A house that is heated, and loses what it has over that of outside."""

    capacity: float = 2e6  # J/K
    loss: float = 200.0  # W/K

    name = "greenhouse"
    prediction_time = 3600.0
    states = (va.Variable("warmth", "K", -20.0, 40.0),)
    actions = (va.Variable("power", "W", 0.0, 8000.0),)
    loads = (va.Variable("heat", "W", -3000.0, 3000.0),)
    coordinates = ((None, 0),)

    def derivative(self, state, command, load):
        return (command + load - self.loss * state) / self.capacity


WARM = va.Regulate(Greenhouse(), goal={"warmth": 20.0}, tolerance={"warmth": 0.5}, seconds=6 * 3600)


def test_a_target_of_a_slow_system_is_integrated_in_steps_of_its_own():
    assert fine_world(Greenhouse(), (), 300.0).substeps == math.ceil(300.0 / (0.005 * 3600 / 0.5))
    assert fine_world(Pendulum(), (), 0.02).substeps == 4


@pytest.mark.parametrize(("task", "period"), [(TILTED, 0.02), (WARM, 300.0)])
def test_the_regulator_is_that_of_the_discrete_algebraic_riccati_equation(task, period):
    world = va.World(task.system, period=period)
    solved = linear_quadratic(world, task.weights, task.command_weights, task.at_goal, task.held)
    at, still = task.at_goal[None], task.held.expand(1, world.substeps, 1)
    step = linearise_step(world, torch.zeros(0).double(), torch.zeros(1).double(), at, still, by_command=True)
    a, b = step.by_state[0].numpy(), step.by_command[0].numpy()
    weights, command = task.weights.diag().numpy(), task.command_weights.diag().numpy()
    after = scipy.linalg.solve_discrete_are(a, b, weights, command)
    # s' V s leaves out the cost of s itself, which nothing can change.
    assert solved.to_go.numpy() == pytest.approx(after - weights, rel=1e-6)


def test_a_goal_at_which_no_command_keeps_the_system_is_refused():
    class Loose(Pendulum):
        name = "loose_pendulum"

        def derivative(self, state, command, load):
            return super().derivative(state, 0 * command, load)

    task = va.Regulate(Loose(), goal={"angle": math.pi}, tolerance={"angle": 0.1})
    with pytest.raises(ValueError, match=r"^no commands keep a loose_pendulum at rest there"):
        va.train(va.World(Loose(), period=0.02), task=task)


def test_the_cost_of_a_plan_is_what_the_equation_says():
    task = replace(TILTED, to_go=((2.0, 0.0), (0.0, 3.0)), effort=0.5)
    states = torch.tensor([[[0.6, 0.0], [0.5, 1.0]]]).double()
    plan = task.held + torch.tensor([[[1.0], [0.0]]]).double()
    cost = task.cost(states, plan, states[:, 0], states[:, 0, :0])
    assert float(cost) == pytest.approx(1.0 + 1.0 + (1.0 / (0.5 * 2.0)) ** 2 + 3.0, rel=1e-6)


def test_an_episode_ends_beyond_a_limit_and_starts_within_its_spread():
    states = torch.tensor([[1.4, 50.0], [1.6, 0.0], [math.nan, 0.0]])
    assert TILTED.within_limits(states).tolist() == [True, False, False]
    drawn = replace(TILTED, start={"rate": 0.2}).first_state(500, torch.Generator().manual_seed(0))
    away = (drawn - torch.tensor([0.5, 0.0])).abs().amax(0)
    assert 0.09 < float(away[0]) <= 0.1
    assert 0.18 < float(away[1]) <= 0.2


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"goal": {"speed": 1.0}}, "goal: a pendulum has no state 'speed': angle, rate"),
        ({"tolerance": {"angle": 0.0}}, "tolerance: angle must be a positive number, got 0.0"),
        ({"limits": {"angle": "1"}}, "limits: angle must be a positive number, got '1'"),
        ({"goal": {"angle": math.inf}}, "goal: angle must be a finite number, got inf"),
        ({"effort": 0.0}, "effort must be a positive number, got 0.0"),
        ({"start": {"angle": 1.0}}, "limits: angle starts up to 1 from the goal, and fails at 1"),
        ({"tolerance": {}}, "tolerance: name the states that are to be at the goal, of angle, rate"),
        (
            {"goal": {"rate": 1.0}},
            "goal: no command within its range holds it: there angle changes by 1 rad/s; angle taken to be 0 there",
        ),
    ],
)
def test_what_is_no_task_is_refused(change, line):
    with pytest.raises(ValueError, match=f"^{line}"):
        replace(TILTED, **change)


def test_a_file_says_the_same_task(tmp_path):
    path = tmp_path / "task.toml"
    path.write_text("seconds = 2\n[goal]\nangle = 0.5\n[tolerance]\nangle = 0.1\nrate = 1\n[limits]\nangle = 1.0\n")
    assert va.read_task(path, Pendulum()) == TILTED
    assert va.Regulate(Pendulum(), **TILTED.settings()) == TILTED


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (
            "[weights]\nangle = 1.0\n",
            "unknown key 'weights'; there are goal, tolerance, start, limits, ",
        ),
        ("tolerance = 0.1\n", r"tolerance must be a table, \[tolerance\]"),
        ("[effort]\nx = 1\n", "effort must be a number, effort = 1.0"),
        ("effort = true\n[tolerance]\nangle = 1\n", "effort must be a positive number, got True"),
        ("[tolerance]\nangel = 1.0\n", "tolerance: a pendulum has no state 'angel': angle, rate"),
        ("[tolerance\n", "not TOML"),
        (f"[tolerance]\nangle = 1{'0' * 400}\n", "tolerance: angle must be a positive number, got 1000"),
    ],
)
def test_a_file_that_says_no_task_is_refused(text, line, tmp_path):
    path = tmp_path / "task.toml"
    path.write_text(text)
    with pytest.raises(TaskFileError, match=f"task.toml: {line}"):
        va.read_task(path, Pendulum())


def with_effects(**named):
    """The pendulum's world with effects, by their names, each with one parameter: {name: {parameter: value}}."""
    effects = {effect.name: effect for effect in va.catalogue(Pendulum())}
    return va.World(Pendulum(), [effects[name](**values) for name, values in named.items()], period=0.02)


def to_go(task):
    return torch.tensor(task.to_go).numpy()


def test_where_effects_act_the_task_is_that_of_their_physics():
    found = TILTED.in_world(with_effects(**{"inertia.scale": {"scale": 1.5}, "moment.scale": {"scale": 1.3}}))
    there = Pendulum(inertia=1.5 * 0.05, moment=1.3 * 0.1)
    as_parameters = replace(TILTED, system=there).in_world(va.World(there, period=0.02))
    assert found.held.tolist() == pytest.approx([1.3 * TILTED.held.item()], rel=1e-6)
    assert to_go(found) == pytest.approx(to_go(as_parameters), rel=1e-5)
    bare = TILTED.in_world(with_effects())
    assert bare.held.tolist() == TILTED.held.tolist()
    damped = TILTED.in_world(with_effects(**{"joint.viscous_friction": {"coefficient": 0.1}}))
    assert to_go(damped)[1, 1] < 0.95 * to_go(bare)[1, 1]


def test_effects_that_jump_at_rest_leave_the_cost_to_go():
    rubbing = with_effects(**{"joint.coulomb_friction": {"torque": 0.2}})
    assert to_go(TILTED.in_world(rubbing)) == pytest.approx(to_go(TILTED.in_world(with_effects())), rel=1e-9)


def test_a_goal_that_effects_leave_no_command_for_stays_as_it_was():
    assert TILTED.in_world(with_effects(**{"moment.scale": {"scale": 5.0}})) is TILTED
