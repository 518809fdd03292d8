"""The excitations of which an experiment may consist: square waves, sines, binary sequences and noise."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from visadapt.recordings import Recording
from visadapt.systems import System

CYCLES = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6)  # In a prediction time, of square waves and sines
BIT_ROWS = (1, 2, 4, 8)  # Rows of a bit of a pseudo-random binary sequence


def operating_point(recording: Recording, system: System) -> Tensor:
    """(n_action,) commands about which a machine without a policy is excited: 0 or, where that is not inside a
    command's range, the mean of those recorded."""
    mean = np.concatenate([episode.action for episode in recording.episodes]).mean(0)
    inside = np.array([action.low < 0 < action.high for action in system.actions])
    return torch.from_numpy(np.where(inside, 0.0, mean)).double()


def excitations(system: System, period: float, samples: int, generator: torch.Generator) -> tuple[list[str], Tensor]:
    """Excitations of one command each, in words, and their values (N, samples, n_action) for a size of 1 (`SIZES`)."""
    time = period * torch.arange(samples, dtype=torch.float64)
    names, shapes = [], []
    for k, action in enumerate(system.actions):
        where = f" on {action.name}" if len(system.actions) > 1 else ""
        frequencies = [cycles / system.prediction_time for cycles in CYCLES]
        phases = {f: 2 * math.pi * f * time for f in frequencies if f * period < 0.25}
        signals = {
            f"a square wave of {f:g} Hz{where}": torch.where(phase.sin() >= 0, 1.0, -1.0) for f, phase in phases.items()
        }
        signals |= {f"a sine of {f:g} Hz{where}": phase.sin() for f, phase in phases.items()}
        for rows in BIT_ROWS:
            coin = torch.randint(2, (math.ceil(samples / rows),), generator=generator).to(time)
            held = coin.repeat_interleave(rows)[:samples]
            signals[f"a pseudo-random binary sequence with bits of {rows * period:.3g} s{where}"] = 2 * held - 1
        signals[f"white noise{where}"] = torch.randn(samples, generator=generator, dtype=torch.float64)
        for name, values in signals.items():
            shape = torch.zeros(samples, len(system.actions), dtype=torch.float64)
            shape[:, k] = values * (action.high - action.low) / 2
            names.append(name)
            shapes.append(shape)
    return names, torch.stack(shapes)
