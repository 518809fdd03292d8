"""Policies as ONNX, to run on a machine without PyTorch, and several times faster on one core."""

from __future__ import annotations

import copy
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from visadapt.history import HORIZON, LENGTH, History
from visadapt.policies import FlightPolicy, Policy
from visadapt.storage.atomic_files import replacing

if TYPE_CHECKING:
    from visadapt.world import World

LARGEST_DIFFERENCE = 1e-4
"""Largest difference of an action between the file and the policy, as a share of half a command's range; float32
rounding makes 1e-6."""


class ExportError(RuntimeError):
    """A policy cannot be written as ONNX; the message is one line that says why."""


class _Deployed(nn.Module):
    """A policy as a machine calls it: one history, without a batch, frames as a camera gives them."""

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Plan (HORIZON, n_action) of observations (LENGTH, ...) and actions (LENGTH, n_action)."""
        if self.policy.shown == "frame":
            observations = observations.to(actions.dtype) / 255
        return self.policy(History(observations[None], actions[None]))[0]


def export_policy(path: str | Path, policy: Policy, source: World | None = None) -> None:
    """Write a policy, with the residual that it reads, as an ONNX file (extra `visadapt[onnx]`).

    Its inputs are `observations`, states (5, n_state), with the goal appended where there is one, in float32, or frames
    (5, H, W) in uint8, and `actions` (5, n_action) in float32: the last five of each, oldest first. At the start of an
    episode the first observation is repeated five times, and the actions are 0. Its output `plan` (10, n_action)
    begins with the action to execute now. The file's metadata describe these and, of `source`, the states, actions and
    period.

    Args:
        source: the world that the policy was trained in, for the metadata alone.

    Raises:
        ExportError: the extra is missing, ONNX lacks an operation, or the file's actions would differ.
        DiskFullError, NotWrittenError: as `storage.atomic_files.replacing`.

    >>> import visadapt as va, tempfile, pathlib
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "policy.onnx"
    >>> va.export_policy(path, va.load_policy(va.shipped("cartpole_states")))
    >>> import numpy as np, onnxruntime
    >>> session = onnxruntime.InferenceSession(path)
    >>> observations, actions = np.zeros((5, 4), np.float32), np.zeros((5, 1), np.float32)
    >>> session.run(None, {"observations": observations, "actions": actions})[0].shape
    (10, 1)
    """
    onnx, runtime = _packages()
    policy = copy.deepcopy(policy).float()
    deployed = _Deployed(policy).eval()
    examples = _examples(policy)
    with _quiet(), torch.no_grad():
        # The policy runs first: what the physics computes once and caches then becomes a constant of the file.
        plans = [deployed(*example.values()).cpu().numpy() for example in examples]
        names, given = list(examples[0]), tuple(examples[0].values())
        try:
            model = torch.onnx.export(deployed, given, input_names=names, output_names=["plan"], verbose=False)
        except torch.onnx.OnnxExporterError as error:
            why = str(error.__cause__ or error).partition("\n")[0]
            raise ExportError(f"{path} was not written: the policy has no form in ONNX: {why}") from error
    assert model is not None
    with replacing(path) as temporary:
        proto = model.model_proto  # built anew at each access
        onnx.helper.set_model_props(proto, about(policy, source))
        onnx.save(proto, temporary)
        session = runtime.InferenceSession(temporary, providers=["CPUExecutionProvider"])
        used = {each.name for each in session.get_inputs()}  # without inputs that the policy does not use
        for example, plan in zip(examples, plans, strict=True):
            written_plan = session.run(None, {name: example[name].cpu().numpy() for name in used})[0]
            low, high = (bound.cpu().numpy() for bound in policy.command_range)
            if not (difference := abs((written_plan - plan) / (high - low) * 2).max()) <= LARGEST_DIFFERENCE:
                raise ExportError(f"{path} was not written: its actions would differ by {difference:.2g} of 1")


def _examples(policy: Policy) -> list[dict[str, Tensor]]:
    """Inputs within an episode and at the start of one, by name."""
    weight = next(policy.parameters())
    generator = torch.Generator().manual_seed(0)
    drawn = torch.rand(LENGTH, *policy.observation_shape, generator=generator).to(weight)
    observations = (255 * drawn).byte() if policy.shown == "frame" else drawn
    actions = torch.rand(LENGTH, policy.n_action, generator=generator).to(weight)
    start = History.start(observations[:1], policy.n_action).observations[0]
    return [
        {"observations": observations, "actions": actions},
        {"observations": start, "actions": torch.zeros_like(actions)},
    ]


def about(policy: Policy, source: World | None = None) -> dict[str, str]:
    """The metadata of the file, by name: what one needs to know to run it."""
    shape = " x ".join(map(str, (LENGTH, *policy.observation_shape)))
    kind = "uint8" if policy.shown == "frame" else "float32"
    bounds = zip(*(bound.tolist() for bound in policy.command_range), strict=True)
    ranges = "in " + ", ".join(dict.fromkeys(f"[{low:g}, {high:g}]" for low, high in bounds))
    known = {
        "observations": f"the last {LENGTH}, oldest first: {policy.shown}, {shape} {kind}",
        "actions": f"the last {LENGTH}, oldest first, {ranges}: {LENGTH} x {policy.n_action} float32",
        "plan": f"the next {HORIZON}, of which the first is executed: {HORIZON} x {policy.n_action} float32",
    }
    if isinstance(policy, FlightPolicy):
        known["goal"] = policy.goal
    if source is not None:
        states, actions = source.system.states, source.system.actions
        known["system"] = source.system.name
        known["states"] = ", ".join(f"{each.name} {each.unit}" for each in states)
        known["action names"] = ", ".join(each.name for each in actions)
        known["period"] = f"{source.period:g} s"
    return known


def _packages() -> tuple[Any, Any]:
    """The packages onnx and onnxruntime; raises ExportError where one is missing."""
    try:
        import onnx
        import onnxruntime
        import onnxscript  # noqa: F401 PyTorch's exporter writes with it
    except ImportError as error:
        raise ExportError(f"needs the package {error.name}: pip install 'visadapt[onnx]'") from error
    return onnx, onnxruntime


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the exporter's warnings of packages that a policy has no use for."""
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    finally:
        log.setLevel(level)
