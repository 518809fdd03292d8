"""Joint learning of residual and policy: Algorithm 1 of the paper, round after round.

Each round executes the policy in the target for B counted samples, grounds the residual on all samples so far, and
tunes the policy by backpropagation through the world so grounded (`learning.plans`). What a round does is in
`learning.rounds`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from visadapt.effects import Residual
from visadapt.learning.explanation import Explain
from visadapt.learning.ledger import Ledger
from visadapt.learning.rounds import JointLearning, Label, Round, RoundFolder
from visadapt.learning.setup_settings import SetupSettings
from visadapt.learning.transitions import Observe
from visadapt.policies import Policy
from visadapt.progress import Report
from visadapt.recordings import Episode
from visadapt.storage.checkpoints import load_tree, load_weights
from visadapt.targets import Target
from visadapt.world import World


@dataclass(frozen=True)
class Adapted:
    """The outcome of `adapt`; policy and residual were changed in place.

    >>> import visadapt as va
    >>> policy = va.load_policy(va.shipped("cartpole_states"))
    >>> target = va.SyntheticTarget(va.constant_force(1.0))
    >>> result = va.adapt(policy, va.World(va.CartPole()), target, samples=20, iterations=1)
    >>> result.ledger.entries
    [('round 1/1: data', 20)]
    """

    policy: Policy
    ledger: Ledger
    rounds: list[Round]
    episodes: list[Episode]
    folder: Path | None
    """where the run is kept; None: it is not"""
    source: World
    """the source, with the effects that were fitted, and those that the last diagnosis named"""

    def restore(self, policy: Policy, samples: int) -> None:
        """Give `policy`, and the residual it reads, the weights they had after `samples` counted samples.

        Raises:
            ValueError: no round ended there, or the run was not kept.
        """
        if self.folder is None:
            raise ValueError("this run was not kept: give adapt a folder")
        ends = [each.samples for each in self.rounds]
        if samples not in ends:
            raise ValueError(f"no round ended at {samples} samples; rounds ended at {', '.join(map(str, ends))}")
        path = RoundFolder.of(self.folder, ends.index(samples), len(ends), 0).policy
        load_weights(policy, load_tree(path)["weights"], path)


def adapt(
    policy: Policy,
    residual: Residual,
    source: World,
    target: Target,
    settings: SetupSettings,
    folder: Path,
    budget: int,
    round_samples: int,
    seed: int,
    observe: Observe | None = None,
    label: Label | None = None,
    report: Report | None = None,
    explorer: Policy | None = None,
    explain: Explain | None = None,
) -> Adapted:
    """Run Algorithm 1 in `folder`, going on from what is there.

    Args:
        policy, residual: the networks, changed in place; the policy reads the residual.
        source: the physics known beforehand; the parameters of its effects, if it has any, are fitted.
        budget, round_samples: N and B, target samples in all and in a round.
        observe: renders simulated states as the camera would; None where the policy sees what the sensors measure.
        label: estimates the states from the camera's frames; without it, the target's own states are used.
        explorer: the policy that collects the target's data, in place of the one that is tuned (Algorithm 1).
        explain: names the causes of the gap, which are then added to the source. The residual learns the gap only where
            they do not explain it; where there is no gap, the policy gets its weights from before the first round.
            Where other causes explain the data as well, the next round adds to its commands the excitation that tells
            them apart.

    Raises:
        ValueError: an empty round, or a budget that is smaller than a round.
        TargetError: the target misbehaves. BudgetExceeded: a step more than the budget.
        CheckpointError: `folder` holds a run of other networks.
    """
    if round_samples < 1:
        raise ValueError(f"a round needs at least 1 sample, got B = {round_samples}")
    if budget < round_samples:
        raise ValueError(
            f"the budget N = {budget} is smaller than a round of B = {round_samples} samples: raise N or lower B"
        )
    ledger = Ledger(budget)
    learning = JointLearning(
        policy, residual, source, target, settings, ledger, observe, label, report, explorer, explain
    )
    count = math.ceil(budget / round_samples)
    rounds = [learning.round(RoundFolder.of(folder, number, count, seed), round_samples) for number in range(count)]
    return Adapted(policy, ledger, rounds, learning.episodes, folder, learning.known)
