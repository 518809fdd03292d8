from dataclasses import replace

import pytest
import torch

from tests.scenes import (
    CONTRAST,
    background,
    image_residual_network,
    observing,
    small_renderer,
    stir,
)
from visadapt.effects import ActuatorDelay, ActuatorGain, ConstantForce, CoulombFriction, DynamicsEffect, Residual
from visadapt.evaluation import score
from visadapt.history import HORIZON, History
from visadapt.learning.feedforward import initialise_feedforward
from visadapt.learning.plans import ClosedLoop, imagine
from visadapt.learning.streams import Streams
from visadapt.learning.transitions import Transitions
from visadapt.learning.tuning import DivergedError, TuneSettings, tune
from visadapt.policies import ImagePolicy, StatePolicy
from visadapt.policies.networks import StateResidualNetwork
from visadapt.recordings import Episode
from visadapt.setups.cartpole import cartpole_states
from visadapt.systems import CartPole
from visadapt.targets import SyntheticTarget
from visadapt.tasks.balance import PAPER_CARTPOLE, Balance, Cost
from visadapt.weights import shipped
from visadapt.world import World

COST = Cost((5.0, 3.0, 10.0, 1.0))
ANYWHERE = (1e9, 4.0, 0.5, 10.0)


def identity(state):
    return state


def changed(function, at, direction, size=1e-6):
    """The derivative of a function along a direction by central differences."""
    with torch.no_grad():
        return float((function(at + size * direction) - function(at - size * direction)) / (2 * size))


class Imagined:
    """Four small cart-poles seen by a camera, with a residual that reacts to what it sees, in double precision."""

    def __init__(self):
        self.renderer = small_renderer(dtype=torch.float64)
        self.observe = observing(self.renderer)
        self.network = image_residual_network(self.renderer).double()
        stir(self.network, 1)
        residual = Residual(self.network, torch.full((4,), 0.1)).double()
        self.world = World(CartPole(), [residual, ConstantForce(force=1.0)]).requires_grad_(False)
        state = torch.randn(4, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        state = state * torch.tensor([0.4, 0.3, 0.1, 0.3])
        self.at = self.world.start(state)
        self.history = History.start(self.observe(state), 1)
        self.policy = ImagePolicy(background(self.renderer), CONTRAST).double()
        stir(self.policy, 2)

    def cost(self, plan, observe=None):
        states, _ = imagine(self.world, observe or self.observe, self.at, self.history, plan)
        return COST(states, plan, self.at.state).sum()

    def blind(self, state):
        """The same frames, cut off from what they show."""
        return self.observe(state).detach()


@pytest.fixture(scope="module")
def imagined():
    return Imagined()


def a_plan(seed=3):
    return 0.6 * (2 * torch.rand(4, 10, 1, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 1)


class TestGradient:
    @pytest.mark.parametrize("step", [0, 3, 9])
    def test_along_a_planned_action_through_physics_frames_and_residual(self, imagined, step):
        plan, direction = a_plan(), torch.zeros(4, 10, 1, dtype=torch.float64)
        direction[:, step, 0] = torch.tensor([1.0, -0.5, 0.7, 0.9])
        asked = plan.clone().requires_grad_()
        imagined.cost(asked).backward()
        found = float((asked.grad * direction).sum())
        assert abs(found) > 1e-3
        assert found == pytest.approx(changed(imagined.cost, plan, direction), rel=1e-6)

    def test_without_the_path_through_the_frames_it_would_be_wrong(self, imagined):
        plan, direction = a_plan(), torch.zeros(4, 10, 1, dtype=torch.float64)
        direction[:, 0, 0] = torch.tensor([1.0, -0.5, 0.7, 0.9])
        asked = plan.clone().requires_grad_()
        imagined.cost(asked, imagined.blind).backward()
        found = float((asked.grad * direction).sum())
        truth = changed(imagined.cost, plan, direction)
        assert abs(found - truth) > 0.05 * abs(truth)

    def test_along_the_policys_weights(self, imagined):
        policy = imagined.policy
        # What the residual sees with, and readouts, which are for learning to see: no plan depends on them.
        named = policy.named_parameters()
        weights = [weight for name, weight in named if not {"readout", "perception"} & set(name.split("."))]
        generator = torch.Generator().manual_seed(7)
        directions = [torch.randn(weight.shape, generator=generator).double() for weight in weights]
        policy.zero_grad()
        imagined.cost(policy(imagined.history)).backward()
        found = sum(float((weight.grad * way).sum()) for weight, way in zip(weights, directions, strict=True))
        kept = [weight.detach().clone() for weight in weights]

        def moved(size):
            with torch.no_grad():
                for weight, was, way in zip(weights, kept, directions, strict=True):
                    weight.copy_(was + size * way)
                return imagined.cost(policy(imagined.history))

        # Steps of 1e-7 reach beyond the nearest kink of a ReLU.
        wanted = changed(moved, torch.tensor(0.0, dtype=torch.float64), 1.0, 1e-8)
        moved(0.0)
        assert abs(found) > 1e-3
        assert found == pytest.approx(wanted, rel=1e-6)

    def test_the_first_step_is_the_one_that_the_world_takes(self, imagined):
        plan = a_plan()
        with torch.no_grad():
            states, first = imagine(imagined.world, imagined.observe, imagined.at, imagined.history, plan)
            wanted = imagined.world.step(imagined.at, plan[:, 0], imagined.history)
        assert states.shape == (4, 10, 4)
        assert torch.equal(first.state, wanted.state)
        assert torch.equal(states[:, 0], wanted.state)
        assert torch.equal(first.time, wanted.time)

    def test_the_residual_sees_what_an_observer_of_the_episode_would_see(self, imagined):
        """Imagining 10 steps is taking 10 steps, each with the frames and actions up to it."""
        plan, at, history = a_plan(), imagined.at, imagined.history
        with torch.no_grad():
            states, _ = imagine(imagined.world, imagined.observe, at, history, plan)
            for k in range(10):
                at = imagined.world.step(at, plan[:, k], history)
                history = history.acting(plan[:, k]).observing(imagined.observe(at.state))
                torch.testing.assert_close(states[:, k], at.state)


class TestOnStates:
    def test_the_cost_falls_and_the_pole_stays_up(self):
        torch.manual_seed(0)
        policy = StatePolicy(4)
        target = SyntheticTarget()
        before = score(policy, target, 20, 0, 100)
        task = Balance(PAPER_CARTPOLE, divergence=ANYWHERE)
        settings = TuneSettings(task, 100, 16, learning_rate=1e-2, observation_noise=0.0, longest=100)
        world = World(CartPole(), integrator="euler")
        losses = tune(policy, world, identity, settings, torch.Generator().manual_seed(0))
        after = score(policy, target, 20, 0, 100)
        assert len(losses) == 100
        assert sum(losses[-20:]) < 0.3 * sum(losses[:20])
        assert before.survived < 5
        assert after.survived == 20

    def test_with_only_recorded_starts_streams_begin_in_the_recording(self):
        """The policy is tuned where the target was: here at a state that random starts never reach."""
        row = [0.0, 0.0, 0.3, 0.0]
        recorded = Episode(torch.arange(2.0).numpy(), torch.zeros(2, 1).numpy(), torch.tensor([row, row]).numpy())
        transitions = Transitions.cut([recorded])
        weighs_angle = Cost((0.0, 0.0, 1.0, 0.0), action=0.0)
        costs = []
        for share in (0.0, 1.0):
            torch.manual_seed(0)
            wide = (9.0, 9.0, 9.0, 9.0)
            settings = TuneSettings(
                Balance(weighs_angle, start_spread=(0.0, 0.0, 0.0, 0.0), divergence=wide, first_divergence=1.0),
                iterations=1,
                batch=4,
                recorded=share,
                observation_noise=0.0,
            )
            world = World(CartPole())
            losses = tune(StatePolicy(4), world, identity, settings, torch.Generator().manual_seed(0), transitions)
            costs.append(losses[0])
        assert costs[1] > 3 * costs[0]

    def test_a_loss_that_is_not_a_number_is_an_error_that_says_when(self):
        settings = TuneSettings(Balance(PAPER_CARTPOLE), 5, 4)
        policy = StatePolicy(4)
        world = World(CartPole(), [ConstantForce(force=float("nan"))])
        before = {key: value.clone() for key, value in policy.state_dict().items()}
        with pytest.raises(DivergedError, match="loss is nan at iteration 0"):
            tune(policy, world, identity, settings, torch.Generator().manual_seed(0))
        for key, value in before.items():
            assert torch.equal(value, policy.state_dict()[key]), key


class TestOpposing:
    """A residual that expects what a force does is answered by the opposite force, without any training."""

    def answered(self, newtons, scale, reads, known=()):
        network = StateResidualNetwork(4)
        policy = StatePolicy(4)
        policy.residual = Residual(network, scale)
        source = World(CartPole(), known, integrator="euler").requires_grad_(False)
        state = torch.tensor([[0.3, 0.1, 0.05, -0.2]])
        seen = History.start(state, 1)
        quiet = policy(seen)
        pushed = World(CartPole(), [ConstantForce(force=newtons)], integrator="euler").requires_grad_(False)
        rest, still = torch.zeros(1, 4), torch.zeros(1, 1)
        gap = (pushed.step(pushed.start(rest), still).state - source.step(source.start(rest), still).state)[0]
        with torch.no_grad():
            last = list(network.head.parameters())[-1]
            last.copy_(gap / scale * reads)
        initialise_feedforward(policy, source, scale)
        return (policy(seen).atanh() - quiet.atanh())[0, :, 0] * CartPole().max_force

    @pytest.mark.parametrize("newtons", [2.0, -1.0])
    @pytest.mark.parametrize("scale", [torch.ones(4), torch.tensor([0.003, 0.1, 0.004, 0.15])])
    def test_a_force_is_undone_over_the_whole_plan_whatever_the_scale(self, newtons, scale):
        found = self.answered(newtons, scale, torch.ones(4))
        torch.testing.assert_close(found, torch.full((10,), -newtons), rtol=1e-3, atol=1e-3)

    def test_a_motor_that_is_known_to_be_weak_and_late_is_asked_for_more(self):
        known = [ActuatorGain(scale=0.5), ActuatorDelay(delay=0.1)]
        found = self.answered(2.0, torch.ones(4), torch.ones(4), known)
        torch.testing.assert_close(found, torch.full((10,), -4.0), rtol=1e-3, atol=1e-3)

    def test_dry_friction_that_is_known_does_not_hide_what_a_command_does(self):
        found = self.answered(2.0, torch.ones(4), torch.ones(4), [CoulombFriction(force=4.0)])
        torch.testing.assert_close(found, torch.full((10,), -2.0), rtol=1e-3, atol=1e-3)

    def test_what_no_command_can_do_is_met_by_the_nearest_that_one_can(self):
        scale = torch.tensor([0.003, 0.1, 0.004, 0.15])
        found = self.answered(2.0, scale, torch.tensor([1.0, 1.0, 1.0, 0.0]))
        assert ((found > -2.0) & (found < 0.0)).all()


def learn(checkpoint, stop=None, iterations=24, **more):
    """Tune a policy in a world with memory; interrupt it once `stop` iterations are done."""

    def progress(done, total, loss):
        if done == stop:
            raise KeyboardInterrupt

    torch.manual_seed(0)
    policy = StatePolicy(4, with_history=True)
    world = World(CartPole(), [ActuatorDelay(delay=0.05)], integrator="euler")
    settings = TuneSettings(Balance(PAPER_CARTPOLE), iterations, 8, longest=30, **more)
    generator = torch.Generator().manual_seed(1)
    losses = tune(policy, world, identity, settings, generator, progress=progress, checkpoint=checkpoint)
    return policy.state_dict(), losses


class Stepped(Balance):
    """Counts the steps that streams take."""

    steps = 0

    def disturb(self, state, generator):
        type(self).steps += len(state)
        return super().disturb(state, generator)


class UnevenTrack(DynamicsEffect):
    """A force that changes along the track, so that no plan made half a second before cancels it."""

    def load(self, time, state, system):
        force = 2.0 * (6.0 * state[:, 0]).cos() * (3.0 * state[:, 2]).cos()
        return torch.stack((force, torch.zeros_like(force)), -1)


class TestClosedLoop:
    """The policy decides anew at every step that is imagined."""

    def test_with_kept_states_it_is_refused(self):
        with pytest.raises(ValueError, match=r"closed_loop decides at every step, .* got streams = 4"):
            TuneSettings(Balance(PAPER_CARTPOLE), 1, streams=4, closed_loop=True)

    def test_a_task_that_no_policy_file_could_keep_is_refused(self):
        with pytest.raises(TypeError, match=r"^task: object is no frozen dataclass: write @dataclass"):
            TuneSettings(object(), 1)  # type: ignore[arg-type]

    def test_streams_go_on_after_the_last_step_as_the_policy_would_have_gone(self):
        torch.manual_seed(0)
        policy, world = StatePolicy(4, with_history=True), World(CartPole(), [ConstantForce(force=1.0)])
        task = Balance(PAPER_CARTPOLE, start_spread=(0.1, 0.1, 0.05, 0.1), kick=(0.0,) * 4, divergence=(1e9,) * 4)
        generator = torch.Generator().manual_seed(1)
        streams = Streams(world, task, None, None, 8, 1000, 0.0, torch.zeros(()))
        streams.start(1.0, generator)
        at, history, age = streams.now.at, streams.now.history, streams.age.clone()
        ClosedLoop(policy, streams, 0.0, generator).loss(0, 1.0)
        with torch.no_grad():
            for _ in range(HORIZON):
                action = policy.act(history)
                at = world.step(at, action)
                history = history.acting(action).observing(at.state)
        young = age + HORIZON < 1000
        assert young.any()
        assert torch.equal(streams.age[young], age[young] + HORIZON)
        torch.testing.assert_close(streams.now.at.state[young], at.state[young])
        torch.testing.assert_close(streams.now.history.observations[young], history.observations[young])
        assert not streams.now.history.observations.requires_grad

    def test_the_gradient_is_the_change_of_the_loss(self):
        torch.manual_seed(0)
        policy, world = StatePolicy(4, with_history=True), World(CartPole(), [ConstantForce(force=1.0)])
        world.requires_grad_(False)
        task = Balance(PAPER_CARTPOLE, start_spread=(0.1, 0.1, 0.05, 0.1))

        def loss():
            generator = torch.Generator().manual_seed(1)
            streams = Streams(world, task, None, None, 8, 100, 0.0, torch.zeros(()))
            streams.start(1.0, generator)
            return ClosedLoop(policy, streams, 0.0, generator).loss(0, 1.0)

        weight = policy.first.weight
        (gradient,) = torch.autograd.grad(loss(), weight)
        direction, size = gradient / gradient.norm(), 1e-3
        losses = []
        with torch.no_grad():
            for change in (size * direction, -2 * size * direction):
                weight += change
                losses.append(float(loss()))
        assert (losses[0] - losses[1]) / (2 * size) == pytest.approx(float(gradient.norm()), rel=0.02)

    def test_under_a_force_that_no_plan_foresees_the_cart_becomes_slower(self):
        hidden = UnevenTrack()
        setup = cartpole_states(World(CartPole(), [hidden]))
        setup = replace(setup, settings=replace(setup.settings, named=replace(setup.settings.named, iterations=20)))
        policy, target = setup.load(shipped("cartpole_states")), SyntheticTarget(lambda batch, generator: [hidden])
        before = score(policy, target, 5, 0, 100)
        setup.tune(policy, 0)
        after = score(policy, target, 5, 0, 100)
        assert after.survived == 5
        assert after.mean_speed < 0.8 * before.mean_speed


class TestReplay:
    """Streams of which every stream is kept and learnt from."""

    def test_few_steps_are_taken_and_still_the_pole_stays_up(self):
        torch.manual_seed(0)
        Stepped.steps = 0
        policy = StatePolicy(4)
        task = Stepped(PAPER_CARTPOLE, divergence=ANYWHERE)
        settings = TuneSettings(task, 150, 32, 1e-2, 100, streams=4, every=3, observation_noise=0.0)
        tune(policy, World(CartPole(), integrator="euler"), identity, settings, torch.Generator().manual_seed(0))
        assert Stepped.steps == 4 * 50
        assert score(policy, SyntheticTarget(), 20, 0, 100).survived == 20

    def test_on_frames_plans_come_to_cost_less_and_the_encoder_stays_as_it_is(self):
        torch.manual_seed(0)
        renderer = small_renderer()
        observe = observing(renderer)
        policy = ImagePolicy(background(renderer), CONTRAST)
        world = World(CartPole())
        task = Balance(PAPER_CARTPOLE, start_spread=(0.3, 0.1, 0.05, 0.1), kick=(0.0,) * 4)
        state, task_state = task.training_start(50, 1.0, torch.Generator().manual_seed(1))
        history = History.start(observe(state), 1)

        @torch.no_grad()
        def cost():
            plan = policy(history)
            states, _ = imagine(world, observe, world.start(state), history, plan)
            return float(task.cost(states, plan, state, task_state).mean())

        before, eyes = cost(), {key: value.clone() for key, value in policy.encoder.state_dict().items()}
        settings = TuneSettings(task, 100, 32, 5e-3, longest=5, streams=16, every=10, curriculum=False)
        tune(policy, world, observe, settings, torch.Generator().manual_seed(0))
        assert cost() < 0.8 * before
        for key, value in eyes.items():
            assert torch.equal(value, policy.encoder.state_dict()[key]), key


class TestResuming:
    @pytest.fixture(autouse=True)
    def checkpoints(self, monkeypatch):
        monkeypatch.setattr("visadapt.learning.training_state.CHECKPOINT_ITERATIONS", 20)

    @pytest.mark.parametrize("more", [{}, {"streams": 3, "every": 2}])
    def test_interrupted_after_a_checkpoint_it_goes_on_to_the_same_numbers(self, tmp_path, more):
        weights, losses = learn(None, **more)
        path = tmp_path / "partial.safetensors"
        with pytest.raises(KeyboardInterrupt):
            learn(path, stop=22, **more)
        resumed, again = learn(path, **more)
        assert again == losses
        for key, value in weights.items():
            assert torch.equal(value, resumed[key]), key

    def test_it_does_go_on_and_does_not_begin_anew(self, tmp_path):
        path = tmp_path / "partial.safetensors"
        with pytest.raises(KeyboardInterrupt):
            learn(path, stop=21)
        with pytest.raises(KeyboardInterrupt):
            learn(path, stop=22)
        seen = path.read_bytes()
        learn(path)  # would rewrite the checkpoint at 20, had it begun anew
        assert path.read_bytes() == seen
