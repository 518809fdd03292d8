import dataclasses
import gc

import numpy as np
import pytest
import torch

from visadapt.evaluation.scoring import score, score_runs
from visadapt.films import film
from visadapt.policies import Policy
from visadapt.recordings import Episode
from visadapt.setups.policy_file import load_policy
from visadapt.systems import FixedWing
from visadapt.targets import Observation, SyntheticTarget, Target, sine_force
from visadapt.targets.rollout import Run, run
from visadapt.weights import shipped


def an_episode(speeds, survived):
    """A run whose cart moves at these speeds."""
    rows = len(speeds)
    state = np.zeros((rows, 4))
    state[:, 0], state[:, 1], state[:, 2], state[:, 3] = 5.0, speeds, 6.0, 7.0
    return Run(Episode(np.arange(rows) * 0.05, np.zeros((rows, 1)), state), survived, np.zeros(rows))


class TestScore:
    def test_the_fallen_are_counted_and_never_averaged_in(self):
        calm, quick = an_episode([0.1, -0.3, 0.2], True), an_episode([0.4, 0.4, -0.4], True)
        fallen = an_episode([100.0, -100.0], False)
        found = score_runs([fallen, calm, quick, fallen, fallen])
        assert (found.episodes, found.survived) == (5, 2)
        assert found.mean_speed == pytest.approx(0.3)
        assert found.std_speed == pytest.approx(0.1)
        assert found.mean_length == pytest.approx((1 + 2 + 2 + 1 + 1) / 5)
        assert str(found) == "0.300 m/s, 2 of 5 episodes up"

    def test_where_all_fell_there_is_no_speed(self):
        found = score_runs([an_episode([1.0, 1.0], False)] * 2)
        assert (found.episodes, found.survived) == (2, 0)
        assert found.mean_speed is None
        assert found.std_speed is None
        assert str(found) == "no speed, 0 of 2 episodes up"


class Steady(Policy):
    """A linear controller: gains on angle, angular velocity and the cart's velocity; it has no weights."""

    def __init__(self, gains=(0.1, 1.5, 0.3)):
        super().__init__(4, 1)
        self.gains = gains

    def forward(self, history):
        _, x_dot, theta, theta_dot = history.observations[:, -1].unbind(1)
        command = self.gains[0] * x_dot + self.gains[1] * theta + self.gains[2] * theta_dot
        return command.clamp(-1, 1)[:, None, None].expand(-1, 10, 1)


class Blind(Policy):
    """Commands nothing."""

    def __init__(self):
        super().__init__(4, 1)

    def forward(self, history):
        return history.actions.new_zeros(len(history.actions), 10, 1)


class TestEvaluate:
    def test_the_same_seed_gives_the_same_result_and_another_seed_another(self):
        def made(seed):
            found = score(Steady(), SyntheticTarget(sine_force), 5, seed, 15)
            runs = run(SyntheticTarget(sine_force), Steady(), 5, 15, torch.Generator().manual_seed(seed))
            return dataclasses.astuple(found), [r.episode.state for r in runs]

        first, states = made(3)
        torch.rand(7)  # nothing depends on what was drawn elsewhere
        second, again = made(3)
        assert first == second
        for one, other in zip(states, again, strict=True):
            np.testing.assert_array_equal(one, other)
        assert made(4)[0] != first

    def test_what_holds_the_pole_survives_and_what_pushes_the_wrong_way_falls(self):
        runs = run(SyntheticTarget(), Steady(), 5, 100, torch.Generator().manual_seed(0))
        held = score(Steady(), SyntheticTarget(), 5, 0, 100)
        assert held.survived == 5
        assert held.mean_length == 100
        speeds = [np.abs(r.episode.state[:, 1]).mean() for r in runs]
        assert held.mean_speed == pytest.approx(np.mean(speeds))
        wrong = Steady((0.0, -1.5, -0.3))
        runs = run(SyntheticTarget(), wrong, 5, 100, torch.Generator().manual_seed(0))
        fallen = score_runs(runs)
        assert fallen.survived == 0
        assert fallen.mean_length < 30
        for r in runs:
            assert abs(r.episode.state[-1, 2]) > 0.3
            assert (np.abs(r.episode.state[:-1, 2]) <= 0.3).all()

    def test_a_survivor_that_stands_beside_a_fallen_one_is_not_cut_short(self):
        # Starts reach 0.1 rad: some episodes are over at once, or soon.
        target = SyntheticTarget(angle_limit=0.09)
        runs = run(target, Steady(), 12, 60, torch.Generator().manual_seed(1))
        found = score_runs(runs)
        assert 0 < found.survived < 12
        assert all((r.episode.samples == 60) == r.survived for r in runs)


@pytest.mark.parametrize("system", [FixedWing(), FixedWing], ids=["known", "of unknown parameters"])
def test_what_is_no_cart_and_no_flight_is_not_scored_as_one(system):
    class Motor(SyntheticTarget):
        def __init__(self):
            super().__init__()
            self.system = system

    with pytest.raises(ValueError, match="is a fixed_wing: use run"):
        score(load_policy(shipped("cartpole_states")), Motor(), episodes=1)
    with pytest.raises(ValueError, match="flights are scored by their task: derive the target from TaskTarget"):
        score(load_policy(shipped("fixed_wing")), SyntheticTarget(), episodes=1)


class Seen(Target):
    """A machine that shows frames; `kept` is how many of them the process holds at the 20th step."""

    name, period, n_action = "seen", 0.05, 1

    def __init__(self, columns=4):
        self.columns, self.steps = columns, 0

    def reset(self, batch, generator):
        alive = torch.ones(batch, dtype=torch.bool)
        return Observation(torch.zeros(batch, self.columns), alive, torch.ones(batch, 7, 9).byte())

    def step(self, action):
        self.steps += 1
        if self.steps == 20:
            self.kept = sum(isinstance(each, torch.Tensor) and each.shape[1:] == (7, 9) for each in gc.get_objects())
        return self.reset(len(action), None)


def test_frames_are_not_kept_for_a_score():
    target = Seen()
    assert score(Steady(), target, episodes=2, steps=20).survived == 2
    assert target.kept < 5


def test_a_policy_of_another_period_is_neither_scored_nor_filmed(tmp_path):
    policy, target = load_policy(shipped("cartpole_states")), SyntheticTarget(period=0.1)
    for shown in (lambda: score(policy, target, 1), lambda: film(policy, target, tmp_path / "film.mp4", seconds=0.5)):
        with pytest.raises(ValueError, match=r"cart-pole has 0.1 s between actions, the policy was trained for 0.05 s"):
            shown()


def test_a_target_without_states_has_no_score():
    with pytest.raises(ValueError, match="seen: shows no states of a cart-pole; a score is that of the cart's speed"):
        score(Blind(), Seen(columns=0), episodes=1, steps=2)


@pytest.mark.parametrize("size", [{"episodes": 0}, {"steps": 0}, {"steps": -5}])
def test_nothing_to_score_is_refused(size):
    with pytest.raises(ValueError, match="at least one of each is right"):
        score(load_policy(shipped("cartpole_states")), SyntheticTarget(), **size)
