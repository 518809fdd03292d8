"""Domain randomisation: the source policy trained under draws from the whole range of the hidden kind of effect.

It is told the kind, takes no sample of the target, and always sees 5 states and actions: from one state no policy could
tell which draw it is in.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import torch

from benchmarks.baselines.cartpole import CartPoleProblem
from benchmarks.baselines.problem import Sizes, Stage, drawn, unadapted
from visadapt.learning.training_state import train_or_load
from visadapt.learning.tuning import tune
from visadapt.setups.cartpole import cartpole_states
from visadapt.tasks.base import EPISODE_STEPS

DRAWS = EPISODE_STEPS
"""draws of the effect, one for each stream; as many as an episode has steps, since `Streams` tests whether the world
depends on time with a batch of all times of an episode, and the effect's values are for batches of one size"""


def stages(problem: CartPoleProblem, sizes: Sizes, folder: Path, seed: int) -> Iterator[Stage]:
    """One policy, trained as the source policy of ours is, with a draw of the effect in each stream."""
    setup = cartpole_states(with_history=True)
    effect = drawn(problem.kind, DRAWS, torch.Generator().manual_seed(seed))
    settings = setup.settings.shortened(sizes.iterations)
    assert settings.refinement is not None
    # No visited states are kept to draw batches from: row k of a batch must be stream k, which has its own draw of the
    # effect.
    refinement = replace(settings.refinement, batch=DRAWS, streams=None, every=1)
    world = setup.source.with_effects([effect])
    torch.manual_seed(seed)
    policy = setup.policy()
    for number, how in enumerate((replace(settings.source, batch=DRAWS), refinement)):
        args = (policy, world, None, how, torch.Generator().manual_seed(seed + number), None, None)
        train_or_load(
            folder / f"policy-{number}.safetensors", policy, {"seed": seed, **asdict(how)}, partial(tune, *args)
        )
    policy.eval()
    yield from unadapted(problem, lambda: policy)
