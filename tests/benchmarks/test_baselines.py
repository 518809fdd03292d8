"""The baselines are set the same problem, and their models are what they say."""

import csv

import pytest
import torch

from benchmarks.baselines.problem import COST, PROBLEMS, drawn
from benchmarks.baselines.table import BASELINES, Settings, main
from benchmarks.cartpole_states import SINE
from visadapt.effects import ConstantForce, PeriodicForce, Residual
from visadapt.history import LENGTH, History
from visadapt.policies.networks import StateResidualNetwork
from visadapt.systems import CartPole
from visadapt.world import World


def residual_that_is_not_zero(with_history):
    torch.manual_seed(0)
    network = StateResidualNetwork(4, 1, CartPole() if with_history else None, 0.05)
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
    from benchmarks.baselines.mpc import step, weights

    residual, history = residual_that_is_not_zero(with_history).double(), random_history(5)
    history = history.map(torch.Tensor.double)
    world = World(CartPole(), [residual])
    command = torch.tensor([[0.3], [-0.2], [0.9], [-1.0], [0.0]], dtype=torch.float64)
    expected = world.step(world.start(history.observations[:, -1]), command, history).state
    model, acting = step(World(CartPole()), residual), history.acting(command)
    for b in range(5):
        found = model(acting.observations[b].flatten().numpy(), acting.actions[b].flatten().numpy(), weights(residual))
        assert found.full().ravel() == pytest.approx(expected[b].numpy(), abs=1e-9)


def test_the_mpc_pushes_against_what_the_residual_expects():
    pytest.importorskip("casadi")
    from benchmarks.baselines.mpc import ModelPredictive, Program

    residual = residual_that_is_not_zero(with_history=False)
    for weight in residual.network.parameters():
        torch.nn.init.zeros_(weight)
    world = World(CartPole(), [ConstantForce(force=3.0)])
    pushed = world.step(world.start(torch.zeros(1, 4)), torch.zeros(1, 1)).state[0]
    residual.scale.copy_(pushed)
    residual.network.head[-1].bias.data.fill_(1.0)
    still = History.start(torch.zeros(1, 4), 1)
    without, with_it = (ModelPredictive(Program(World(CartPole()), COST, r), r).act(still) for r in (None, residual))
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
    others = {name: method for name, method in BASELINES.items() if name != "diagnosed"}  # a minute by itself
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


def test_a_baseline_that_is_not_there_is_told_in_one_line():
    with pytest.raises(SystemExit, match="no such baseline: sac; there are ours,"):
        main(Settings(baselines=("sac",)))


def test_episodes_of_ppo_are_those_of_the_target():
    pytest.importorskip("stable_baselines3")
    from benchmarks.baselines.ppo import MACHINES, Machines

    target = PROBLEMS[SINE].target()
    machines = Machines(target.draw_effects, target.initial.draw, with_history=True, fine=True, seed=0)
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
