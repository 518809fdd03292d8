"""What `train` and `adapt` leave alone: the caller's world, and what they cannot know."""

import copy
from dataclasses import replace

import pytest
import torch

import visadapt as va
from tests.flying import waves
from visadapt.policies.networks import StateResidualNetwork
from visadapt.tasks.follow import Follow


@pytest.fixture
def policy():
    return va.load_policy(va.shipped("cartpole_states"))


def test_the_worlds_that_are_given_stay_as_they_are(policy):
    source = va.World(va.CartPole(), [va.effects.ViscousFriction(coefficient=0.0)])
    before = copy.deepcopy(source.state_dict())
    first = va.adapt(policy, source, va.SyntheticTarget(va.constant_force(2.0)), samples=40, iterations=1)
    fitted = float(first.source.values[0])
    va.adapt(policy, source, va.SyntheticTarget(), samples=40, iterations=1)
    assert all(torch.equal(source.state_dict()[key], value) for key, value in before.items())
    assert float(first.source.values[0]) == fitted != 0.0
    va.train(source, iterations=1)
    assert all(parameter.requires_grad for parameter in source.parameters())


def test_effects_of_the_camera_are_not_fitted_to_states(policy):
    turned = va.World(va.CartPole(), [va.effects.CameraRotation(angle=0.05), va.effects.FrameDrop(rate=0.1)])
    found = va.adapt(policy, turned, va.SyntheticTarget(), samples=40, iterations=1)
    assert [effect.name for effect in found.source.effects] == ["camera_rotation", "frame_drop"]
    assert float(found.source.values[0]) == pytest.approx(0.05)


def test_a_run_that_was_not_kept_says_so(policy):
    found = va.adapt(policy, va.World(va.CartPole()), va.SyntheticTarget(), samples=20, iterations=1)
    with pytest.raises(ValueError, match="this run was not kept: give adapt a folder"):
        found.restore(found.policy, 20)


def test_a_run_does_not_go_on_with_what_was_not_asked_for(policy, tmp_path):
    source, target = va.World(va.CartPole()), va.SyntheticTarget()
    va.adapt(policy, source, target, samples=20, folder=tmp_path, iterations=1)
    with pytest.raises(ValueError, match=r"holds a run with other settings \(samples, seed\)"):
        va.adapt(policy, source, target, samples=60, folder=tmp_path, iterations=1, seed=7)


def test_an_episode_of_one_sample_shows_no_frequency(policy):
    force = va.effects.PeriodicForce(amplitude=0.0, frequency=0.2, phase=0.0, offset=0.0)
    target = va.SyntheticTarget(va.sine_force)
    run = va.adapt(policy, va.World(va.CartPole(), [force]), target, samples=81, round_samples=80, iterations=1)
    assert run.ledger.used == 81


def test_a_residual_is_no_part_of_a_source(policy):
    residual = va.Residual(StateResidualNetwork(4), torch.ones(4))
    with pytest.raises(ValueError, match="the source has a residual, which is learnt for a target"):
        va.adapt(policy, va.World(va.CartPole(), [residual]))


def test_a_policy_that_aims_at_goals_of_another_clock_is_refused():
    policy = va.load_policy(va.shipped("quadrotor"))
    with pytest.raises(ValueError, match=r"aims at goals 0\.1 s apart, the source has 0\.05 s between actions"):
        va.adapt(
            policy,
            va.World(va.Quadrotor(), period=0.05),
            references=replace(waves(3, rows=21), period=0.05),
            iterations=1,
        )


def test_a_flight_is_scored_over_fewer_steps_than_its_task_has_but_not_over_more():
    target = va.FlightTarget(Follow(waves(3, rows=21)), va.Quadrotor())
    policy = va.load_policy(va.shipped("quadrotor"))
    assert va.score(policy, target, episodes=3, steps=5).flights == 3
    with pytest.raises(ValueError, match="a flight of this task has 20 steps, got steps = 21"):
        va.score(policy, target, episodes=3, steps=21)


def test_effects_with_a_value_for_each_row_of_a_batch_are_refused():
    with pytest.raises(ValueError, match="periodic_force has 64 values of a parameter, one for each row of a batch"):
        va.train(va.World(va.CartPole(), va.sine_force(64, torch.Generator())), iterations=1)
