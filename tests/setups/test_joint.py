import dataclasses

import pytest
import torch

from tests.coarse import coarse_targets
from tests.scenes import state_residual_network
from visadapt.effects import AngleOffset, Residual
from visadapt.learning.collection import Kept
from visadapt.learning.grounding import GroundSettings
from visadapt.learning.joint import adapt
from visadapt.learning.ledger import BudgetExceeded, Ledger
from visadapt.learning.perception import PerceptionSettings
from visadapt.learning.rounds import JointLearning
from visadapt.learning.setup_settings import SetupSettings
from visadapt.learning.tuning import TuneSettings
from visadapt.policies import StatePolicy
from visadapt.policies.networks import StateResidualNetwork
from visadapt.recordings import read_recording
from visadapt.setups.base import Setup
from visadapt.setups.policy_file import residual_for
from visadapt.storage.checkpoints import CheckpointError, load_tree, save_tree
from visadapt.systems import CartPole
from visadapt.targets import SyntheticTarget, TargetError
from visadapt.targets.synthetic import constant_force
from visadapt.tasks.balance import PAPER_CARTPOLE, Balance
from visadapt.world import World

TUNE = TuneSettings(
    Balance(PAPER_CARTPOLE), iterations=12, batch=4, learning_rate=3e-3, observation_noise=0.0, recorded=0.5
)
GROUND = GroundSettings(steps=60, every=20)
SMALL = SetupSettings(TUNE, TUNE, GROUND, longest_episode=12)
QUICK = dataclasses.replace(SMALL, tuning=dataclasses.replace(TUNE, iterations=3))


class Counted(SyntheticTarget):
    """A cart-pole under a constant force that counts the steps it takes, and stops the run, or breaks, at one."""

    def __init__(self, stops_at=None, breaks_at=None, **more):
        super().__init__(constant_force(1.0), **more)
        self.steps = 0
        self.stops_at = stops_at
        self.breaks_at = breaks_at

    def reset(self, batch, generator):
        return self.broken(super().reset(batch, generator))

    def step(self, action):
        self.steps += len(action)
        if self.steps == self.stops_at:
            raise KeyboardInterrupt
        return self.broken(super().step(action))

    def broken(self, seen):
        if self.breaks_at is not None and self.steps >= self.breaks_at:
            return dataclasses.replace(seen, state=seen.state * float("nan"))
        return seen


def run(
    folder, settings, target=None, report=None, with_history=False, budget=50, round_samples=30, seed=1, label=None
):
    torch.manual_seed(0)
    policy = StatePolicy(4, with_history=with_history)
    residual = Residual(state_residual_network(with_history), torch.ones(4))
    source = World(CartPole(), integrator="euler")
    about = (policy, residual, source, target or Counted(), settings, Ledger(budget))
    return policy, adapt(JointLearning(*about, label=label, report=report), folder, round_samples, seed)


class TestLedger:
    def test_it_counts_what_is_entered_and_refuses_what_would_overdraw_it(self):
        ledger = Ledger(10)
        ledger.count("data", 7)
        with pytest.raises(BudgetExceeded, match="choosing: 4 target steps asked for, 3 of 10 are left"):
            ledger.count("choosing", 4)
        assert (ledger.used, ledger.left) == (7, 3)
        ledger.count("choosing", 3)
        assert ledger.entries == [("data", 7), ("choosing", 3)]
        assert ledger.left == 0

    @pytest.mark.parametrize(("budget", "size", "rounds"), [(50, 30, [30, 20]), (20, 20, [20]), (7, 3, [3, 3, 1])])
    def test_it_counts_exactly_the_steps_that_the_target_took(self, tmp_path, budget, size, rounds):
        target = Counted()
        _, adapted = run(tmp_path, QUICK, target, budget=budget, round_samples=size)
        assert adapted.ledger.used == target.steps == budget
        assert sum(episode.samples for episode in adapted.episodes) == budget
        for number, samples in enumerate(rounds, 1):
            name = f"round {number}/{len(rounds)}: data"
            assert sum(steps for purpose, steps in adapted.ledger.entries if purpose == name) == samples
        assert [made.samples for made in adapted.rounds] == [sum(rounds[: k + 1]) for k in range(len(rounds))]

    def test_episodes_that_fall_early_are_counted_in_full_and_followed_by_others(self, tmp_path):
        target = Counted(angle_limit=0.12)
        _, adapted = run(tmp_path, QUICK, target)
        lengths = [episode.samples for episode in adapted.episodes]
        assert min(lengths) < QUICK.longest_episode
        assert sum(abs(episode.state[-1, 2]) > 0.12 for episode in adapted.episodes) >= 2
        assert adapted.ledger.used == target.steps == sum(lengths) == 50

    def test_a_folder_that_holds_more_samples_than_the_budget_is_refused(self, tmp_path):
        run(tmp_path, QUICK)
        with pytest.raises(BudgetExceeded, match="of 25 are left"):
            run(tmp_path, QUICK, budget=25, round_samples=25)


class TestSettings:
    def test_a_budget_smaller_than_a_round_is_one_clear_line(self, tmp_path):
        with pytest.raises(ValueError, match=r"N = 20 .* B = 30 ") as caught:
            run(tmp_path, QUICK, budget=20, round_samples=30)
        assert "\n" not in str(caught.value)

    @pytest.mark.parametrize("size", [0, -5])
    def test_a_round_needs_a_sample(self, tmp_path, size):
        with pytest.raises(ValueError, match=f"B = {size}"):
            run(tmp_path, QUICK, budget=20, round_samples=size)


@pytest.fixture(scope="module", autouse=True)
def checkpoints():
    """States of a training are kept after 6 iterations, not after 100; targets take coarser steps."""
    with coarse_targets(0.05), pytest.MonkeyPatch.context() as patch:
        patch.setattr("visadapt.learning.training_state.CHECKPOINT_ITERATIONS", 6)
        yield


@pytest.fixture(scope="module")
def whole(checkpoints, tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    policy, adapted = run(folder, SMALL)
    return policy.state_dict(), adapted, folder


def stopping(stage, after):
    def report(name, done, total, loss):
        if name == stage and done >= after:
            raise KeyboardInterrupt

    return report


class TestInterruption:
    @pytest.mark.parametrize(
        ("stage", "after"),
        [
            ("data", 45),
            ("round 1/2: ground", 40),
            ("round 1/2: tune", 11),
            ("round 2/2: ground", 0),
            ("round 2/2: tune", 5),
        ],
    )
    def test_started_again_it_ends_with_the_same_numbers(self, whole, tmp_path, stage, after):
        weights, adapted, _ = whole
        target = Counted(stops_at=after if stage == "data" else None)
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path, SMALL, target, stopping(stage, after))
        policy, again = run(tmp_path, SMALL)
        for key, value in weights.items():
            assert torch.equal(value, policy.state_dict()[key]), key
        assert again.ledger == adapted.ledger
        assert again.rounds == adapted.rounds
        for one, other in zip(adapted.episodes, again.episodes, strict=True):
            assert (one.state == other.state).all()
            assert (one.action == other.action).all()

    def test_a_finished_run_is_read_and_neither_the_target_nor_training_is_touched(self, whole):
        weights, adapted, folder = whole
        target, calls = Counted(), []
        policy, again = run(folder, SMALL, target, lambda *report: calls.append(report))
        assert (target.steps, calls) == (0, [])
        assert again.rounds == adapted.rounds
        assert again.ledger == adapted.ledger
        for key, value in weights.items():
            assert torch.equal(value, policy.state_dict()[key]), key

    def test_the_true_states_behind_a_biased_sensor_are_kept_and_read_again(self, tmp_path):
        def adapted(folder, after=None):
            torch.manual_seed(0)
            policy, residual = StatePolicy(4), Residual(StateResidualNetwork(4), torch.ones(4))
            source = World(CartPole(), [AngleOffset(offset=0.0)])
            report = None if after is None else stopping("round 2/2: tune", after)
            adapt(JointLearning(policy, residual, source, Counted(), QUICK, Ledger(50), report=report), folder, 30, 1)
            return policy

        whole = adapted(tmp_path / "whole")
        for after in (0, 2):
            with pytest.raises(KeyboardInterrupt):
                adapted(tmp_path / "again", after)
        again = adapted(tmp_path / "again")
        for key, value in whole.state_dict().items():
            assert torch.equal(value, again.state_dict()[key]), key
        first = tmp_path / "whole" / "round-01"
        kept = load_tree(first / "residual.safetensors")["windows"]["states"]
        read = [torch.as_tensor(each.state) for each in read_recording(first / "recording.h5")]
        assert kept.shape == torch.cat(read).shape
        assert not torch.equal(kept, torch.cat(read))

    def test_no_leftovers_lie_in_the_folder_of_a_finished_run(self, whole):
        found = sorted(str(path.relative_to(whole[2])) for path in whole[2].rglob("*") if path.is_file())
        files = ("policy.safetensors", "recording.h5", "residual.safetensors")
        assert found == [f"round-{number:02d}/{name}" for number in (1, 2) for name in files]

    def test_a_folder_of_other_networks_is_refused_by_name(self, tmp_path):
        run(tmp_path, QUICK)
        with pytest.raises(CheckpointError, match=r"round-01/residual\.safetensors: made for another architecture"):
            run(tmp_path, QUICK, with_history=True)


class TestLearning:
    def test_the_residual_is_grounded_on_all_rounds_and_the_policy_is_tuned(self, whole):
        weights, adapted, _ = whole
        torch.manual_seed(0)
        assert not torch.equal(weights["first.weight"], StatePolicy(4).first.weight)
        assert [len(made.policy) for made in adapted.rounds] == [TUNE.iterations] * 2
        # In units of the gap: 1 is what no residual gets.
        assert adapted.rounds[0].grounding[0][2] == pytest.approx(1.0, abs=0.5)
        assert min(held for _, _, held in adapted.rounds[1].grounding) < 0.5

    @pytest.mark.parametrize("feedforward", [True, False])
    def test_the_policy_begins_by_opposing_what_the_residual_expects_if_it_is_to(self, tmp_path, feedforward):
        settings = dataclasses.replace(QUICK, tuning=dataclasses.replace(QUICK.tuning, learning_rate=0.0))
        policy, _ = run(tmp_path, dataclasses.replace(settings, feedforward=feedforward))
        assert bool(policy.feedforward.weight.any()) == feedforward

    @pytest.mark.parametrize("tunes_on", [True, False])
    def test_a_round_tunes_from_the_first_weights_or_on_from_the_last(self, tmp_path, tunes_on):
        settings = dataclasses.replace(QUICK, tunes_on=tunes_on, feedforward=False)
        run(tmp_path, settings, budget=60, round_samples=15)
        torch.manual_seed(0)
        first = StatePolicy(4).state_dict()["rest.0.weight"]
        files = [tmp_path / f"round-0{number}" / "policy.safetensors" for number in (1, 4)]
        once, last = [(load_tree(file)["weights"]["rest.0.weight"] - first).norm() for file in files]
        assert once > 0
        assert (last > 1.3 * once) == tunes_on

    @pytest.mark.parametrize(("learning_rate", "better"), [(1e-2, True), (3.0, False)])
    def test_a_round_goes_on_and_is_shorter_where_the_last_policy_is_better_and_drops_one_that_is_far_worse(
        self, tmp_path, learning_rate, better
    ):
        tuning = dataclasses.replace(TUNE, iterations=30, learning_rate=learning_rate)
        settings = dataclasses.replace(SMALL, tuning=tuning, later=2)
        _, adapted = run(tmp_path, settings, budget=40, round_samples=20)
        assert [len(each.policy) for each in adapted.rounds] == ([30, 2] if better else [0, 0])

    def test_each_round_and_each_seed_meets_the_target_in_other_states(self, whole, tmp_path):
        _, adapted, _ = whole
        _, other = run(tmp_path, QUICK, seed=2)
        starts = [tuple(episode.state[0]) for episode in [*adapted.episodes, *other.episodes]]
        assert len(set(starts)) == len(starts)

    def test_a_label_changes_what_is_learnt_from_and_not_what_is_recorded(self, tmp_path):
        def label(episodes):
            return [dataclasses.replace(episode, state=episode.state + 1.0) for episode in episodes]

        _, adapted = run(tmp_path, QUICK, label=label)
        recorded = [
            episode for number in (1, 2) for episode in read_recording(tmp_path / f"round-0{number}/recording.h5")
        ]
        for episode, learnt_from in zip(recorded, adapted.episodes, strict=True):
            assert abs(episode.state[0]).max() < 0.3
            assert (learnt_from.state == episode.state + 1.0).all()


class TestTargets:
    @pytest.mark.parametrize("at", [1, 5])
    def test_one_that_returns_nan_is_named_in_one_line_and_only_what_it_showed_before_is_kept(self, tmp_path, at):
        with pytest.raises(TargetError, match=f"synthetic cart-pole: .* after step {at} is not finite") as caught:
            run(tmp_path, QUICK, Counted(breaks_at=at))
        assert "\n" not in str(caught.value)
        assert not list(tmp_path.rglob("recording.h5"))
        kept = Kept(tmp_path / "round-01" / "collected").load(torch.Generator())
        assert [episode.samples for episode in kept] == ([] if at == 1 else [at - 1])

    def test_one_that_returns_nan_in_a_later_round_leaves_the_rounds_before(self, tmp_path):
        with pytest.raises(TargetError, match="not finite"):
            run(tmp_path, QUICK, Counted(breaks_at=35))
        _, adapted = run(tmp_path, QUICK)
        assert adapted.ledger.used == 50

    def test_one_that_starts_with_nan(self, tmp_path):
        with pytest.raises(TargetError, match="synthetic cart-pole: the first state is not finite"):
            run(tmp_path, QUICK, Counted(breaks_at=0))

    def test_one_whose_episodes_are_over_before_they_begin(self, tmp_path):
        with pytest.raises(TargetError, match="over before its first step"):
            run(tmp_path, QUICK, Counted(angle_limit=0.0))


class TestPretraining:
    def setup(self, refinement):
        settings = dataclasses.replace(SMALL, refinement=refinement)
        return Setup(World(CartPole(), integrator="euler"), lambda: StatePolicy(4), residual_for, settings)

    def test_a_refined_policy_is_trained_on_from_the_rough_one_which_is_left_out_of_the_folder(self, tmp_path):
        fine = dataclasses.replace(TUNE, iterations=4, recorded=0.0)
        rough = self.setup(None).pretrain(tmp_path / "rough" / "policy.safetensors", 0).state_dict()
        path = tmp_path / "fine" / "policy.safetensors"
        refined = self.setup(fine).pretrain(path, 0).state_dict()
        moved = max(float((refined[key] - rough[key]).abs().max()) for key in rough)
        assert 0 < moved < 4.5 * fine.learning_rate
        assert list(path.parent.iterdir()) == [path]

    def test_interrupted_between_both_it_ends_with_the_same_weights(self, tmp_path):
        def interrupt(stage, done, total, loss):
            if total == 4 and done == 2:
                raise KeyboardInterrupt

        fine = dataclasses.replace(TUNE, iterations=4, recorded=0.0)
        whole = self.setup(fine).pretrain(tmp_path / "whole" / "policy.safetensors", 0).state_dict()
        path = tmp_path / "again" / "policy.safetensors"
        with pytest.raises(KeyboardInterrupt):
            self.setup(fine).pretrain(path, 0, interrupt)
        again = self.setup(fine).pretrain(path, 0).state_dict()
        for key, value in whole.items():
            assert torch.equal(value, again[key]), key

    @pytest.mark.parametrize("key", ["refinement", "perception"])
    def test_a_policy_that_was_refined_or_learnt_to_see_in_another_way_is_not_taken_for_this_one(self, tmp_path, key):
        fine = dataclasses.replace(TUNE, iterations=2, recorded=0.0)
        setup, path = self.setup(fine), tmp_path / "policy.safetensors"
        setup.pretrain(path, 0)
        other = {"refinement": dataclasses.replace(fine, learning_rate=1e-5), "perception": PerceptionSettings()}
        changed = dataclasses.replace(setup, settings=dataclasses.replace(setup.settings, **{key: other[key]}))
        with pytest.raises(CheckpointError, match=f"trained with other values of {key}: remove it"):
            changed.pretrain(path, 0)

    def test_a_policy_of_an_earlier_version_that_does_not_say_how_it_was_refined_is_taken_as_it_is(self, tmp_path):
        setup, path = self.setup(dataclasses.replace(TUNE, iterations=2, recorded=0.0)), tmp_path / "policy.safetensors"
        trained = setup.pretrain(path, 0)
        tree = load_tree(path)
        earlier = {key: value for key, value in tree["settings"].items() if key not in ("refinement", "perception")}
        earlier["task"]["cost_of"] = earlier["task"].pop("plan_cost")  # its name then
        save_tree(path, {**tree, "settings": earlier})
        read = setup.pretrain(path, 0)
        for key, value in trained.state_dict().items():
            assert torch.equal(value, read.state_dict()[key]), key

    def test_numbers_may_differ_by_rounding(self, tmp_path):
        setup, path = self.setup(None), tmp_path / "policy.safetensors"
        setup.pretrain(path, 0)
        tree = load_tree(path)
        rate = tree["settings"]["learning_rate"]
        save_tree(path, {**tree, "settings": {**tree["settings"], "learning_rate": rate * (1 + 1e-14)}})
        setup.pretrain(path, 0)
        save_tree(path, {**tree, "settings": {**tree["settings"], "learning_rate": rate * (1 + 1e-6)}})
        with pytest.raises(CheckpointError, match="trained with other values of learning_rate"):
            setup.pretrain(path, 0)
