"""Policy files: the residual comes back as it was, and a policy of one's own by its own setup."""

from dataclasses import dataclass
from typing import ClassVar

import pytest
import torch

import visadapt as va
from tests.own_systems import Pendulum
from tests.scenes import stir
from visadapt.effects import EFFECTS
from visadapt.effects.own import own_effects
from visadapt.history import LENGTH, History
from visadapt.learning.setup_settings import SetupSettings
from visadapt.learning.tuning import TuneSettings
from visadapt.policies import ReachPolicy, StatePolicy
from visadapt.policies.networks import StateResidualNetwork
from visadapt.setups.policy_file import describe, load_policy, load_source, residual_for, save_policy
from visadapt.storage.checkpoints import CheckpointError, load_tree
from visadapt.systems import Variable
from visadapt.tasks.balance import Balance, Cost


@pytest.mark.parametrize("with_history", [False, True])
def test_a_flights_residual_comes_back_with_the_history_that_it_reads(tmp_path, with_history):
    world, path = va.World(va.FixedWing()), tmp_path / "policy.safetensors"
    policy = stir(ReachPolicy()).eval()
    policy.residual, policy.grounded_in = stir(residual_for(policy, world, with_history)), describe(world)
    save_policy(path, policy)
    assert load_tree(path)["settings"]["with_history"] == with_history
    read = load_policy(path)
    assert (read.residual.network.predict is not None) == with_history
    history = History(torch.randn(3, LENGTH, *policy.observation_shape), torch.zeros(3, LENGTH, 4))
    assert torch.equal(read.act(history), policy.act(history))


@pytest.mark.parametrize("kind", ["cartpole_frames", "quadrotor"])
def test_a_policy_in_double_precision_comes_back_in_it(tmp_path, kind):
    policy, path = va.load_policy(va.shipped(kind)).double(), tmp_path / "policy.safetensors"
    world = va.load_source(va.shipped(kind))
    policy.residual, policy.grounded_in = stir(residual_for(policy, world)).double(), describe(world)
    save_policy(path, policy)
    read = load_policy(path)
    assert {each.dtype for each in read.state_dict().values() if each.is_floating_point()} == {torch.float64}
    history = History(
        torch.rand(2, LENGTH, *policy.observation_shape).double(), torch.zeros(2, LENGTH, policy.n_action).double()
    )
    assert torch.equal(read.act(history), policy.act(history))


@dataclass(frozen=True)
class WeakPendulum(Pendulum):
    """One whose torque has the range of a policy's commands."""

    name = "weak_pendulum"
    actions: ClassVar[tuple[Variable, ...]] = (Variable("torque", "N m", -1.0, 1.0),)


class OwnPolicy(StatePolicy):
    pass


def own_setup(source):
    task = Balance(Cost((1.0, 0.1)), (0.1, 0.1), (0.0, 0.0), (1.0, 5.0))
    tune = TuneSettings(task, iterations=2, batch=4)

    def residual(policy, world):
        return va.Residual(StateResidualNetwork(2), torch.ones(2))

    return va.Setup(source, lambda: OwnPolicy(2), residual, SetupSettings(tune, tune, longest_episode=10))


class TestOwnSetup:
    def test_a_policy_of_ones_own_is_refused_with_what_reads_it(self, tmp_path):
        path = tmp_path / "policy.safetensors"
        own_setup(va.World(WeakPendulum())).pretrain(path, 0)
        with pytest.raises(
            CheckpointError, match=r"holds a OwnPolicy, a policy .* is read by the `load` of that setup"
        ):
            load_policy(path)
        assert load_source(path).system == WeakPendulum()

    def test_its_setup_reads_it_with_its_residual_and_the_world_that_this_completes(self, tmp_path):
        effect = next(each for each in own_effects(WeakPendulum) if each.name == "joint.viscous_friction")
        setup, path = own_setup(va.World(WeakPendulum())), tmp_path / "policy.safetensors"
        policy = stir(setup.policy()).eval()
        grounded = va.World(WeakPendulum(), [effect(coefficient=0.02)])
        policy.residual, policy.grounded_in = stir(setup.residual(policy, grounded)), describe(grounded)
        save_policy(path, policy)
        for each in own_effects(WeakPendulum):  # as in a process that has not asked for them yet
            del EFFECTS[each.name]
        read = setup.load(path)
        for key, value in policy.state_dict().items():
            assert torch.equal(value, read.state_dict()[key]), key
        assert load_source(path).effects[0].name == "joint.viscous_friction"

    def test_a_system_without_a_name_of_its_own_is_refused(self):
        """Its policies would be read with the class that it derives from."""

        class Renamed(WeakPendulum):
            pass

        with pytest.raises(ValueError, match="Renamed has the name of the class that it derives from, 'weak_pendulum'"):
            own_setup(va.World(Renamed()))

    def test_a_system_that_is_not_known_is_named(self, tmp_path):
        path = tmp_path / "policy.safetensors"
        save_policy(path, StatePolicy(4), {"source": {**describe(va.World(va.CartPole())), "system": "unicycle"}})
        with pytest.raises(CheckpointError, match="needs 'unicycle', which is not known here: import the file"):
            load_source(path)


def test_exchanged_arguments_are_said(tmp_path):
    with pytest.raises(TypeError, match=r"^save_policy takes a path, then a policy .* a ReachPolicy, then a str$"):
        save_policy(ReachPolicy(), str(tmp_path / "policy.safetensors"))  # type: ignore[arg-type]
