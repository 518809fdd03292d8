"""What `train` and `adapt` leave alone: the caller's world, and what they cannot know."""

import copy
from dataclasses import replace
from typing import Any

import pytest
import torch

import visadapt as va
from renderers import LayeredRenderer, load_renderer
from tests.coarse import coarse_targets
from tests.flying import waves
from visadapt.learning.rounds import RoundFolder
from visadapt.policies.networks import StateResidualNetwork
from visadapt.setups.training import setup_to_adapt
from visadapt.tasks.follow import Follow
from visadapt.tasks.reach import Reach


@pytest.fixture(scope="module", autouse=True)
def coarse():
    with coarse_targets(0.05):
        yield


@pytest.fixture
def policy():
    return va.load_policy(va.shipped("cartpole_states"))


def test_the_worlds_that_are_given_stay_as_they_are(policy):
    source = va.World(va.CartPole(), [va.effects.ViscousFriction(coefficient=0.0)])
    before = copy.deepcopy(source.state_dict())
    first = va.adapt(policy, source, va.SyntheticTarget(va.constant_force(2.0)), samples=20, iterations=1)
    fitted = float(first.source.values[0])
    va.adapt(policy, source, va.SyntheticTarget(), samples=20, iterations=1)
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


@pytest.mark.parametrize("changed", ["policy", "known", "machine"])
def test_a_run_does_not_go_on_with_another_policy_source_or_machine(policy, tmp_path, changed):
    def run(policy, mass=0.1, target_mass=0.1):
        target = va.SyntheticTarget(system=va.CartPole(pole_mass=target_mass))
        va.adapt(policy, va.World(va.CartPole(pole_mass=mass)), target, 20, tmp_path, iterations=1)

    run(policy)
    with pytest.raises(ValueError, match=rf"holds a run with other settings \({changed}"):
        run(
            va.adapt(policy, va.World(va.CartPole()), iterations=1) if changed == "policy" else policy,
            0.2 if changed == "known" else 0.1,
            0.2 if changed == "machine" else 0.1,
        )


def test_the_callers_random_numbers_go_on(policy):
    source, target = va.World(va.CartPole()), va.SyntheticTarget()
    torch.manual_seed(1)
    expected = torch.rand(1)
    torch.manual_seed(1)
    va.adapt(policy, source, target, samples=20, iterations=1)
    va.train(source, iterations=1)
    assert torch.equal(torch.rand(1), expected)


def test_an_adapted_policy_collects_with_the_residual_that_it_has(policy, tmp_path):
    source, target = va.World(va.CartPole()), va.SyntheticTarget(va.constant_force(4.0))
    adapted = va.adapt(policy, source, target, samples=40, iterations=2).policy
    alone = va.run(target, adapted, 1, 20, torch.Generator().manual_seed(RoundFolder.of(tmp_path, 0, 1, 0).seed), 0.05)
    again = va.adapt(adapted, source, target, samples=20, folder=tmp_path, iterations=1).episodes[0]
    assert again.state == pytest.approx(alone[0].episode.state)


def test_tuned_without_a_target_it_loses_the_residual_of_another_world(policy):
    source = va.World(va.CartPole())
    adapted = va.adapt(policy, source, va.SyntheticTarget(va.constant_force(4.0)), samples=40, iterations=1).policy
    tuned = va.adapt(adapted, va.World(va.CartPole(pole_mass=0.2)), iterations=1)
    assert tuned.residual is None
    assert adapted.residual is not None


def test_a_policy_that_was_tuned_says_in_which_world(policy, tmp_path):
    world = va.World(va.CartPole(pole_mass=0.2), [va.effects.ViscousFriction(coefficient=2.0)])
    va.save_policy(tmp_path / "tuned.safetensors", va.adapt(policy, world, iterations=1))
    source = va.load_source(tmp_path / "tuned.safetensors")
    assert source.system == world.system
    assert [effect.name for effect in source.effects] == ["viscous_friction"]


def test_an_episode_of_one_sample_shows_no_frequency(policy):
    force = va.effects.PeriodicForce(amplitude=0.0, frequency=0.2, phase=0.0, offset=0.0)
    target = va.SyntheticTarget(va.sine_force)
    run = va.adapt(policy, va.World(va.CartPole(), [force]), target, samples=41, round_samples=40, iterations=1)
    assert run.ledger.used == 41


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


def test_a_policy_is_not_tuned_in_a_world_of_another_period(policy):
    with pytest.raises(
        ValueError, match=r"trained for 0\.05 s .* every 0\.02 s: World\(\.\.\., period=0\.05\) is right"
    ):
        va.adapt(policy, va.World(va.CartPole(), period=0.02))


def test_what_is_no_policy_or_no_world_is_told_what_would_be(policy):
    file: Any = "policy.safetensors"
    network: Any = torch.nn.Linear(4, 1)
    system: Any = va.CartPole()
    with pytest.raises(TypeError, match=r"^a str is no policy: load_policy reads a file$"):
        va.score(file, va.SyntheticTarget())
    with pytest.raises(TypeError, match=r"^a Linear is no policy: one that visadapt.train makes is right"):
        va.adapt(network, va.World(va.CartPole()), va.SyntheticTarget())
    with pytest.raises(TypeError, match=r"^adapt: CartPole is no World; World\(system, period=\.\.\.\) is right$"):
        va.adapt(policy, system, va.SyntheticTarget())


def test_a_flight_is_scored_over_fewer_steps_than_its_task_has_but_not_over_more():
    target = va.FlightTarget(Follow(waves(3, rows=21)), va.Quadrotor())
    policy = va.load_policy(va.shipped("quadrotor"))
    assert va.score(policy, target, episodes=3, steps=5).flights == 3
    with pytest.raises(ValueError, match="a flight of this task has 20 steps, got steps = 21"):
        va.score(policy, target, episodes=3, steps=21)


def test_effects_with_a_value_for_each_row_of_a_batch_are_refused():
    with pytest.raises(ValueError, match="periodic_force has 64 values of a parameter, one for each row of a batch"):
        va.train(va.World(va.CartPole(), va.sine_force(64, torch.Generator())), iterations=1)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"folder": "run"}, "are for a target, and none is given"),
        ({"diagnose": True}, "are for a target, and none is given"),
        ({"iterations": -1}, "-1 iterations"),
        ({"references": waves(3, rows=21)}, "references are for a quadrotor, not for a cartpole"),
    ],
)
def test_what_has_no_use_is_refused(policy, options, said):
    with pytest.raises(ValueError, match=said):
        va.adapt(policy, va.World(va.CartPole()), **options)


def test_a_wing_is_adapted_to_the_points_of_its_target():
    task = Reach(distance=100.0, sideways=15.0, speed=13.0)
    policy, source = va.load_policy(va.shipped("fixed_wing")), va.World(va.FixedWing())
    setup = setup_to_adapt(policy, source, va.FlightTarget(task, va.FixedWing()))
    assert setup.settings.longest_episode == task.steps
    assert setup.settings.tuning.task == task
    with pytest.raises(ValueError, match="a renderer has no use: leave it out"):
        setup_to_adapt(policy, source, va.FlightTarget(task, va.FixedWing()), va.shipped("renderer"))


def test_a_source_policy_sees_as_the_settings_of_its_setup_say(tmp_path):
    setup = va.setup_for(va.World(va.CartPole()), renderer=va.shipped("renderer"))
    brief = replace(setup.settings.shortened(1), perception=replace(setup.settings.perception, iterations=2))
    stages = []
    replace(setup, settings=brief).pretrain(tmp_path / "p.safetensors", 0, lambda *seen: stages.append(seen))
    assert [steps for stage, _, steps, _ in stages if "perception" in stage][-1] == 2


def test_a_renderer_that_is_given_stays_as_it_is():
    given = load_renderer(va.shipped("renderer")).train().requires_grad_(True)
    assert isinstance(given, LayeredRenderer)
    va.setup_for(va.World(va.CartPole()), renderer=given)
    assert given.training
    assert all(each.requires_grad for each in given.parameters())


def test_references_too_short_for_a_history_are_refused():
    with pytest.raises(ValueError, match="references of 5 rows are too short for a history: 6 are right"):
        va.setup_for(va.World(va.Quadrotor(), period=0.1), references=waves(3, rows=5), with_history=True)
