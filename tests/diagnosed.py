"""Recordings for tests of the diagnosis: a cart-pole under feedback and random steps, by the library's own world."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from visadapt.effects import Effect
from visadapt.recordings import Episode, Recording
from visadapt.systems import CartPole
from visadapt.world import World

GAINS = torch.tensor([0.08, 0.12, 1.3, 0.3], dtype=torch.float64)
NOISE = (0.002, 0.01, 0.002, 0.01)


def record(
    effects: Sequence[Effect] = (),
    episodes: int = 4,
    rows: int = 60,
    seed: int = 0,
    measured: Sequence[str] = ("x", "theta"),
    noise: Sequence[float] = NOISE,
    system: CartPole | None = None,
) -> Recording:
    """Episodes of a world with effects, at 0.05 s, integrated with 10 substeps."""
    system = system or CartPole()
    generator = torch.Generator().manual_seed(seed)
    world = World(system, [effect.double() for effect in effects], substeps=10)
    columns = [system.index(name) for name in measured]
    spread = torch.tensor([0.1, 0.1, 0.05, 0.1], dtype=torch.float64)
    with torch.no_grad():
        at = world.start(spread * torch.randn(episodes, 4, generator=generator, dtype=torch.float64))
        push = torch.zeros(episodes, 1, dtype=torch.float64)
        states, actions = [], []
        for row in range(rows):
            if row % 8 == 0:
                push = 0.15 * torch.randn(episodes, 1, generator=generator, dtype=torch.float64)
            seen, at = world.measure(at, generator)
            states.append(seen)
            action = ((at.state * GAINS).sum(1, keepdim=True) + push).clamp(-1, 1)
            actions.append(action)
            at = world.step(at, action)
    clean = torch.stack(states, 1)[..., columns]
    state = clean + torch.tensor(noise)[columns] * torch.randn(clean.shape, generator=generator, dtype=torch.float64)
    commands = torch.stack(actions, 1).numpy()
    time = 0.05 * np.arange(rows)
    return Recording(
        tuple(Episode(time, commands[k], state[k].numpy()) for k in range(episodes)),
        tuple(measured),
        0.05,
        tuple(f"episode {k}" for k in range(episodes)),
    )
