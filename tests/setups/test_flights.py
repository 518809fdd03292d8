import math
import shutil
from dataclasses import replace

import pytest
import torch

import visadapt as va
from tests.coarse import coarse_targets
from tests.flying import PERIOD, drag, push, seeded, small_quadrotor, straight, waves
from visadapt.effects import ConstantForce
from visadapt.evaluation import score
from visadapt.evaluation.scoring import FAR
from visadapt.history import HORIZON
from visadapt.policies import AutoregressivePolicy, FollowPolicy, Policy
from visadapt.setups.flight import fixed_wing
from visadapt.storage.checkpoints import CheckpointError
from visadapt.storage.run_folder import RunError
from visadapt.systems import FixedWing, Quadrotor
from visadapt.systems.rigid_body import POSITION, VELOCITY
from visadapt.targets import FlightTarget, TargetError
from visadapt.targets.rollout import run
from visadapt.tasks.follow import Follow
from visadapt.tasks.reach import Reach
from visadapt.world import World


class Still(Policy):
    """Commands nothing; the flight `broken` gets NaN from step `at` on."""

    def __init__(self, broken=None, at=3):
        super().__init__(13, 4)
        self.broken = broken
        self.at = at
        self.steps = 0

    def forward(self, history):
        plan = torch.zeros(len(history.observations), HORIZON, 4)
        if self.broken is not None and self.steps >= self.at:
            plan[self.broken] = math.nan
        self.steps += 1
        return plan


class Level(Still):
    """Commands of the wing's level flight."""

    def forward(self, history):
        command = FixedWing().trim(torch.tensor([Reach.speed]))[1]
        return command.repeat(len(history.observations), HORIZON, 1)


def uncertain(batch, generator):
    """Draws a force along x that differs from flight to flight."""
    return (ConstantForce(force=4 * torch.rand(batch, generator=generator) - 2),)


def a_target(draw=None, rows=11, **more):
    return FlightTarget(Follow(waves(5, rows)), Quadrotor(), *([draw] if draw else []), **more)


class TestTarget:
    def test_the_same_seed_gives_the_same_flights_and_another_others(self):
        target = a_target(uncertain)
        one, same, other = (run(target, Still(), 4, 8, seeded(seed)) for seed in (0, 0, 1))
        for a, b, c in zip(one, same, other, strict=True):
            assert (a.episode.state == b.episode.state).all()
            assert (a.force == b.force).all()
            assert (a.force[:, 0] != c.force[:, 0]).all()

    @pytest.mark.parametrize("made", [a_target, lambda: FlightTarget(Reach(), FixedWing())])
    def test_without_effects_it_agrees_with_the_source_though_it_integrates_otherwise(self, made):
        target = made()
        source = World(target.system, period=target.period, substeps=4)
        seen, generator = target.reset(5, seeded()), seeded(1)
        at = source.start(seen.state)
        for _ in range(8):
            action = 0.4 * torch.rand(5, 4, generator=generator) - 0.2
            seen, at = target.step(action), source.step(at, action)
        torch.testing.assert_close(seen.state, at.state, rtol=1e-3, atol=1e-3)

    def test_hidden_effects_act_and_are_told_for_films(self):
        plain, pushed = a_target(), a_target(push(1.5))
        one, other = plain.reset(4, seeded()), pushed.reset(4, seeded())
        assert torch.equal(one.state, other.state)
        for _ in range(5):
            one, other = plain.step(torch.zeros(4, 4)), pushed.step(torch.zeros(4, 4))
        gone = other.state - one.state
        torch.testing.assert_close(gone[:, 0], torch.full((4,), 1.5 * 0.5**2 / 2), rtol=1e-3, atol=1e-4)
        torch.testing.assert_close(gone[:, VELOCITY.start], torch.full((4,), 0.75), rtol=1e-3, atol=1e-4)
        torch.testing.assert_close(gone[:, 1:3], torch.zeros(4, 2), rtol=0, atol=1e-4)
        torch.testing.assert_close(other.force, torch.tensor([[1.5, 0.0, 0.0]]).expand(4, -1))
        assert not one.force.any()

    def test_the_goal_it_tells_goes_on_with_the_flight_whatever_the_vehicle_does(self):
        target = a_target(push(5.0))
        seen = target.reset(4, seeded())
        assert target.first[:, 1].tolist() == [0] * 4
        which = target.first[:, 0]
        for row in range(7):
            wanted = target.task.goal(torch.stack((which, torch.full((4,), row)), 1))
            assert torch.equal(seen.goal, wanted)
            seen = target.step(torch.zeros(4, 4))

    def test_a_flight_goes_on_however_far_it_strays_and_ends_where_it_is_not_finite(self):
        target = a_target(push(200.0))
        target.reset(3, seeded())
        for _ in range(5):
            seen = target.step(torch.zeros(3, 4))
        assert (seen.state[:, 0] > 20).all()
        assert seen.alive.all()
        action = torch.zeros(3, 4)
        action[1] = math.nan
        assert target.step(action).alive.tolist() == [True, False, True]

    def test_given_a_reach_a_flight_ends_where_it_is_further_off(self):
        task = Follow(straight(rows=21))
        near, far = (FlightTarget(task, Quadrotor(), push(6.0), reach=reach) for reach in (1.0, math.inf))
        ended, whole = (run(target, Still(), 2, 20, seeded()) for target in (near, far))
        for one, other, which in zip(ended, whole, near.first[:, 0], strict=True):
            away = torch.from_numpy(other.episode.state[:, POSITION]) - task.references.positions[which]
            assert one.episode.samples == int((away.norm(dim=1) > 1.0).int().argmax())
            assert not one.survived
            assert other.survived

    def test_beyond_its_point_a_flight_may_go_where_it_likes(self):
        policy = va.load_policy(va.shipped("fixed_wing"))
        task = va.setup_for(va.World(va.FixedWing()), policy).settings.source.task
        assert isinstance(task, Reach)
        near, far = (FlightTarget(task, FixedWing(), reach=reach) for reach in (5.0, math.inf))
        with coarse_targets(0.025):
            ended, whole = (score(policy, target, episodes=8, seed=0) for target in (near, far))
        assert ended == whole
        assert math.isfinite(ended.mean)

    def test_a_step_before_a_reset_is_an_error(self):
        with pytest.raises(TargetError, match="synthetic vehicle: step before reset"):
            a_target().step(torch.zeros(1, 4))


class TestScore:
    def test_it_is_the_mean_over_flights_of_the_mean_distance_over_each(self):
        target = a_target()
        found = score(Still(), target, 5, 3)
        runs = run(a_target(), Still(), 5, 10, seeded(3))
        own, which = target.task.references, target.first[:, 0]
        away = torch.stack(
            [
                (torch.from_numpy(each.episode.state[1:, POSITION]) - own.positions[k, 1:]).norm(dim=-1)
                for k, each in zip(which, runs, strict=True)
            ]
        )
        means = away.mean(1)
        assert (found.flights, found.failed) == (5, int((away.amax(1) > FAR).sum()))
        assert found.mean == pytest.approx(float(means.mean()), rel=1e-5)
        assert found.std == pytest.approx(float(means.std(correction=0)), rel=1e-5)
        assert found.worst == pytest.approx(float(away.max()), rel=1e-6)

    def test_a_flight_that_strays_beyond_a_metre_has_failed_and_counts_with_what_it_missed_by(self):
        # 1 s under a force of 6 N: 3 m at its end, 1 m on the way.
        near, far = (score(Still(), a_target(draw), 5, 0) for draw in (None, push(6.0)))
        assert (near.failed, far.failed) == (0, 5)
        assert far.mean == pytest.approx(1.1, abs=2 * near.mean)
        assert math.isfinite(far.worst)
        assert "0 of 5 stayed near" in str(far)

    def test_one_that_is_not_finite_is_infinite_in_the_mean_and_the_others_are_still_counted(self):
        found, whole = score(Still(broken=2), a_target(), 5, 0), score(Still(), a_target(), 5, 0)
        assert found.flights == 5
        assert whole.failed <= found.failed <= whole.failed + 1
        assert (found.mean, found.std, found.worst) == (math.inf, math.inf, math.inf)

    def test_while_data_are_collected_it_is_an_error(self):
        with pytest.raises(TargetError, match=r"synthetic vehicle: the state after step 4 is not finite \(episode 2\)"):
            run(a_target(), Still(broken=2), 5, 10, seeded())

    def test_a_wing_is_scored_by_how_near_it_came_to_its_point(self):
        target = FlightTarget(Reach(distance=6.0, sideways=3.0), FixedWing())
        found = score(Level(), target, 10, 0)
        aside = target.first[:, 1:].norm(dim=1)
        assert found.mean == pytest.approx(float(aside.mean()), abs=0.01)
        assert found.worst == pytest.approx(float(aside.max()), abs=0.01)
        assert found.failed == int((aside > FAR).sum())


SMALL = {"iterations": 4, "learning_rate": 1e-3, "batch": 8, "longest": 10}


def small(with_history=False):
    """A quadrotor that learns little, in Euler's steps."""
    setup = small_quadrotor(rows=11, with_history=with_history, **SMALL)
    return replace(setup, source=World(Quadrotor(), period=PERIOD, integrator="euler", substeps=2))


def adapted(folder, with_history=False, report=None, stops_at=None, draw=None, explorer=None):
    """30 samples in two rounds, in flights of at most 10."""
    setup = small(with_history)
    torch.manual_seed(0)
    policy = FollowPolicy(PERIOD)
    target = Counted(setup.settings.source.task, Quadrotor(), draw or drag(0.3))
    target.stops_at = stops_at
    with coarse_targets(0.05):
        found = setup.adapt(policy, target, folder, 30, 18, seed=1, report=report, explorer=explorer)
    return policy, found, target


class Counted(FlightTarget):
    """Counts its steps, and stops the run at one."""

    steps = 0
    stops_at = None

    def step(self, action):
        self.steps += len(action)
        if self.steps == self.stops_at:
            raise KeyboardInterrupt
        return super().step(action)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return adapted(tmp_path_factory.mktemp("whole"))


class TestAdapt:
    def test_the_ledger_counts_exactly_the_steps_that_the_target_took(self, whole):
        _, found, target = whole
        assert found.ledger.used == target.steps == 30
        assert [episode.samples for episode in found.episodes] == [10, 8, 10, 2]
        assert [each.samples for each in found.rounds] == [18, 30]
        assert [len(each.policy) for each in found.rounds] == [4, 4]

    @pytest.mark.parametrize(("stage", "after"), [("data", 24), ("round 1/2: tune", 3)])
    def test_interrupted_and_started_again_it_ends_with_the_same_weights(
        self, whole, tmp_path, monkeypatch, stage, after
    ):
        monkeypatch.setattr("visadapt.learning.training_state.CHECKPOINT_ITERATIONS", 2)

        def report(name, done, total, loss):
            if name == stage and done == after:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            adapted(tmp_path, report=report, stops_at=after if stage == "data" else None)
        policy, again, _ = adapted(tmp_path)
        for key, value in whole[0].state_dict().items():
            assert torch.equal(value, policy.state_dict()[key]), key
        assert again.rounds == whole[1].rounds
        assert again.ledger == whole[1].ledger

    def test_the_policy_of_each_round_comes_back(self, whole):
        policy, found, _ = whole
        last = {key: value.clone() for key, value in policy.state_dict().items()}
        found.restore(policy, 18)
        assert not torch.equal(policy.state_dict()["first.weight"], last["first.weight"])
        found.restore(policy, 30)
        assert torch.equal(policy.state_dict()["first.weight"], last["first.weight"])

    def test_another_policy_may_collect_what_this_one_is_tuned_with(self, whole, tmp_path):
        rest = torch.tensor([0.5, -0.2, 0.0, 0.3])
        policy, found, target = adapted(tmp_path, explorer=AutoregressivePolicy(13, rest, keep=0.5))
        assert found.ledger.used == target.steps == 30
        done = torch.cat([torch.from_numpy(each.action[: each.samples]) for each in found.episodes])
        torch.testing.assert_close(done.mean(0), rest, rtol=0, atol=0.06)
        assert [len(each.policy) for each in found.rounds] == [4, 4]
        assert not torch.equal(policy.state_dict()["first.weight"], whole[0].state_dict()["first.weight"])

    def test_a_folder_of_a_residual_without_history_is_refused_with_one(self, whole, tmp_path):
        with pytest.raises(RunError, match=r"holds a run with other settings \(tuning\)"):
            adapted(whole[1].folder, with_history=True)
        copied = shutil.copytree(whole[1].folder, tmp_path / "copied")
        (copied / "adaptation.json").unlink()
        with pytest.raises(CheckpointError, match=r"round-01/residual\.safetensors: made for another architecture"):
            adapted(copied, with_history=True)


class TestPretrain:
    def test_it_writes_weights_that_it_reads_the_next_time(self, tmp_path):
        setup, path = small(), tmp_path / "quadrotor.safetensors"
        trained = setup.pretrain(path, 0)
        assert [each.name for each in tmp_path.iterdir()] == [path.name]
        torch.manual_seed(0)
        assert not torch.equal(FollowPolicy(PERIOD).first.weight, trained.first.weight)
        read = setup.pretrain(path, 0)
        for key, value in trained.state_dict().items():
            assert torch.equal(value, read.state_dict()[key]), key

    def test_a_policy_of_another_source_or_seed_is_not_taken_for_this_one(self, tmp_path):
        setup, path = small(), tmp_path / "quadrotor.safetensors"
        setup.pretrain(path, 0)
        with pytest.raises(CheckpointError, match="trained with other values of seed: remove it"):
            setup.pretrain(path, 1)
        heavier = replace(setup, source=World(Quadrotor(mass=2.0), period=setup.source.period))
        with pytest.raises(CheckpointError, match="trained with other values of source: remove it"):
            heavier.pretrain(path, 0)

    def test_what_an_interrupted_training_left_goes_on_with_its_own_seed_alone(self, tmp_path, monkeypatch):
        monkeypatch.setattr("visadapt.learning.training_state.CHECKPOINT_ITERATIONS", 1)
        setup, path = small(), tmp_path / "quadrotor.safetensors"
        whole = setup.pretrain(tmp_path / "whole.safetensors", 0)

        def interrupt(stage, done, total, loss):
            if done == 2:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            setup.pretrain(path, 0, interrupt)
        with pytest.raises(CheckpointError, match=r"partial\.safetensors: was trained with other values of seed"):
            setup.pretrain(path, 1)
        resumed = setup.pretrain(path, 0)
        assert all(torch.equal(value, resumed.state_dict()[key]) for key, value in whole.state_dict().items())
        assert {each.name for each in tmp_path.iterdir()} == {path.name, "whole.safetensors"}

    def test_what_a_run_left_that_was_killed_when_it_had_written_its_policy_is_removed(self, tmp_path):
        setup, path = small(), tmp_path / "quadrotor.safetensors"
        setup.pretrain(path, 0)
        for left in (".partial.safetensors", ".begun.safetensors"):
            path.with_suffix(left).touch()
        setup.pretrain(path, 0)
        assert list(tmp_path.iterdir()) == [path]

    def test_another_vehicles_weights_are_refused(self, tmp_path):
        path = tmp_path / "policy.safetensors"
        small().pretrain(path, 0)
        with pytest.raises(CheckpointError, match="holds a FollowPolicy, a ReachPolicy is needed"):
            fixed_wing().pretrain(path, 0)
