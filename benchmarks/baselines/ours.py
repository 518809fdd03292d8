"""Ours: the source policy adapted by the joint loop, with the paper's residual or with what a diagnosis names."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from pathlib import Path

from benchmarks.baselines.cartpole import CartPoleProblem, source_policy
from benchmarks.baselines.problem import Sizes, Stage, unadapted


def stages(problem: CartPoleProblem, sizes: Sizes, folder: Path, seed: int, diagnose: bool = False) -> Iterator[Stage]:
    """The source policy, and adapted as in `benchmarks.cartpole_states`.

    With `diagnose` each number of samples is one round, since a diagnosis takes the longer the more rounds there are.
    """
    source = source_policy(problem, sizes, folder.parents[2], seed)
    yield from unadapted(problem, lambda: source)
    plans = [(samples, samples) for samples in sizes.scored] if diagnose else sizes.plans
    for budget, round_samples in plans:
        policy = copy.deepcopy(source)
        at, own = folder / f"budget-{budget}", problem.setup(sizes)
        adapted = own.adapt(policy, problem.target(), at, budget, round_samples, seed, diagnose=diagnose)
        for samples in [each.samples for each in adapted.rounds if each.samples in sizes.scored]:
            adapted.restore(policy, samples)
            yield Stage("adapted", samples, policy)
