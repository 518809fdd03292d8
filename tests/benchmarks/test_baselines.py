"""The baselines are set the same problem, and their models are what they say."""

import csv

import pytest
import torch

from benchmarks.baselines.frames import path_through
from benchmarks.baselines.mpc_pixels import PixelPredictive
from benchmarks.baselines.problem import SMOKE, drawn
from benchmarks.baselines.table import BASELINES, PROBLEMS, Settings, main
from benchmarks.cartpole_pixels import EXPERIMENT
from benchmarks.cartpole_states import SINE
from tests.flying import waves
from visadapt.effects import ConstantForce, LinearDrag, PeriodicForce, Residual
from visadapt.history import HORIZON, LENGTH, History
from visadapt.policies.networks import FlightResidualNetwork, StateHistoryResidualNetwork, StateResidualNetwork
from visadapt.systems import CartPole, FixedWing, Quadrotor
from visadapt.targets import FlightTarget, SyntheticTarget
from visadapt.tasks.follow import Follow
from visadapt.tasks.reach import Reach
from visadapt.world import World


def residual_that_is_not_zero(with_history):
    torch.manual_seed(0)
    network = StateHistoryResidualNetwork(CartPole(), 0.05) if with_history else StateResidualNetwork(4)
    for weight in network.parameters():
        torch.nn.init.normal_(weight, std=0.3)
    return Residual(network, torch.tensor([0.1, 0.2, 0.3, 0.4])).requires_grad_(False)


def random_history(batch):
    generator = torch.Generator().manual_seed(1)
    scale = torch.tensor([1.0, 0.5, 0.2, 0.5])
    states = scale * torch.randn(batch, LENGTH, 4, generator=generator)
    return History(states, torch.rand(batch, LENGTH, 1, generator=generator) - 0.5)


@pytest.mark.parametrize("with_history", [False, True])
def test_the_model_of_the_mpc_is_the_world_with_the_residual(with_history):
    pytest.importorskip("casadi")
    from benchmarks.baselines.symbolic import step, weights

    residual, history = residual_that_is_not_zero(with_history).double(), random_history(5)
    history = history.map(torch.Tensor.double)
    world = World(CartPole(), [residual])
    command = torch.tensor([[0.3], [-0.2], [0.9], [-1.0], [0.0]], dtype=torch.float64)
    expected = world.step(world.start(history.observations[:, -1]), command, history).state
    model, acting = step(World(CartPole()), residual), history.acting(command)
    for b in range(5):
        found = model(acting.observations[b].flatten().numpy(), acting.actions[b].flatten().numpy(), weights(residual))
        assert found.full().ravel() == pytest.approx(expected[b].numpy(), abs=1e-9)


@pytest.mark.parametrize("with_history", [False, True])
@pytest.mark.parametrize("kind", [Quadrotor, FixedWing])
def test_the_model_of_the_mpc_of_a_vehicle_is_the_world_with_the_residual(kind, with_history):
    pytest.importorskip("casadi")
    from benchmarks.baselines.symbolic import step, weights

    source = World(kind(), period=0.1, substeps=2)
    network = FlightResidualNetwork(kind(), 0.1, source.steps_along if with_history else None).double()
    assert isinstance(network.head, torch.nn.Linear)
    generator = torch.Generator().manual_seed(0)
    network.head.weight.data = 0.01 * torch.randn(network.head.weight.shape, generator=generator, dtype=torch.float64)
    residual = Residual(network, torch.rand(13, generator=generator, dtype=torch.float64)).requires_grad_(False)
    states = torch.randn(4, LENGTH, 13, generator=generator, dtype=torch.float64)
    states[..., 3] += 11
    states[2:, : LENGTH - 2] = states[2:, LENGTH - 2 : LENGTH - 1]  # a flight that has just begun
    history = History(states, torch.rand(4, LENGTH, 4, generator=generator, dtype=torch.float64) - 0.5)
    command = torch.rand(4, 4, generator=generator, dtype=torch.float64) - 0.5
    world = source.with_effects([residual])
    expected = world.step(world.start(states[:, -1]), command, history).state
    model, acting = step(source, residual), history.acting(command)
    for b in range(4):
        found = model(acting.observations[b].flatten().numpy(), acting.actions[b].flatten().numpy(), weights(residual))
        assert found.full().ravel() == pytest.approx(expected[b].numpy(), abs=1e-9)


def test_the_mpc_pushes_against_what_the_residual_expects():
    pytest.importorskip("casadi")
    from benchmarks.baselines.mpc import planned

    residual = residual_that_is_not_zero(with_history=False)
    for weight in residual.network.parameters():
        torch.nn.init.zeros_(weight)
    world = World(CartPole(), [ConstantForce(force=3.0)])
    pushed = world.step(world.start(torch.zeros(1, 4)), torch.zeros(1, 1)).state[0]
    residual.scale.copy_(pushed)
    residual.network.head[-1].bias.data.fill_(1.0)
    still = History.start(torch.zeros(1, 4), 1)
    without, with_it = (planned(World(CartPole()), residual=each).act(still) for each in (None, residual))
    assert abs(float(without)) < 1e-3
    assert float(with_it) < -0.01


@pytest.mark.parametrize("kind", [ConstantForce, PeriodicForce])
def test_effects_are_drawn_from_the_whole_range_of_the_catalogue(kind):
    effect = drawn(kind, 2000, torch.Generator().manual_seed(0))
    for parameter in kind.table:
        values, span = getattr(effect, parameter.name), parameter.high - parameter.low
        assert parameter.low <= float(values.detach().min()) < parameter.low + 0.02 * span
        assert parameter.high - 0.02 * span < float(values.detach().max()) <= parameter.high


def test_all_baselines_run_and_are_tabled(tmp_path):
    written = PROBLEMS[SINE].baselines
    others = {name: BASELINES[name] for name in written if name != "diagnosed"}  # a minute by itself
    for library in ("casadi", "stable_baselines3"):
        pytest.importorskip(library)
    paths = {"work": tmp_path, "out": tmp_path / "table.csv", "picture": tmp_path / "picture.png"}
    settings = Settings(baselines=tuple(others), experiments=(SINE,), smoke=True, jobs=1, **paths)
    main(settings)
    first = settings.out.read_text()
    rows = list(csv.DictReader(first.splitlines()))
    assert {row["method"] for row in rows} == set(others.values())
    assert {int(row["samples"]) for row in rows} == {0, 20, 2048, 4096}
    assert settings.picture.stat().st_size > 10_000
    main(settings)  # all is kept
    assert settings.out.read_text() == first


def test_baselines_on_states_run_from_frames(tmp_path):
    paths = {"work": tmp_path, "out": tmp_path / "table.csv", "picture": tmp_path / "picture.png"}
    main(Settings(baselines=("mppi",), experiments=(EXPERIMENT,), smoke=True, jobs=1, **paths))
    rows = list(csv.DictReader((tmp_path / "table.csv").read_text().splitlines()))
    assert {row["experiment"] for row in rows} == {EXPERIMENT}
    assert {(row["domain"], row["samples"]) for row in rows} == {("source", "0"), ("target", "0"), ("adapted", "20")}


def test_frames_tell_where_the_cart_pole_is_and_how_it_moves_whatever_constant_force_acts():
    generator = torch.Generator().manual_seed(0)
    world = World(CartPole(), [ConstantForce(force=3.0)]).double()
    at = world.start(0.1 * torch.randn(3, 4, generator=generator, dtype=torch.float64))
    commands = torch.rand(3, LENGTH - 1, 1, generator=generator, dtype=torch.float64) - 0.5
    path = [at.state]
    for command in commands.unbind(1):
        at = world.step(at, command)
        path.append(at.state)
    states = torch.stack(path, 1)
    found = path_through(states[..., [0, 2]], commands)
    torch.testing.assert_close(found, states, atol=5e-3, rtol=0)
    nowhere = path_through(states[:, :1, [0, 2]], commands[:, :0])
    torch.testing.assert_close(nowhere[..., [1, 3]], torch.zeros(3, 1, 2).double())


def test_plans_in_image_space_bring_the_picture_nearer_to_that_of_rest():
    planner = PixelPredictive(World(CartPole()))
    still = torch.tensor([[0.1, 0.0, 0.02, 0.0], [-0.2, 0.0, 0.0, 0.0]])
    history = History(still[:, None].expand(-1, LENGTH, -1), torch.zeros(2, LENGTH, 1))
    nothing = planner.cost(history, torch.zeros(2, HORIZON, 1))
    command = planner.act(history)
    assert command.shape == (2, 1)
    assert (planner.cost(history, planner.last) < 0.95 * nothing).all()


def test_what_is_not_written_for_an_experiment_is_told_in_one_line():
    with pytest.raises(SystemExit, match=r"pixels, 2\(sin t \+ 1\) N: the baselines are mpc, .*, not observer"):
        main(Settings(baselines=("observer",), experiments=(EXPERIMENT,)))


def test_a_baseline_that_is_not_there_is_told_in_one_line():
    with pytest.raises(SystemExit, match="no such baseline: sac; there are ours,"):
        main(Settings(baselines=("sac",)))


def test_episodes_of_ppo_are_those_of_the_target():
    pytest.importorskip("stable_baselines3")
    from benchmarks.baselines.courses import Balancing, starting
    from benchmarks.baselines.machines import MACHINES, Machines

    target = PROBLEMS[SINE].target()
    assert isinstance(target, SyntheticTarget)
    machines = Machines(Balancing(starting(target.initial), with_history=True), target.draw_effects, None, seed=0)
    machines.reset()
    seen, still = target.reset(MACHINES, torch.Generator().manual_seed(0)), torch.zeros(MACHINES, 1)
    standing = seen.alive
    for _ in range(60):
        seen = target.step(still)
        machines.step_async(still.numpy())
        machines.step_wait()
        standing &= seen.alive
        assert torch.allclose(seen.state[standing], machines.at.state[standing], atol=1e-6)
    assert not bool(standing.any())  # so that episodes have begun anew
    assert bool((machines.age < 60).all())


def test_frames_of_ppo_are_those_of_the_target():
    pytest.importorskip("stable_baselines3")
    from benchmarks.baselines.machines import MACHINES, Machines
    from benchmarks.baselines.ppo import courses, model_of

    problem = PROBLEMS[EXPERIMENT]
    wide, course = courses(problem, SMOKE)
    target = problem.target()
    assert isinstance(target, SyntheticTarget)
    machines = Machines(course, target.draw_effects, None, seed=0)
    machines.reset()
    seen = target.reset(MACHINES, torch.Generator().manual_seed(0))
    for _ in range(2):
        assert seen.frame is not None
        assert torch.equal((255 * machines.history.observations[:, -1]).round().to(torch.uint8), seen.frame)
        seen = target.step(torch.zeros(MACHINES, 1))
        machines.step_async(torch.zeros(MACHINES, 1).numpy())
        machines.step_wait()

    far = torch.tensor([[1.4, 0, 0, 0], [1.6, 0, 0, 0], [0, 0, 0.31, 0]])
    _, failed, _ = course.judge(far, torch.zeros(3, 1), far, far[:, :0])
    assert failed.tolist() == [False, True, True]

    # PPO's encoder begins as ours, which reads the cart's position from the frame.
    machines = Machines(wide, target.draw_effects, problem.setup(SMOKE).source, seed=0)
    eyes = model_of(machines, seed=0).policy.features_extractor
    machines.reset()
    read = eyes.encoder.kinematics(machines.history)[:, 0].detach()
    assert float(torch.stack((read, machines.at.state[:, 0])).corrcoef()[0, 1]) > 0.99


@pytest.mark.parametrize(("task", "vehicle"), [(Follow(waves(4)), Quadrotor()), (Reach(), FixedWing())])
def test_flights_of_ppo_are_those_of_the_target(task, vehicle):
    pytest.importorskip("stable_baselines3")
    from benchmarks.baselines.courses import flying
    from benchmarks.baselines.machines import MACHINES, Machines

    target = FlightTarget(task, vehicle, lambda batch, generator: (LinearDrag(coefficient=0.3),))
    course = flying(task, vehicle, task.evaluation_start)
    machines = Machines(course, target.draw_effects, None, seed=0)
    machines.reset()
    seen, command = target.reset(MACHINES, torch.Generator().manual_seed(0)), torch.zeros(MACHINES, 4)
    command[:, 0] = 0.3
    for _ in range(10):
        seen = target.step(command)
        machines.step_async(command.numpy())
        _, rewards, ended, _ = machines.step_wait()
        assert not ended.any()
        assert ((rewards > 0) & (rewards < 1)).all()
        assert torch.allclose(seen.state, machines.at.state, atol=1e-5)
        assert torch.equal(seen.goal, machines.history.observations[:, -1, 13:])


def test_a_wing_is_rewarded_for_its_pass_and_a_quadrotor_for_being_on_its_reference():
    from benchmarks.baselines.courses import flying

    task = Reach()
    course = flying(task, FixedWing(), task.evaluation_start)
    state, point = task.evaluation_start(2, torch.Generator().manual_seed(0))
    before, after = state.clone(), state.clone()
    before[:, :3], after[:, :3] = point - 0.1, point + 0.1
    after[1, 1] += 1.0
    before[1, 1] += 1.0
    reward, failed, over = course.judge(before, torch.zeros(2, 4), after, point)
    assert bool(over.all())
    assert not bool(failed.any())
    assert float(reward[0]) > float(reward[1]) + 30

    follow = Follow(waves(2))
    course = flying(follow, Quadrotor(), follow.evaluation_start)
    state, at = follow.evaluation_start(2, torch.Generator().manual_seed(0))
    state[1, 0] += 6.0
    reward, failed, _ = course.judge(state, torch.zeros(2, 4), state, at)
    assert float(reward[0]) == pytest.approx(1.0, abs=1e-3)
    assert failed.tolist() == [False, True]
