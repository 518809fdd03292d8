import pytest
import torch

from tests.scenes import (
    CONTRAST,
    HEIGHT,
    WIDTH,
    background,
    image_residual_network,
    small_renderer,
    state_residual_network,
    stir,
)
from visadapt.effects import Residual
from visadapt.history import HORIZON, LENGTH, History
from visadapt.policies import AutoregressivePolicy, ImagePolicy, StatePolicy

KINDS = ["image", "state", "history"]


def made(kind, n_action=1, dtype=torch.float32):
    torch.manual_seed(0)
    if kind == "image":
        return ImagePolicy(background(small_renderer()), CONTRAST, n_action=n_action).to(dtype)
    return StatePolicy(4, n_action, with_history=kind == "history").to(dtype)


def residual(kind, dtype=torch.float32):
    if kind == "image":
        return Residual(image_residual_network(small_renderer()), torch.ones(4)).to(dtype)
    return Residual(state_residual_network(kind == "history"), torch.ones(4)).to(dtype)


def observations(kind, count, seed, batch=3, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    shape = (HEIGHT, WIDTH) if kind == "image" else (4,)
    return torch.rand(count, batch, *shape, generator=generator, dtype=dtype)


def actions(count, seed, batch=3, n_action=1, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    return 2 * torch.rand(count, batch, n_action, generator=generator, dtype=dtype) - 1


def lived(seen, done):
    """The history after seeing seen[0], doing done[0], seeing seen[1] and so on."""
    history = History.start(seen[0], done.shape[-1])
    for observation, action in zip(seen[1:], done, strict=True):
        history = history.acting(action).observing(observation)
    return history


def a_history(kind, seed=1, n_action=1, dtype=torch.float32):
    return lived(
        observations(kind, LENGTH + 1, seed, dtype=dtype), actions(LENGTH, seed, n_action=n_action, dtype=dtype)
    )


@pytest.mark.parametrize("kind", KINDS)
class TestPlans:
    @pytest.mark.parametrize("n_action", [1, 2])
    def test_ten_actions_at_once_the_first_of_which_is_executed(self, kind, n_action):
        policy, history = made(kind, n_action), a_history(kind, n_action=n_action)
        plan = policy(history)
        assert plan.shape == (3, 10, n_action)
        assert HORIZON == 10
        assert torch.equal(policy.act(history), plan[:, 0])

    def test_actions_are_within_bounds_whatever_the_weights(self, kind):
        plan = stir(made(kind), spread=10.0)(a_history(kind))
        assert plan.abs().max() <= 1
        assert plan.abs().max() > 0.99

    def test_double_precision_stays_double(self, kind):
        policy = made(kind, dtype=torch.float64)
        policy.residual = residual(kind, torch.float64)
        assert policy(a_history(kind, dtype=torch.float64)).dtype == torch.float64


@pytest.mark.parametrize("with_residual", [False, True])
@pytest.mark.parametrize("kind", KINDS)
class TestWhatIsSeen:
    def policy(self, kind, with_residual):
        policy = made(kind)
        if with_residual:
            policy.residual = residual(kind)
        return stir(policy)

    def test_two_pasts_that_differ_only_before_the_last_5_give_the_same_plan(self, kind, with_residual):
        seen, done = observations(kind, LENGTH + 4, 1), actions(LENGTH + 3, 1)
        others_seen, others_done = observations(kind, LENGTH + 4, 2), actions(LENGTH + 3, 2)
        others_seen[-LENGTH:], others_done[-LENGTH:] = seen[-LENGTH:], done[-LENGTH:]
        policy = self.policy(kind, with_residual)
        assert torch.equal(policy(lived(seen, done)), policy(lived(others_seen, others_done)))

    def test_each_of_the_last_5_observations_and_actions_changes_the_plan_of_a_policy_with_history(
        self, kind, with_residual
    ):
        policy, seen, done = self.policy(kind, with_residual), observations(kind, LENGTH + 1, 1), actions(LENGTH, 1)
        plan = policy(lived(seen, done))
        for back in range(1, LENGTH + 1):
            other_seen, other_done = seen.clone(), done.clone()
            other_seen[-back] = observations(kind, 1, 9)[0]
            other_done[-back] = actions(1, 9)[0]
            latest_state = kind == "state" and back == 1
            assert torch.equal(policy(lived(other_seen, done)), plan) != (kind != "state" or latest_state), back
            assert torch.equal(policy(lived(seen, other_done)), plan) != (kind != "state"), back


@pytest.mark.parametrize("kind", KINDS)
class TestResidualInput:
    def test_a_freshly_attached_residual_changes_no_action(self, kind):
        policy, history = made(kind), a_history(kind)
        plan = policy(history)
        policy.residual = stir(residual(kind))
        assert torch.equal(policy(history), plan)

    def test_the_correction_is_what_the_residual_expects_without_an_action(self, kind):
        policy, history = made(kind), a_history(kind)
        assert torch.equal(policy.correction(history), torch.zeros(3, 4))
        policy.residual = stir(residual(kind))
        expected = policy.residual.network(history.acting(torch.zeros(3, 1)))
        assert expected.abs().min() > 1e-4
        assert torch.equal(policy.correction(history), expected)

    def test_the_correction_reaches_the_plan_once_the_policy_has_weights_on_it(self, kind):
        policy, history = stir(made(kind)), a_history(kind)
        plan = policy(history)
        policy.residual = stir(residual(kind))
        assert (policy(history) - plan).abs().max() > 1e-3

    def test_gradients_reach_the_weights_on_the_correction_but_not_the_residual(self, kind):
        policy, history = made(kind), a_history(kind)
        policy.residual = stir(residual(kind))
        policy(history).square().sum().backward()
        assert all(weight.grad is None for weight in policy.residual.parameters())
        weights = (policy.hidden if kind == "image" else policy.first).weight.grad[:, -4:]
        assert weights.abs().max() > 0


def test_frames_of_another_size_are_refused():
    with pytest.raises(ValueError, match=r"frames of \(20, 24\) \(height, width\), got \(20, 23\)"):
        made("image")(History(torch.zeros(1, LENGTH, HEIGHT, WIDTH - 1), torch.zeros(1, LENGTH, 1)))


class TestWander:
    """Commands about 0.4 and -0.2 that keep 0.9 of what noise makes of them, as `rollout.run` adds it."""

    rest = torch.tensor([0.4, -0.2])

    def walked(self, steps, noise):
        policy, generator = AutoregressivePolicy(4, self.rest, keep=0.9), torch.Generator().manual_seed(0)
        history = History.start(torch.zeros(500, 4), 2)
        done = []
        for _ in range(steps):
            done.append(policy.act(history) + noise * torch.randn(500, 2, generator=generator))
            history = history.acting(done[-1]).observing(torch.zeros(500, 4))
        return torch.stack(done, 1)

    def test_without_noise_it_rests(self):
        torch.testing.assert_close(self.walked(4, 0.0), self.rest.expand(500, 4, 2))

    def test_what_noise_brings_lasts_and_is_forgotten(self):
        away = self.walked(60, 0.05) - self.rest
        assert away.mean((0, 1)).abs().max() < 0.01
        spread = 0.05 / (1 - 0.9**2) ** 0.5
        torch.testing.assert_close(away[:, -1].std(0), torch.full((2,), spread), rtol=0.1, atol=0)
        for later, kept in ((1, 0.9), (7, 0.9**7)):
            together = (away[:, 30] * away[:, 30 + later]).mean(0) / away[:, 30].square().mean(0)
            torch.testing.assert_close(together, torch.full((2,), kept), rtol=0, atol=0.12)

    def test_a_plan_goes_back_to_rest(self):
        history = History.start(torch.zeros(1, 4), 2).acting(self.rest[None] + 0.5)
        plan = AutoregressivePolicy(4, self.rest, keep=0.9)(history)
        torch.testing.assert_close(plan[0, :, 1] + 0.2, 0.5 * 0.9 ** torch.arange(1, HORIZON + 1))
