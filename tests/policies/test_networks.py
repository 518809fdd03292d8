import pytest
import torch
import torch.nn.functional as F
from torch import nn

from experiments.furuta import Furuta
from tests.own_systems import DoublePendulum
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
from visadapt.effects import ConstantForce, Residual
from visadapt.effects.catalogue import catalogue
from visadapt.history import LENGTH, History
from visadapt.policies import StatePolicy
from visadapt.policies.frame_encoder import FrameEncoder
from visadapt.policies.networks import StateHistoryResidualNetwork, StateResidualNetwork
from visadapt.systems import CartPole
from visadapt.world import World


def histories(seed, batch=3, dtype=torch.float32, height=HEIGHT, width=WIDTH):
    generator = torch.Generator().manual_seed(seed)
    return History(
        torch.rand(batch, LENGTH, height, width, generator=generator, dtype=dtype),
        2 * torch.rand(batch, LENGTH, 1, generator=generator, dtype=dtype) - 1,
    )


def states(seed, batch=3, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    return History(
        torch.randn(batch, LENGTH, 4, generator=generator, dtype=dtype),
        2 * torch.rand(batch, LENGTH, 1, generator=generator, dtype=dtype) - 1,
    )


def encoder(dtype=torch.float32):
    torch.manual_seed(0)
    return FrameEncoder(background(small_renderer()), CONTRAST, n_action=1).to(dtype)


class TestFrameEncoder:
    def test_it_is_four_convolutions_of_the_latest_frame_and_magnified_changes(self):
        made, history = encoder(torch.float64), histories(1, dtype=torch.float64)
        frames = history.observations
        latest = frames[:, 4] - made.background
        changes = [2 * (frames[:, k] - frames[:, k - 1]) for k in (1, 2, 3, 4)]
        seen = torch.stack([latest, *changes], 1) / CONTRAST
        for convolution in made.convolutions:
            seen = F.conv2d(seen, convolution.weight, convolution.bias, stride=2, padding=1).relu()
        joined = torch.cat((seen.flatten(1), history.actions.flatten(1)), 1)
        wanted = (joined @ made.join[0].weight.T + made.join[0].bias).relu()
        assert len(made.convolutions) == 4
        assert wanted.std() > 0.01
        # The contrast is kept in single precision.
        torch.testing.assert_close(made(history), wanted, rtol=1e-6, atol=1e-7)

    def test_gradients_flow_to_every_weight_and_to_every_frame(self):
        made, history = encoder(), histories(2)
        frames = history.observations.clone().requires_grad_()
        made.kinematics(History(frames, history.actions)).square().sum().backward()
        for name, weight in made.named_parameters():
            assert weight.grad.abs().sum() > 0, name
        assert (frames.grad.abs().sum((0, 2, 3)) > 0).all()

    def test_frames_of_another_size_are_refused_with_both_sizes(self):
        with pytest.raises(ValueError, match=r"frames of \(20, 24\) \(height, width\), got \(24, 20\)"):
            encoder()(histories(1, height=WIDTH, width=HEIGHT))

    def test_rows_of_a_batch_do_not_know_each_other(self):
        made, history = encoder(torch.float64), histories(3, dtype=torch.float64)
        whole = made(history)
        for b in range(3):
            torch.testing.assert_close(made(history[b : b + 1]), whole[b : b + 1])

    def test_background_and_contrast_travel_with_the_weights(self):
        made = encoder()
        other = FrameEncoder(torch.zeros(HEIGHT, WIDTH), 1.0, n_action=1)
        other.load_state_dict(made.state_dict())
        assert torch.equal(made(histories(1)), other(histories(1)))


def networks(dtype=torch.float32):
    torch.manual_seed(1)
    return {
        "image": (image_residual_network(small_renderer()).to(dtype), histories(4, dtype=dtype)),
        "state": (StateResidualNetwork(4).to(dtype), states(4, dtype=dtype)),
        "history": (state_residual_network(True).to(dtype), states(4, dtype=dtype)),
    }


@pytest.mark.parametrize("kind", ["image", "state", "history"])
class TestResidualNetworks:
    def test_a_fresh_one_is_zero_and_a_world_with_it_is_the_world_without(self, kind):
        network, history = networks()[kind]
        assert torch.equal(network(history), torch.zeros(3, 4))
        state, action = 0.1 * torch.ones(3, 4), torch.full((3, 1), 0.3)
        plain, grounded = World(CartPole()), World(CartPole(), [Residual(network, torch.ones(4))])
        assert torch.equal(
            grounded.step(grounded.start(state), action, history).state, plain.step(plain.start(state), action).state
        )

    def test_its_correction_is_in_units_of_the_scale_and_comes_after_the_physics(self, kind):
        network, history = networks()[kind]
        stir(network)
        scale = torch.tensor([1.0, 2.0, 3.0, 4.0])
        state, action = 0.1 * torch.ones(3, 4), torch.full((3, 1), 0.3)
        plain = World(CartPole(), [ConstantForce(force=1.0)])
        grounded = World(CartPole(), [Residual(network, scale), ConstantForce(force=1.0)])
        with torch.no_grad():
            wanted = plain.step(plain.start(state), action).state + scale * network(history.acting(action))
            found = grounded.step(grounded.start(state), action, history).state
        torch.testing.assert_close(found, wanted)
        assert (found - plain.step(plain.start(state), action).state).abs().min() > 1e-3

    def test_the_action_being_executed_matters(self, kind):
        network, history = networks()[kind]
        stir(network)
        with torch.no_grad():
            one, other = (network(history.acting(torch.full((3, 1), value))) for value in (-0.5, 0.5))
        assert ((one - other).abs().sum(1) > 1e-4).all()

    def test_the_head_reads_what_embed_gives(self, kind):
        network, history = networks()[kind]
        stir(network)
        assert torch.equal(network.head(network.embed(history)), network(history))

    def test_double_precision_stays_double(self, kind):
        network, history = networks(torch.float64)[kind]
        assert network(history).dtype == torch.float64


@pytest.mark.parametrize("with_history", [False, True])
def test_without_history_a_state_network_sees_the_latest_state_and_action_alone(with_history):
    network = stir(state_residual_network(with_history))
    history = states(5)
    older = History(history.observations.clone(), history.actions.clone())
    older.observations[:, :-1] += 1.0
    older.actions[:, :-1] += 1.0
    with torch.no_grad():
        assert torch.equal(network(history), network(older)) != with_history


class TestUnexplained:
    """The accelerations that the residual is shown beside what it sees, from exact positions."""

    @staticmethod
    def seen(effects, steps=10):
        """What is unexplained at the middle frames of all windows along the start of an episode."""
        generator = torch.Generator().manual_seed(0)
        world = World(CartPole(), effects, substeps=20).double()
        at = world.start(torch.tensor([[0.1, 0.2, 0.05, -0.1]], dtype=torch.float64))
        states, actions = [at.state[0]], []
        for _ in range(steps):
            actions.append(0.1 * torch.randn(1, generator=generator, dtype=torch.float64))
            at = world.step(at, actions[-1][None])
            states.append(at.state[0])
        path, done = torch.stack(states), torch.stack(actions)
        positions = path[:-1, [0, 2]].unfold(0, LENGTH, 1)
        changes = positions.diff(dim=-1)
        kinematics = torch.cat((positions[..., -1:], changes), -1).flatten(1)
        network = image_residual_network(small_renderer()).double()
        return network.unexplained(kinematics, done.unfold(0, LENGTH, 1).transpose(1, 2))

    def test_without_a_gap_nothing_is_left(self):
        # The commands alone give accelerations of some 3 m/s2 and 4 rad/s2.
        left = self.seen([])
        assert float(left.detach().abs().max()) < 0.1

    def test_a_force_on_the_cart_is_left_as_the_accelerations_it_gives_near_upright(self):
        # A force F on an upright cart-pole: x_ddot = F / (M - 3/4 m), theta_ddot = -3/4 x_ddot / l.
        left = self.seen([ConstantForce(force=2.0)])
        cart = 2.0 / (1.1 - 0.75 * 0.1)
        expected = torch.tensor([cart, -0.75 * cart / 0.5], dtype=torch.float64)
        torch.testing.assert_close(left.detach().mean((0, 1)), expected, rtol=0.02, atol=0.0)


def test_on_states_a_force_is_left_and_without_one_nothing():
    for newtons in (0.0, 2.0):
        world = World(CartPole(), [ConstantForce(force=newtons)], substeps=20)
        at = world.start(torch.tensor([[0.1, 0.2, 0.05, -0.1]]))
        seen, action = [at.state], torch.full((1, 1), 0.05)
        for _ in range(LENGTH - 1):
            at = world.step(at, action)
            seen.append(at.state)
        left = state_residual_network(True).unexplained(torch.stack(seen, 1), action[:, None].expand(1, LENGTH, 1))
        cart = newtons / (1.1 - 0.75 * 0.1)
        torch.testing.assert_close(left.mean((0, 1)), torch.tensor([cart, -0.75 * cart / 0.5]), rtol=0.02, atol=0.02)


@pytest.mark.parametrize(("system", "load"), [(DoublePendulum, "shoulder"), (Furuta, "hinge")])
def test_on_states_of_ones_own_system_a_load_is_left_as_the_accelerations_it_gives(system, load):
    constant = {effect.name: effect for effect in catalogue(system())}[f"{load}.constant_load"]
    machine = World(system(), [constant(torque=0.02)], 0.002).requires_grad_(False)
    network = StateHistoryResidualNetwork(system(), machine.period)
    at = machine.start(torch.tensor([[0.1, 0.3, 0.5, -0.4]]))
    rows = [at.state]
    for _ in range(LENGTH - 1):
        at = machine.step(at, torch.zeros(1, len(system.actions)))
        rows.append(at.state)
    history = History(torch.stack(rows, 1), torch.zeros(1, LENGTH, len(system.actions)))
    left = network.unexplained(history.observations, history.actions)[0, -1]
    none, given = torch.zeros(1, len(system.loads)), torch.zeros(1, len(system.actions))
    one = none.clone()
    one[0, [each.name for each in system.loads].index(load)] = 0.02
    expected = system().accelerations(at.state, given, one) - system().accelerations(at.state, given, none)
    torch.testing.assert_close(left, expected[0], rtol=0.05, atol=0.01 * float(expected.abs().max()))
    assert network(history).shape == (1, 4)


def test_a_policy_pushes_against_what_its_residual_expects_once_the_feedforward_has_weight():
    policy = StatePolicy(n_state=4)
    network = StateResidualNetwork(4)
    policy.residual = Residual(network, torch.ones(4))
    history = states(3)
    quiet = policy.act(history).atanh()
    assert isinstance(network.head, nn.Sequential)
    with torch.no_grad():
        last = network.head[-1]
        assert isinstance(last, nn.Linear)
        last.bias.copy_(torch.tensor([0.0, 1.0, 0.0, 0.0]))
        policy.feedforward.weight[:, 1] = -0.25
    torch.testing.assert_close(policy.act(history).atanh(), quiet - 0.25)
