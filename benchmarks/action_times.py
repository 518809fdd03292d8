"""CPU time of one action: the policy in PyTorch, and as the ONNX file that `visadapt export` writes.

    python -m benchmarks.action_times

One history at a time, as a machine asks, on one thread. The shipped policies of the cart-pole, alone and with a
residual, whose weights do not change the time; random inputs. CPU seconds over many actions, so that other work on the
machine tells little; the median of several such runs. Writes results/action_times.csv.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

from experiments.result_tables import ACTION_TIME, Row, write_rows
from visadapt.history import LENGTH, History
from visadapt.policies import Policy
from visadapt.setups.onnx_file import export_policy
from visadapt.setups.policy_file import load_policy, load_source, residual_for
from visadapt.weights import shipped

POLICIES = {"states": "cartpole_states", "frames": "cartpole_frames"}
TORCH, ONNX = "PyTorch", "ONNX Runtime"
RESIDUAL = ", residual"


@dataclass(frozen=True)
class Settings:
    """What is measured, and where."""

    actions: int = 300
    """in a run"""
    runs: int = 7
    out: Path = Path("results/action_times.csv")


def main(settings: Settings) -> None:
    """Measure, write the table, print it."""
    torch.set_num_threads(1)
    rows = []
    for shown, name in POLICIES.items():
        policy, source = load_policy(shipped(name)), load_source(shipped(name))
        for what in (shown, shown + RESIDUAL):
            if what != shown:
                policy.residual = residual_for(policy, source)
            for method, act in ((TORCH, _by_torch(policy)), (ONNX, _by_onnx(policy))):
                times = [_milliseconds(act, settings.actions) for _ in range(settings.runs)]
                about = (f"CartPole, {what}", "cartpole", method, "source", None, ACTION_TIME, "ms")
                mean, std = statistics.median(times), statistics.pstdev(times)
                rows.append(Row(*about, round(mean, 4), round(std, 4), None, 0, None))
                print(f"{what:18} {method:14} {mean:7.3f} ms")
    write_rows(settings.out, rows)


def _by_torch(policy: Policy) -> Callable[[], object]:
    drawn = torch.rand(1, LENGTH, *policy.observation_shape)
    actions = torch.zeros(1, LENGTH, policy.n_action)

    @torch.inference_mode()
    def act() -> object:
        return policy.act(History(drawn, actions))

    return act


def _by_onnx(policy: Policy) -> Callable[[], object]:
    import onnxruntime  # of an extra, and the pages take names from this module

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "policy.onnx"
        export_policy(path, policy)
        session = onnxruntime.InferenceSession(path, options)
    drawn = torch.rand(LENGTH, *policy.observation_shape)
    observations = (255 * drawn).byte() if policy.shown == "frame" else drawn
    given = {"observations": observations.numpy(), "actions": torch.zeros(LENGTH, policy.n_action).numpy()}
    read = {each.name: given[each.name] for each in session.get_inputs()}
    return lambda: session.run(None, read)


def _milliseconds(act: Callable[[], object], actions: int) -> float:
    for _ in range(10):  # which warm up
        act()
    began = time.process_time()
    for _ in range(actions):
        act()
    return 1000 * (time.process_time() - began) / actions


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
