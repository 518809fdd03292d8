from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.scenes import image_residual_network, observing, small_renderer, state_residual_network
from visadapt.effects import ActuatorDelay, AngleOffset, ConstantForce, QuadraticDrag, Residual, ViscousFriction
from visadapt.history import LENGTH, History
from visadapt.learning.grounding import (
    GroundSettings,
    fit_named,
    gap,
    gap_with_residual,
    ground,
    rescale,
    split,
)
from visadapt.learning.transitions import Transitions
from visadapt.policies.networks import StateResidualNetwork
from visadapt.recordings import Episode
from visadapt.systems import CartPole
from visadapt.world import World

NEWTONS = 2.0


SAMPLES = 10  # of an episode


def recorded(seed, count=16, rows=SAMPLES + 1, effects=None, size=0.2):
    """Episodes under random actions of that size in a world with a constant force, or other effects, as states."""
    generator = torch.Generator().manual_seed(seed)
    world = World(CartPole(), effects or [ConstantForce(force=NEWTONS)]).requires_grad_(False)
    actions = size * torch.randn(rows, count, 1, generator=generator)
    at = world.start(0.1 * torch.randn(count, 4, generator=generator))
    states = [at.state]
    for action in actions[:-1]:
        at = world.step(at, action)
        states.append(at.state)
    state = torch.stack(states, 1).numpy()
    return [Episode(np.arange(rows) * 0.05, actions[:, b].numpy(), state[b]) for b in range(count)]


SOURCE = World(CartPole())


def fit(residual, source, transitions, settings, generator):
    """The first round's grounding."""
    rescale(residual, source, transitions)
    return ground(residual, source, transitions, settings, generator)


def gap_left(transitions, residual):
    world = World(CartPole(), [residual])
    index = torch.arange(len(transitions))
    with torch.no_grad():
        state = world.step(world.start(transitions.state), transitions.action, transitions.history(index)).state
    return transitions.next_state - state


class TestOnStates:
    @pytest.mark.parametrize(("with_history", "count"), [(False, 16), (True, 64)])
    def test_more_than_nine_tenths_of_the_one_step_gap_closes_on_episodes_not_seen(self, with_history, count):
        torch.manual_seed(0)
        residual = Residual(state_residual_network(with_history), torch.ones(4))
        transitions, unseen = Transitions.cut(recorded(1, count)), Transitions.cut(recorded(2))
        settings = GroundSettings(steps=500)
        losses = fit(residual, SOURCE, transitions, settings, torch.Generator().manual_seed(0))
        before, after = gap(SOURCE, unseen), gap_left(unseen, residual)
        # What reads a history sees a force in the periods behind it.
        shown = (torch.arange(len(unseen)) % SAMPLES >= LENGTH - 1) | torch.tensor(not with_history)
        closed = 1 - after[shown].square().mean(0).sqrt() / before[shown].square().mean(0).sqrt()
        assert (closed > 0.9).all(), closed
        assert losses[0].held_out == pytest.approx(1.0, abs=0.1)
        assert min(loss.held_out for loss in losses) < 0.1

    def test_the_gap_is_what_the_force_does_in_a_period(self):
        # At rest upright a cart of mass M with a uniform pole of mass m and half-length l is pushed by F to
        # a = F / (M + m / 4), and the pole answers with -3 a / (4 l). Euler's method adds both to the velocities.
        upright = np.zeros((2, 4))
        acceleration = NEWTONS / (1.0 + 0.1 / 4)
        upright[1] = [0.0, 0.05 * acceleration, 0.0, -0.05 * 1.5 * acceleration]
        transitions = Transitions.cut([Episode(np.array([0.0, 0.05]), np.zeros((2, 1)), upright)])
        source = World(CartPole(), integrator="euler")
        np.testing.assert_allclose(gap(source, transitions).numpy()[0], upright[1], atol=1e-6)
        pushed = World(CartPole(), [ConstantForce(force=NEWTONS)], integrator="euler").requires_grad_(False)
        np.testing.assert_allclose(gap(pushed, transitions).numpy(), 0.0, atol=1e-6)

    def test_what_is_left_over_is_the_error_of_a_world_with_the_residual(self):
        transitions = Transitions.cut(recorded(0))
        residual = Residual(state_residual_network(False), torch.ones(4))
        fit(residual, SOURCE, transitions, GroundSettings(steps=50), torch.Generator().manual_seed(0))
        left = gap_with_residual(residual, SOURCE, transitions)
        torch.testing.assert_close(left, gap_left(transitions, residual), rtol=1e-4, atol=1e-6)
        assert left.square().mean() < gap(SOURCE, transitions).square().mean()

    def test_the_scale_is_the_root_mean_square_of_the_gap(self):
        residual = Residual(StateResidualNetwork(4), torch.ones(4))
        transitions = Transitions.cut(recorded(1))
        rescale(residual, SOURCE, transitions)
        with torch.no_grad():
            stepped = SOURCE.step(SOURCE.start(transitions.state), transitions.action).state
        wanted = np.sqrt(np.mean((transitions.next_state - stepped).numpy() ** 2, 0))
        np.testing.assert_allclose(residual.scale.numpy(), wanted, rtol=1e-4, atol=1e-8)

    def test_a_gap_that_is_nought_but_rounding_is_not_heard_beside_the_others(self):
        """Under a hundredth of what a state changes by, the unit is that hundredth."""
        residual = Residual(StateResidualNetwork(4), torch.ones(4))
        transitions = Transitions.cut(recorded(1))
        right = World(CartPole(), [ConstantForce(force=NEWTONS)]).requires_grad_(False)
        rescale(residual, right, transitions, negligible=1e-2)
        change = np.sqrt(np.mean((transitions.next_state - transitions.state).numpy() ** 2, 0))
        np.testing.assert_allclose(residual.scale.numpy(), 1e-2 * change, rtol=1e-4)

    def test_a_source_that_is_right_leaves_numbers_finite_and_corrections_nought(self):
        residual = Residual(StateResidualNetwork(4), torch.ones(4))
        right = World(CartPole(), [ConstantForce(force=NEWTONS)]).requires_grad_(False)
        transitions = Transitions.cut(recorded(1))
        losses = fit(residual, right, transitions, GroundSettings(steps=25), torch.Generator().manual_seed(0))
        assert all(np.isfinite((loss.train, loss.held_out)).all() for loss in losses)
        with torch.no_grad():
            assert residual.delta(transitions.history(torch.arange(len(transitions)))).abs().max() < 1e-6

    def test_the_weights_kept_are_those_that_did_best_on_what_was_held_out(self):
        transitions, overshot = Transitions.cut(recorded(1)), []
        # Most of these are far too fast and jump about, so that the last weights are not the best.
        for rate in (0.03, 0.1, 0.3, 1.0, 3.0):
            torch.manual_seed(0)
            residual = Residual(StateResidualNetwork(4), torch.ones(4))
            settings = GroundSettings(steps=60, every=10, patience=30, learning_rate=rate)
            losses = fit(residual, SOURCE, transitions, settings, torch.Generator().manual_seed(0))
            _, held = split(len(transitions), settings.held_out, torch.Generator().manual_seed(0))
            error = gap_left(transitions, residual)[held] / residual.scale
            best = min(loss.held_out for loss in losses)
            assert float(error.square().mean()) == pytest.approx(best, rel=1e-3)
            overshot.append(losses[-1].held_out > 1.05 * best)
        assert any(overshot)

    def test_the_same_seed_gives_the_same_weights_and_fitted_again_it_goes_on_from_them(self):
        transitions = Transitions.cut(recorded(1))
        settings = GroundSettings(steps=100)
        found = []
        for _ in range(2):
            torch.manual_seed(0)
            residual = Residual(StateResidualNetwork(4), torch.ones(4))
            first = fit(residual, SOURCE, transitions, settings, torch.Generator().manual_seed(0))
            found.append((residual.state_dict(), first))
        for key, value in found[0][0].items():
            assert torch.equal(value, found[1][0][key]), key
        assert found[0][1] == found[1][1]
        second = fit(residual, SOURCE, transitions, settings, torch.Generator().manual_seed(0))
        assert second[0].held_out == pytest.approx(min(loss.held_out for loss in first), rel=1e-3)

    def test_small_commands_show_that_a_motor_is_late(self):
        """By a period: what the present command does in the source, the last one does."""
        torch.manual_seed(0)
        residual = Residual(state_residual_network(with_history=True), torch.ones(4))
        late = recorded(1, count=20, effects=[ActuatorDelay(delay=0.05)], size=0.05)
        fit(residual, SOURCE, Transitions.cut(late), GroundSettings(), torch.Generator().manual_seed(0))
        rest, command = torch.zeros(1, 4), torch.full((1, 1), 0.1)
        history = History.start(rest, 1)
        with torch.no_grad():
            expected = SOURCE.step(SOURCE.start(rest), command).state
            now = residual.delta(history.acting(command)) - residual.delta(history.acting(0 * command))
        np.testing.assert_allclose(now.numpy(), -expected.numpy(), rtol=0.15)


class TestOnFrames:
    @pytest.fixture
    def seen(self):
        """A residual network that sees frames, and transitions of a world with a force."""
        torch.manual_seed(0)
        renderer = small_renderer()
        observe = observing(renderer)

        def filmed(episode):
            with torch.no_grad():
                grey = 255 * observe(torch.tensor(episode.state)).clamp(0, 1)
            return replace(episode, frame=grey.round().to(torch.uint8).numpy())

        transitions = Transitions.cut([filmed(each) for each in recorded(1, count=4, rows=11)], frames=True)
        return Residual(image_residual_network(renderer), torch.ones(4)), transitions

    def test_the_head_is_fitted_and_what_sees_stays_as_it_is(self, seen):
        residual, transitions = seen
        before = {key: value.clone() for key, value in residual.state_dict().items()}
        losses = fit(residual, SOURCE, transitions, GroundSettings(), torch.Generator().manual_seed(0))
        for key, value in residual.state_dict().items():
            if key.startswith("network.encoder"):
                assert torch.equal(value, before[key]), key
        assert losses[1].held_out < 0.5 * losses[0].held_out

    def test_a_linear_head_solves_the_ridge_equations_on_all_samples(self, seen):
        residual, transitions = seen
        ridge = 3.0
        fit(residual, SOURCE, transitions, GroundSettings(ridges=(ridge,)), torch.Generator().manual_seed(0))
        head = residual.network.head
        with torch.no_grad():
            history = transitions.history(torch.arange(len(transitions))).acting(transitions.action)
            inputs = residual.network.embed(history).double()
        weight = head.weight.detach().double()
        left = gap(SOURCE, transitions).double() / residual.scale - inputs @ weight.T
        # The gradient of the squared errors and the penalty vanishes.
        penalty = ridge * residual.network.penalties(inputs)
        np.testing.assert_allclose((left.T @ inputs).numpy(), (penalty * weight).numpy(), atol=1e-3)

    def test_of_several_ridges_it_takes_that_which_predicts_held_out_stretches_best(self, seen):
        residual, transitions = seen
        ridges = (1e-4, 1.0, 1e4)
        every = torch.arange(len(transitions))
        with torch.no_grad():
            inputs = residual.network.embed(transitions.history(every).acting(transitions.action)).double().numpy()
        wanted = (gap(SOURCE, transitions).double() / residual.scale).numpy()
        penalties = residual.network.penalties(torch.from_numpy(inputs)).numpy()

        def error(ridge, held):
            rest = np.setdiff1d(np.arange(len(inputs)), held)
            normal = inputs[rest].T @ inputs[rest] + np.diag(ridge * penalties)
            weight = np.linalg.solve(normal, inputs[rest].T @ wanted[rest])
            return np.square(inputs[held] @ weight - wanted[held]).sum()

        assert len(transitions) == 40
        errors = [sum(error(ridge, np.arange(k, k + 10)) for k in range(0, 40, 10)) for ridge in ridges]
        heads = []
        for choice in (ridges, (ridges[int(np.argmin(errors))],)):
            fit(residual, SOURCE, transitions, GroundSettings(ridges=choice), torch.Generator().manual_seed(0))
            heads.append(residual.network.head.weight.detach().clone())
        assert 1.5 * min(errors) < max(errors)
        assert torch.equal(*heads)

    def test_what_it_says_of_held_out_samples_comes_from_the_others_alone(self, seen):
        residual, transitions = seen
        settings = GroundSettings()
        losses = fit(residual, SOURCE, transitions, settings, torch.Generator().manual_seed(0))
        _, held = split(len(transitions), settings.held_out, torch.Generator().manual_seed(0))
        assert [loss.step for loss in losses] == [0, 1]
        error = (gap_left(transitions, residual)[held] / residual.scale).square().mean()
        assert losses[1].held_out > float(error)


class TestSplit:
    def test_every_sample_is_on_one_side_and_stretches_of_ten_stay_together(self):
        train, held = split(103, 0.2, torch.Generator().manual_seed(0))
        assert sorted(train.tolist() + held.tolist()) == list(range(103))
        for stretch in range(11):
            rows = set(range(10 * stretch, min(103, 10 * stretch + 10)))
            assert rows <= set(train.tolist()) or rows <= set(held.tolist())
        assert 13 <= len(held) <= 20

    def test_it_depends_on_the_seed_alone(self):
        def drawn(seed):
            return [part.tolist() for part in split(200, 0.2, torch.Generator().manual_seed(seed))]

        assert drawn(0) == drawn(0)
        assert drawn(0) != drawn(1)

    @pytest.mark.parametrize("count", [1, 10])
    def test_too_few_to_hold_any_out_are_all_used_for_both(self, count):
        train, held = split(count, 0.2, torch.Generator().manual_seed(0))
        assert train.tolist() == held.tolist() == list(range(count))


class TestNamed:
    """Effects that the source has of its own are fitted before the residual."""

    def fitted(self, *effects):
        source = World(CartPole(), effects)
        fit_named(source, Transitions.cut(recorded(3)))
        return source

    def test_the_right_one_is_found_and_nothing_is_left(self):
        source = self.fitted(ConstantForce(force=0.0))
        assert source.effects[0].force.item() == pytest.approx(NEWTONS, abs=1e-3)
        transitions = Transitions.cut(recorded(4))
        assert gap(source, transitions).abs().max() < 1e-3 * gap(SOURCE, transitions).abs().max()

    def test_a_wrong_one_beside_it_stays_at_what_does_nothing(self):
        _, friction = self.fitted(ConstantForce(force=0.0), ViscousFriction(coefficient=1.0)).effects
        assert friction.coefficient.item() == pytest.approx(0.0, abs=1e-2)

    def test_what_would_leave_its_range_ends_at_its_border(self):
        world = World(CartPole(), [QuadraticDrag(coefficient=0.5)])
        transitions = Transitions.cut(recorded(3, effects=[QuadraticDrag(coefficient=-1.0)]))
        fit_named(world, transitions)
        assert world.values.tolist() == [QuadraticDrag.table[0].low]

    def test_the_true_states_behind_a_biased_sensor_are_learnt_from_and_the_readings_are_shown(self):
        true, bias = recorded(3), np.array([0.0, 0.0, 0.05, 0.0], np.float32)
        transitions = Transitions.cut([replace(episode, state=episode.state + bias) for episode in true])
        source = World(CartPole(), [ConstantForce(force=0.0), AngleOffset(offset=0.0)])
        found = fit_named(source, transitions)
        assert [each.item() for each in source.parameters()] == pytest.approx([NEWTONS, 0.05], abs=2e-3)
        assert gap(source, found).abs().max() < 1e-3
        wanted = Transitions.cut(true)
        torch.testing.assert_close(found.state, wanted.state, rtol=0, atol=1e-3)
        torch.testing.assert_close(found.next_state, wanted.next_state, rtol=0, atol=1e-3)
        assert torch.equal(found.observations, transitions.observations)

    def test_a_source_without_effects_is_left_as_it_is(self):
        assert not list(self.fitted().parameters())
