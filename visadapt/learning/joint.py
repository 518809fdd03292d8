"""Joint learning of residual and policy: Algorithm 1 of the paper, round after round.

Each round executes the policy in the target for B counted samples, grounds the residual on all samples so far, and
tunes the policy by backpropagation through the world so grounded (`learning.plans`). What a round does is in
`learning.rounds`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from visadapt.learning.ledger import Ledger
from visadapt.learning.rounds import JointLearning, Round, RoundFolder
from visadapt.policies import Policy
from visadapt.recordings import Episode
from visadapt.storage.checkpoints import load_tree, load_weights
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
    taken_back: str = ""
    """why the policy has the weights again that it began with: the machine showed that the tuned ones do much worse;
    empty where it has the tuned ones"""

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


def adapt(learning: JointLearning, folder: Path, round_samples: int, seed: int) -> Adapted:
    """Run Algorithm 1 in `folder`, going on from what is there.

    Args:
        learning: what learns from what; the budget of its ledger is N, the target samples in all.
        round_samples: B, the target samples in a round.

    Raises:
        ValueError: an empty round, or a budget that is smaller than a round.
        TargetError: the target misbehaves. BudgetExceeded: a step more than the budget.
        CheckpointError: `folder` holds a run of other networks.
    """
    budget = learning.ledger.budget
    if round_samples < 1:
        raise ValueError(f"a round needs at least 1 sample, got B = {round_samples}")
    if budget < round_samples:
        raise ValueError(
            f"the budget N = {budget} is smaller than a round of B = {round_samples} samples: raise N or lower B"
        )
    count = math.ceil(budget / round_samples)
    rounds = [learning.round(RoundFolder.of(folder, number, count, seed), round_samples) for number in range(count)]
    taken_back = learning.take_back()
    return Adapted(learning.policy, learning.ledger, rounds, learning.episodes, folder, learning.known, taken_back)
