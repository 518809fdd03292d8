import math

import numpy as np
import pytest
import torch

from renderers import DrawnCartPole
from visadapt.effects import AngleOffset, Dropout
from visadapt.history import HORIZON
from visadapt.policies import Policy, StatePolicy
from visadapt.systems import CartPole
from visadapt.targets import (
    Observation,
    Start,
    SyntheticTarget,
    Target,
    TargetError,
    constant_force,
    no_effects,
    sine_force,
)
from visadapt.targets.rollout import run, see_frames
from visadapt.world import World


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


class Scripted(Policy):
    """A policy that a test writes out: `command` gives (B, 1)."""

    def __init__(self):
        super().__init__(4, 1)

    def command(self, history):
        """Does nothing, whatever it sees."""
        return torch.zeros(len(history.observations), 1)

    def forward(self, history):
        return self.command(history)[:, None].expand(-1, HORIZON, 1)


class Feedback(Scripted):
    """A linear state feedback that keeps the pole up; `broken_at` is the step at which it says NaN."""

    def __init__(self, gains=(0.05, 0.1, 1.5, 0.3), broken_at=None):
        super().__init__()
        self.gains = torch.tensor(gains)
        self.broken_at = broken_at
        self.steps = 0

    def command(self, history):
        command = (history.observations[:, -1] * self.gains).sum(1, keepdim=True).clamp(-1, 1)
        if self.steps == self.broken_at:
            command = command * math.nan
        self.steps += 1
        return command


class TestSynthetic:
    def test_the_same_seed_gives_the_same_episodes_and_another_others(self):
        target = SyntheticTarget(sine_force, DrawnCartPole())
        one, same, other = (run(target, Scripted(), 3, 8, seeded(s), see=see_frames) for s in (0, 0, 1))
        for a, b, c in zip(one, same, other, strict=True):
            np.testing.assert_array_equal(a.episode.state, b.episode.state)
            np.testing.assert_array_equal(a.episode.frame, b.episode.frame)
            np.testing.assert_array_equal(a.force, b.force)
            assert not np.array_equal(a.episode.state, c.episode.state)

    def test_without_effects_it_agrees_with_the_source_though_it_integrates_otherwise(self):
        target, source = SyntheticTarget(no_effects), World(CartPole(), integrator="rk4", substeps=4)
        generator = seeded()
        observation = target.reset(16, generator)
        at = source.start(observation.state)
        for _ in range(10):
            action = 1.0 * torch.rand(16, 1, generator=generator) - 0.5
            observation, at = target.step(action), source.step(at, action)
        assert at.state.abs().max() > 0.5
        torch.testing.assert_close(observation.state, at.state, rtol=2e-3, atol=2e-4)

    def test_a_constant_force_is_the_source_under_a_larger_command(self):
        target, source = SyntheticTarget(constant_force(3.0)), World(CartPole(), substeps=4)
        observation = target.reset(8, seeded())
        at = source.start(observation.state)
        for _ in range(8):
            observation = target.step(torch.zeros(8, 1))
            at = source.step(at, torch.full((8, 1), 3.0 / 30.0))
            torch.testing.assert_close(observation.force, torch.full((8,), 3.0))
        torch.testing.assert_close(observation.state, at.state, rtol=2e-3, atol=2e-4)

    def test_the_sine_force_is_that_of_the_paper_with_a_phase_for_each_episode(self):
        target = SyntheticTarget(sine_force)
        observations = [target.reset(64, seeded())]
        observations += [target.step(torch.zeros(64, 1)) for _ in range(40)]
        force = torch.stack([seen.force for seen in observations]).double()
        time = torch.arange(41, dtype=torch.float64)[:, None] * target.period
        # Whatever its phase, 2 (sin(t + phase) + 1) is 2 + a cos t + b sin t with a^2 + b^2 = 4.
        a = force[0] - 2
        b = (force[20] - 2 - a * math.cos(1.0)) / math.sin(1.0)
        torch.testing.assert_close(force, 2 + a * time.cos() + b * time.sin(), rtol=0, atol=1e-4)
        torch.testing.assert_close(
            a.square() + b.square(), torch.full((64,), 4.0, dtype=torch.float64), rtol=1e-4, atol=0
        )
        assert force.min() < 0.1
        assert force.max() > 3.9
        for part in (a, b):
            assert part.min() < -1.8
            assert part.max() > 1.8

    def test_starts_are_drawn_from_the_stated_distribution(self):
        start = Start(x=0.5, x_dot=0.2, theta=0.05, theta_dot=0.4)
        state = SyntheticTarget(start=start).reset(2000, seeded()).state
        width = torch.tensor([0.5, 0.2, 0.05, 0.4])
        assert bool((state.abs() <= width).all())
        torch.testing.assert_close(state.std(0), width / math.sqrt(3), rtol=0.1, atol=0)
        assert bool((state.mean(0).abs() < 0.05 * width).all())

    def test_sensors_show_in_what_is_measured_and_not_in_when_an_episode_ends(self):
        def sensors(batch, generator):
            return (AngleOffset(offset=0.4), Dropout(rate=0.5))

        target, plain = SyntheticTarget(sensors), SyntheticTarget()
        seen, true = target.reset(50, seeded()), plain.reset(50, seeded())
        offset = torch.tensor([0.0, 0.0, 0.4, 0.0])
        torch.testing.assert_close(seen.state, true.state + offset)
        assert bool(seen.alive.all())
        before = seen.state
        seen, true = target.step(torch.zeros(50, 1)), plain.step(torch.zeros(50, 1))
        lost = (seen.state == before).all(1)
        assert 10 < int(lost.sum()) < 40
        torch.testing.assert_close(seen.state[~lost], true.state[~lost] + offset)

    def test_frames_show_the_state(self):
        camera = DrawnCartPole()
        target = SyntheticTarget(camera=camera)
        target.reset(2, seeded())
        seen = target.step(torch.full((2, 1), 0.4))
        expected = camera(seen.state[:, 0].double().numpy(), seen.state[:, 2].double().numpy())
        np.testing.assert_array_equal(seen.frame.numpy(), expected)

    def test_a_pole_beyond_the_limit_and_a_cart_out_of_sight_end_an_episode(self):
        still = Start(0.0, 0.0, 0.0, 0.0)
        fallen = SyntheticTarget(constant_force(-20.0), start=still)
        seen = fallen.reset(1, seeded())
        while bool(seen.alive):
            seen = fallen.step(torch.zeros(1, 1))
        assert 0.3 < float(seen.state[0, 2]) < 0.6
        away = SyntheticTarget(camera=DrawnCartPole(), start=Start(0.0, 80.0, 0.0, 0.0))
        away.reset(20, seeded())
        seen = away.step(torch.zeros(20, 1))
        assert torch.equal(seen.alive, (seen.state[:, 0].abs() <= 1.5) & (seen.state[:, 2].abs() <= 0.3))
        assert bool(seen.alive.any())
        assert not bool(seen.alive.all())

    def test_a_step_before_a_reset_is_an_error(self):
        with pytest.raises(TargetError, match="cart-pole: step before reset"):
            SyntheticTarget().step(torch.zeros(1, 1))


class TestRun:
    def test_a_policy_that_balances_survives_and_its_rows_are_those_of_the_target(self):
        target, policy = SyntheticTarget(), Feedback()
        runs = run(target, policy, 4, 60, seeded())
        assert all(r.survived for r in runs)
        assert all(r.episode.samples == 60 for r in runs)
        episode = runs[2].episode
        np.testing.assert_allclose(episode.time, np.arange(61) * 0.05)
        expected = (episode.state[:-1] * policy.gains.numpy()).sum(1, keepdims=True).clip(-1, 1)
        np.testing.assert_allclose(episode.action[:-1], expected, atol=1e-6)
        assert episode.action[-1] == 0
        source = World(CartPole(), substeps=4)
        at = source.start(torch.from_numpy(episode.state[:-1]))
        after = source.step(at, torch.from_numpy(episode.action[:-1])).state
        np.testing.assert_allclose(after, episode.state[1:], atol=1e-4)

    def test_exploration_is_noise_on_the_commands_that_are_recorded_and_executed(self):
        quiet, noisy = (
            run(SyntheticTarget(), Feedback(), 20, 50, seeded(4), exploration)[0].episode for exploration in (0.0, 0.05)
        )
        first = noisy.action[0] - quiet.action[0]
        assert first != 0
        meant = noisy.state[:-1] @ np.array([0.05, 0.1, 1.5, 0.3])
        spread = np.std(noisy.action[:-1, 0] - meant)
        assert 0.035 < spread < 0.065
        assert not np.allclose(noisy.state[1], quiet.state[1])

    def test_an_episode_is_cut_where_it_ends_and_others_go_on(self):
        weak = Feedback(gains=(0.0, 0.0, 0.1, 0.0))
        runs = run(SyntheticTarget(start=Start(0, 0, 0.3, 0)), weak, 12, 60, seeded())
        lengths = [r.episode.samples for r in runs]
        assert len(set(lengths)) > 3
        for r in runs:
            assert not r.survived
            angle = np.abs(r.episode.state[:, 2])
            assert (angle[:-1] <= 0.3).all()
            assert angle[-1] > 0.3
            assert len(r.force) == len(r.episode.time)
            assert r.episode.action[:-1].all()
            assert not r.episode.action[-1], "the last action was not executed"

    @pytest.mark.parametrize("step", [0, 3])
    def test_a_policy_that_says_nan_is_an_error_that_names_the_step(self, step):
        with pytest.raises(TargetError, match=rf"synthetic cart-pole: the state after step {step + 1} is not finite"):
            run(SyntheticTarget(), Feedback(broken_at=step), 2, 10, seeded())

    def test_a_target_that_says_nan_is_an_error(self):
        class Broken(SyntheticTarget):
            def step(self, action):
                seen = super().step(action)
                seen.state[1, 2] = math.nan
                return seen

        with pytest.raises(TargetError, match=r"state after step 1 is not finite \(episode 1\)"):
            run(Broken(), Scripted(), 3, 10, seeded())

    def test_a_target_with_other_states_than_the_policy_s(self):
        with pytest.raises(ValueError, match="the policy was trained on 13 numbers of state, got 4"):
            run(SyntheticTarget(), StatePolicy(13), 1, 3, seeded())

    def test_frames_asked_of_a_target_without_a_camera(self):
        with pytest.raises(TargetError, match="has none: give it a camera"):
            run(SyntheticTarget(), Scripted(), 1, 3, seeded(), see=see_frames)

    def test_a_policy_of_frames_is_shown_frames_between_0_and_1_and_nothing_else(self):
        shown = []

        class Watch(Scripted):
            def command(self, history):
                shown.append(history)
                return super().command(history)

        runs = run(SyntheticTarget(camera=DrawnCartPole()), Watch(), 2, 4, seeded(), see=see_frames)
        latest = np.stack([history.observations[0, -1].numpy() for history in shown])
        np.testing.assert_allclose(latest, runs[0].episode.frame[:4] / 255, atol=1e-6)


class Rig(Target):
    """A machine of the user's, which writes every instant into the same arrays."""

    name, period, n_action = "rig", 0.05, 1

    def __init__(self, shown=None):
        self.shown = shown or {}
        self.state = torch.zeros(1, 4)

    def reset(self, batch, generator):
        return self.step(torch.zeros(batch, 1))

    def step(self, action):
        self.state += 0.001
        return Observation(**{"state": self.state, "alive": torch.ones(1, dtype=torch.bool), **self.shown})


def test_a_machine_may_write_every_instant_into_the_same_arrays():
    (found,) = run(Rig(), Feedback(), 1, 4, seeded())
    assert found.force is None  # which it does not tell
    np.testing.assert_allclose(found.episode.state[:, 0], 0.001 * np.arange(1, 6), rtol=1e-5)


@pytest.mark.parametrize(
    ("shown", "said"),
    [
        ({"state": torch.zeros(4)}, r"rig: state is \(4,\) and torch.float32; a torch tensor that is \(1, n_state\)"),
        ({"state": np.zeros((1, 4))}, r"rig: state is ndarray; a torch tensor that is \(1, n_state\) is right"),
        ({"alive": True}, r"rig: alive is bool; a torch tensor that is \(1,\) and bool is right"),
        ({"force": torch.zeros(3)}, r"rig: force is \(3,\) and torch.float32; a torch tensor that is \(1, ...\) is"),
        ({"frame": torch.zeros(3, 100, 120)}, r"rig: frame is \(3, 100, 120\) and torch.float32"),
        # Divided by 255 again, frames in [0, 1] would be black; colour has an axis too many.
        ({"frame": torch.rand(1, 100, 120)}, r"float32; a torch tensor that is \(1, H, W\) and uint8, grey, is right"),
        ({"frame": torch.zeros(1, 100, 120, 3).byte()}, r"\(1, 100, 120, 3\) and torch.uint8; .* grey, is right"),
    ],
)
def test_what_is_no_observation_of_the_batch_is_an_error(shown, said):
    with pytest.raises(TargetError, match=said):
        run(Rig(shown), Feedback(), 1, 4, seeded())
