"""Learning happens on the device and in the dtype of the policy's parameters; targets and files stay on the CPU.

The second device of `tests.second_device` is pretended where there is no GPU; numbers are then equal to the last bit,
and on a GPU up to its rounding. Products of two dtypes raise as those of two devices do.
"""

import contextlib
import dataclasses

import pytest
import torch

import visadapt as va
from renderers import DrawnCartPole
from tests.coarse import coarse_targets
from tests.flying import small_quadrotor
from tests.own_systems import Pendulum
from tests.second_device import DEVICE, GPU, second_device
from visadapt.diagnosis.policy_bound import actions
from visadapt.history import History
from visadapt.learning import training_state
from visadapt.learning.perception import PerceptionSettings
from visadapt.setups.cartpole import cartpole_frames, cartpole_states, from_frames
from visadapt.setups.flight import fixed_wing
from visadapt.setups.regulator import regulator

CPU = torch.device("cpu")


@pytest.fixture(scope="module", autouse=True)
def coarse():
    with coarse_targets(0.05):
        yield


def frames():
    few = dataclasses.replace(from_frames(va.World(va.CartPole())), perception=PerceptionSettings(2, streams=2))
    return cartpole_frames(settings=few)


REST = va.Regulate(Pendulum(), goal={"angle": 0.5}, tolerance={"angle": 0.1, "rate": 1.0})
SETUPS = {
    "cartpole_states": cartpole_states,
    "cartpole_frames": frames,
    "quadrotor": lambda: small_quadrotor(with_history=True),
    "fixed_wing": lambda: fixed_wing(with_history=True),
    "own system": lambda: regulator(va.World(Pendulum(), period=0.05), REST),
}


def short(name):
    """A setup with few iterations of few plans, of a vehicle in Euler's steps, one for each command."""
    setup = SETUPS[name]()
    if setup.test is not None:
        source = va.World(setup.source.system, period=setup.source.period, integrator="euler", substeps=1)
        setup = dataclasses.replace(setup, source=source)

    def fewer(tuning):
        few = tuning.streams and 4
        return dataclasses.replace(tuning, iterations=2, batch=4, streams=few)

    own = setup.settings.with_tuning(fewer)
    own = dataclasses.replace(
        own,
        source=fewer(own.source),
        refinement=own.refinement and fewer(own.refinement),
        ground=dataclasses.replace(own.ground, steps=5),
    )
    return dataclasses.replace(setup, settings=own)


def target(setup):
    if isinstance(setup.settings.source.task, va.Regulate):
        return va.RegulationTarget(REST, setup.source.period)
    if setup.test is not None:
        return va.FlightTarget(setup.test, setup.source.system)
    return va.SyntheticTarget(va.constant_force(2.0), DrawnCartPole() if setup.renderer else None)


def shipped(setup, name, like):
    """The policy that the library ships for the setup, or a new one, with the device and dtype of `like`."""
    torch.manual_seed(0)
    return (setup.policy() if name == "own system" else setup.load(va.shipped(name))).to(like)


def weights(policy):
    return {key: value.detach().cpu() for key, value in policy.state_dict().items()}


def same(found, expected):
    """Whether weights are the same; a GPU's may differ by what rounding makes of the few small steps of Adam."""
    if not GPU:
        return found.keys() == expected.keys() and all(torch.equal(found[key], expected[key]) for key in expected)
    return found.keys() == expected.keys() and all(
        torch.allclose(found[key].double(), expected[key].double(), rtol=0.01, atol=0.01) for key in expected
    )


def learnt(name, like, folder):
    """What tuning, adaptation and scores leave: losses, weights, and the score."""
    setup = short(name)
    policy = shipped(setup, name, like)
    losses = setup.tune(policy, 1)
    run = setup.adapt(policy, target(setup), folder, 4, 4, 1)
    losses += [loss for each in run.rounds for loss in each.policy]
    assert {parameter.dtype for parameter in policy.parameters()} == {like.dtype}
    assert {parameter.device for parameter in policy.parameters()} == {like.device}
    return losses, weights(policy), va.score(policy, target(setup), episodes=2, steps=2)


@pytest.fixture(scope="module", params=SETUPS)
def learnt_here(request, coarse, tmp_path_factory):
    """The name of a setup, and what is learnt with it on the CPU in single precision."""
    return request.param, learnt(request.param, torch.zeros(()), tmp_path_factory.mktemp("here"))


def test_a_policy_in_double_precision_learns_the_same_up_to_rounding(learnt_here, tmp_path):
    name, (single, _, _) = learnt_here
    double, found, _ = learnt(name, torch.zeros((), dtype=torch.float64), tmp_path / "double")
    assert double == pytest.approx(single, rel=0.01)
    assert all(value.isfinite().all() for value in found.values())


def test_the_second_device_refuses_tensors_of_the_first():
    with second_device():
        remote, here = torch.ones(2, device=DEVICE), torch.ones(2)
        assert (remote * torch.tensor(3.0)).cpu().tolist() == [3.0, 3.0]
        assert remote[torch.tensor([1])].cpu().tolist() == [1.0]
        for mix in (lambda: remote + here, lambda: torch.cat((remote, here)), lambda: here[remote.long()]):
            with pytest.raises(RuntimeError, match="same device" if GPU else "tensors on two devices"):
                mix()


def test_a_policy_on_another_device_learns_the_same_there(learnt_here, tmp_path):
    name, here = learnt_here
    with second_device():
        there = learnt(name, torch.zeros((), device=DEVICE), tmp_path / "there")
    assert there[0] == pytest.approx(here[0], rel=0.01 * GPU, abs=0)
    assert same(there[1], here[1])
    if not GPU:
        assert there[2] == here[2]


@pytest.mark.parametrize("name", SETUPS)
def test_a_policy_that_is_made_on_another_device_is_trained_and_loaded_there(name, tmp_path):
    setup = short(name)
    here = weights(setup.pretrain(tmp_path / "here.safetensors", 1))
    with second_device():
        there = dataclasses.replace(setup, policy=lambda: setup.policy().to(DEVICE))
        there.pretrain(tmp_path / "there.safetensors", 1)
        loaded = there.load(tmp_path / "there.safetensors")
        assert next(loaded.parameters()).device == DEVICE
        there = weights(loaded)
    back = weights(setup.load(tmp_path / "there.safetensors"))
    assert all(torch.equal(back[key], value) for key, value in there.items())
    assert same(there, here)


@pytest.mark.parametrize(("name", "began", "goes_on"), [("quadrotor", CPU, DEVICE), ("cartpole_frames", DEVICE, CPU)])
def test_a_run_that_was_interrupted_goes_on_on_another_device(name, began, goes_on, tmp_path, monkeypatch):
    monkeypatch.setattr(training_state, "CHECKPOINT_ITERATIONS", 1)
    setup = short(name)
    own = setup.settings
    setup = dataclasses.replace(setup, settings=dataclasses.replace(own, tuning=own.named or own.tuning))

    def interrupt(stage, done, of, loss):
        if stage == "round 1/1: tune" and done == 2:
            raise KeyboardInterrupt

    def adapted(device, folder, report=None):
        policy = shipped(setup, name, torch.zeros((), device=device))
        setup.adapt(policy, target(setup), folder, 3, 3, 1, report)
        return weights(policy)

    whole = adapted(CPU, tmp_path / "whole")
    with second_device():
        with contextlib.suppress(KeyboardInterrupt):
            adapted(began, tmp_path / "cut", interrupt)
        assert list((tmp_path / "cut").rglob("*.partial.safetensors"))
        found = adapted(goes_on, tmp_path / "cut")
    assert same(found, whole)


def test_effects_act_on_another_device():
    effects = (
        va.effects.PeriodicForce(amplitude=1.0, frequency=0.3, phase=0.0, offset=0.0),
        va.effects.ActuatorDelay(delay=0.03),
        va.effects.Dropout(rate=0.1),
    )
    source = va.World(va.CartPole(), effects)
    policy = va.load_policy(va.shipped("cartpole_states"))
    here = weights(va.adapt(policy, source, iterations=2))
    with second_device():
        there = weights(va.adapt(policy.to(DEVICE), source, iterations=2))
    assert same(there, here)


def test_an_adaptation_with_a_diagnosis_takes_a_policy_in_double_precision(only_effects):
    only_effects("viscous_friction", "actuator_gain")
    policy = va.load_policy(va.shipped("cartpole_states")).double()
    rubs = va.SyntheticTarget(lambda batch, generator: [va.effects.ViscousFriction(coefficient=0.8)])
    run = va.adapt(policy, va.World(va.CartPole()), rubs, 40, round_samples=40, iterations=1, diagnose=True)
    assert run.rounds[0].explanation.verdict == "identified"
    assert next(run.policy.parameters()).dtype == torch.float64


def test_an_experiment_takes_the_actions_of_a_policy_on_another_device():
    policy = va.load_policy(va.shipped("cartpole_states"))
    history = History.start(torch.ones(2, 4, dtype=torch.float64), 1)
    here = actions(policy, va.CartPole(), history)
    with second_device():
        there = actions(policy.to(DEVICE), va.CartPole(), history)
    assert torch.allclose(there, here, rtol=0, atol=1e-5) if GPU else torch.equal(there, here)
