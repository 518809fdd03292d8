"""Policies of systems of one's own: the regulator that they begin as, and what adapting them is worth."""

from dataclasses import replace

import numpy as np
import onnxruntime
import pytest
import torch
from hypothesis import given, settings, strategies

import visadapt as va
from tests.own_systems import Drive, Pendulum
from visadapt.evaluation import RegulationScore
from visadapt.history import HORIZON, History
from visadapt.policies import RegulatorPolicy, StatePolicy
from visadapt.setups.regulator import regulator

PERIOD = 0.02
TASK = va.Regulate(
    Pendulum(), goal={"angle": 0.5}, tolerance={"angle": 0.1, "rate": 1.0}, limits={"angle": 1.5}, seconds=2.0
)
OWN = {effect.name: effect for effect in va.catalogue(Pendulum())}


def weak(batch, generator):
    return [OWN["torque.actuator_gain"](scale=0.7)]


def policy_of(task=TASK):
    return regulator(va.World(task.system, period=PERIOD), task).policy()


def error(policy, draw) -> float:
    found = va.score(policy, va.RegulationTarget(TASK, PERIOD, draw), episodes=5)
    assert isinstance(found, RegulationScore)
    assert found.survived == 5
    assert found.errors is not None
    return found.errors["angle"]


def test_the_plan_of_a_new_policy_is_what_its_feedback_goes_on_to_do():
    world, policy = va.World(Pendulum(), period=PERIOD), policy_of()
    history = History.start(torch.tensor([[0.5005, 0.001]]), 1)
    at = world.start(history.observations[:, -1])
    with torch.no_grad():
        plan = policy(history)[0, :, 0]
        for k in range(HORIZON):
            command = policy.act(history)
            # The law is linear in small distances from the goal, the pendulum nearly so.
            assert float(plan[k] - command) == pytest.approx(0.0, abs=1e-4)
            at = world.step(at, command)
            history = history.acting(command).observing(at.state)


class WithinATurn(va.RegulationTarget):
    """Its sensor reads the angle between -pi and pi."""

    def reset(self, batch, generator):
        return self._read(super().reset(batch, generator))

    def step(self, action):
        return self._read(super().step(action))

    def _read(self, seen):
        turns = torch.tensor([1.0, 0.0]) * (seen.state / (2 * torch.pi)).round()
        return replace(seen, state=seen.state - 2 * torch.pi * turns)


def test_an_upright_angle_may_be_read_within_a_turn():
    upright = va.Regulate(Pendulum(), goal={"angle": 3.0}, tolerance={"angle": 0.1, "rate": 1.0}, seconds=1.0)
    policy = policy_of(upright)
    runs = [
        va.run(kind(upright, PERIOD, noise={"angle": 0.05}), policy, 5, 50, torch.Generator().manual_seed(0))
        for kind in (va.RegulationTarget, WithinATurn)
    ]
    for plain, wrapped in zip(*runs, strict=True):
        assert wrapped.survived
        np.testing.assert_allclose(wrapped.episode.state, plain.episode.state, atol=1e-4)
    assert max(each.episode.state[:, 0].max() for each in runs[1]) > np.pi


def test_where_a_turn_further_is_elsewhere_or_the_range_is_of_several_turns_angles_are_read_as_they_are():
    assert policy_of().turning == [0]
    assert DRIVE.turning == []
    far = torch.tensor([[7.0, 40.0, 0.0, 0.0]])
    assert torch.equal(DRIVE.unwrapped(far, None), far)


DRIVE = policy_of(va.Regulate(Drive(), tolerance={"disc": 0.05}))


def test_a_target_measures_with_the_noise_that_it_is_given():
    target = va.RegulationTarget(TASK, PERIOD, noise={"rate": 0.1})
    exact = va.RegulationTarget(TASK, PERIOD)
    away = [one.reset(1000, torch.Generator().manual_seed(0)).state for one in (target, exact)]
    angle, rate = (away[0] - away[1]).std(0).tolist()
    assert angle == 0
    assert rate == pytest.approx(0.1, rel=0.1)


@given(strategies.lists(strategies.floats(-50, 50), min_size=4, max_size=4))
@settings(max_examples=25, deadline=None)
def test_no_command_leaves_the_range_of_its_action(state):
    with torch.no_grad():
        plan = DRIVE(History.start(torch.tensor([state]), 1))
    assert float(plan.abs().max()) <= 0.2 + 1e-6


@pytest.fixture(scope="module")
def trained() -> RegulatorPolicy:
    policy = va.train(va.World(Pendulum(), period=PERIOD), iterations=20, task=TASK)
    assert isinstance(policy, RegulatorPolicy)
    return policy


def test_an_episode_beyond_the_limits_has_failed_where_the_target_does_not_know_them(trained):
    pushed = va.RegulationTarget(replace(TASK, limits={}), PERIOD, lambda *_: [OWN["joint.constant_load"](torque=5.0)])
    (one,) = va.run(pushed, trained, 1, 100, torch.Generator().manual_seed(0))
    assert one.survived
    assert abs(one.episode.state[:, 0] - 0.5).max() > 1.5
    found = va.score(trained, pushed, episodes=5)
    assert (found.survived, found.errors) == (0, None)


def test_a_policy_tuned_with_the_effect_brings_the_machine_to_its_goal(trained):
    assert error(trained, lambda *_: ()) < 0.002
    before = error(trained, weak)
    world = va.World(Pendulum(), weak(1, None), PERIOD)
    assert error(va.adapt(trained, world, iterations=100), weak) < 0.3 * before


@pytest.mark.parametrize("diagnose", [False, True])
def test_a_few_hundred_samples_of_the_machine_do_the_same(trained, diagnose):
    source, target = va.World(Pendulum(), period=PERIOD), va.RegulationTarget(TASK, PERIOD, weak)
    found = va.adapt(trained, source, target, samples=200, round_samples=200, iterations=100, diagnose=diagnose)
    assert found.ledger.used == 200
    assert error(found.policy, weak) < 0.4 * error(trained, weak)
    if diagnose:
        explanation = found.rounds[-1].explanation
        assert [effect.name for effect in explanation.effects] == ["torque.actuator_gain"]


def test_a_file_keeps_task_residual_and_actions(trained, tmp_path):
    source, target = va.World(Pendulum(), period=PERIOD), va.RegulationTarget(TASK, PERIOD, weak)
    adapted = va.adapt(trained, source, target, samples=40, round_samples=40, iterations=2).policy
    va.save_policy(tmp_path / "policy.safetensors", adapted)
    loaded = va.load_policy(tmp_path / "policy.safetensors")
    assert isinstance(loaded, RegulatorPolicy)
    assert loaded.residual is not None
    assert va.Regulate(Pendulum(), **loaded.task) == TASK
    generator = torch.Generator().manual_seed(0)
    history = History(torch.rand(3, 5, 2, generator=generator), torch.rand(3, 5, 1, generator=generator))
    assert torch.equal(loaded(history), adapted(history))
    va.export_policy(tmp_path / "policy.onnx", loaded, source)
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx")
    named = {"observations": history.observations[0].numpy(), "actions": history.actions[0].numpy()}
    assert np.abs(session.run(None, named)[0] - loaded(history)[0].numpy(force=True)).max() < 1e-4
    assert "in [-2, 2]" in session.get_modelmeta().custom_metadata_map["actions"]


def test_what_a_task_does_not_go_with_is_refused(trained):
    world = va.World(Pendulum(), period=PERIOD)
    with pytest.raises(ValueError, match="what a pendulum is to do is not known: give a task"):
        va.train(world)
    with pytest.raises(ValueError, match="the task is of a drive, the world of a pendulum"):
        va.train(world, task=va.Regulate(Drive(), tolerance={"disc": 0.05}))
    with pytest.raises(ValueError, match="has no use for a renderer, references or a history"):
        va.train(world, task=TASK, with_history=True)
    with pytest.raises(ValueError, match=r"torque of a pendulum ranges from -2 to 2 N m, the commands of the policy"):
        replace(regulator(world, TASK), policy=lambda: StatePolicy(2))


def test_a_policy_tuned_for_a_sensor_that_is_off_is_kept_though_its_readings_look_worse(trained):
    source = va.World(Pendulum(), period=PERIOD)
    target = va.RegulationTarget(TASK, PERIOD, lambda *_: [OWN["angle.sensor_offset"](offset=0.08)])
    found = va.adapt(trained, source, target, samples=200, round_samples=100, iterations=60, diagnose=True)
    assert [effect.name for effect in found.source.effects] == ["angle.sensor_offset"]
    assert found.taken_back == ""
    (read,) = va.run(target, found.policy, 1, 100, torch.Generator().manual_seed(0))
    assert read.episode.state[-1, 0] == pytest.approx(0.58, abs=0.005)  # where it is read when it is at its goal
