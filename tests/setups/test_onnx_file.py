from collections.abc import Callable

import numpy as np
import onnxruntime
import pytest
import torch
from torch import Tensor, nn

import visadapt as va
from renderers import DrawnCartPole
from visadapt.history import History
from visadapt.policies import Policy
from visadapt.setups.onnx_file import ExportError, export_policy
from visadapt.setups.policy_file import load_source, residual_for
from visadapt.targets.rollout import SHOWN
from visadapt.tasks.base import FlightTask


class Both(Policy):
    """A policy, and how far the plans of its ONNX file are from its own at each step of a run."""

    def __init__(self, policy, path):
        super().__init__(policy.n_state, policy.n_action)
        self.policy = policy
        self.session = onnxruntime.InferenceSession(path)
        self.apart = []

    def forward(self, history: History) -> Tensor:
        wanted = self.policy(history)
        seen = history.observations
        seen = (255 * seen).round().byte() if self.policy.shown == "frame" else seen
        for row, actions, plan in zip(seen, history.actions, wanted, strict=True):
            (found,) = self.session.run(None, {"observations": row.numpy(), "actions": actions.numpy()})
            self.apart.append(np.abs(found - plan.numpy()).max())
        return wanted


def with_residual(name):
    """A shipped policy that reads a residual of random weights; a flight's steps the source's physics itself."""
    policy, source = va.load_policy(va.shipped(name)), load_source(va.shipped(name))
    quick = va.World(source.system, period=source.period, integrator="euler", substeps=1)
    policy.residual = residual_for(policy, quick, with_history=name == "fixed_wing")
    torch.manual_seed(0)
    for weight in policy.residual.network.get_submodule("head").parameters():
        nn.init.normal_(weight, std=0.02)
    nn.init.normal_(policy.feedforward.weight, std=0.2)
    return policy, source


def fixed_wing_target(source):
    task = va.setup_for(source).settings.source.task
    assert isinstance(task, FlightTask)
    return va.FlightTarget(task, source.system)


@pytest.mark.parametrize("name", ["cartpole_states", "cartpole_frames", "fixed_wing"])
def test_a_machine_runs_the_file_as_torch_runs_the_policy(name, tmp_path):
    policy, source = with_residual(name)
    export_policy(tmp_path / "policy.onnx", policy, source)
    targets: dict[str, Callable[[], va.Target]] = {
        "cartpole_states": lambda: va.SyntheticTarget(va.constant_force(1.0)),
        "cartpole_frames": lambda: va.SyntheticTarget(va.constant_force(1.0), DrawnCartPole()),
        "fixed_wing": lambda: fixed_wing_target(source),
    }
    both = Both(policy, tmp_path / "policy.onnx")
    see = SHOWN[policy.shown]
    episodes = va.run(targets[name](), both, 2, 12, torch.Generator().manual_seed(1), see=see)
    assert all(np.ptp(one.episode.action) > 0.01 for one in episodes)
    assert len(both.apart) == 24
    assert max(both.apart) < 1e-4


def test_a_policy_that_onnx_cannot_say_is_refused_in_one_line_and_leaves_nothing(tmp_path):
    class Sorted(Policy):
        def forward(self, history: History) -> Tensor:
            singular = torch.linalg.svdvals(history.observations)[:, :1]
            return singular.expand(-1, 10)[..., None]

    policy = Sorted(4, 1)
    with pytest.raises(ExportError, match=r"policy.onnx was not written: the policy has no form in ONNX: [^\n]+$"):
        export_policy(tmp_path / "policy.onnx", policy)
    assert not list(tmp_path.iterdir())
