"""A recording made ready to be fitted: tensors, with held readings set aside, and not more rows than can be searched."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from visadapt.diagnosis.data import Rows, cut
from visadapt.diagnosis.holds import Holds, find_holds
from visadapt.recordings import Recording
from visadapt.systems import System

MOST_ROWS = 1600
"""Rows that a search uses; of more, windows spread evenly over the recording are taken."""


@dataclass(frozen=True)
class Readings:
    """What is fitted."""

    rows: Rows
    """held readings are not used"""
    raw: Rows
    """the same windows with held readings as they were read"""
    holds: Holds
    warnings: tuple[str, ...]

    @classmethod
    def of(cls, recording: Recording, system: System) -> Readings:
        """From a recording of the states, or some of them, and the commands of a system with one action."""
        channels = tuple(system.index(name) for name in recording.measured)
        measured = [torch.tensor(np.asarray(e.state, dtype=np.float64)) for e in recording.episodes]
        commands = [torch.tensor(np.asarray(e.action, dtype=np.float64))[:, 0] for e in recording.episodes]
        holds = find_holds(measured, channels)
        rows = cut(measured, holds.used, commands, channels, recording.period)
        raw = cut(measured, [torch.ones_like(m) for m in measured], commands, channels, recording.period)
        windows, length = rows.shape
        most = max(4, MOST_ROWS // length)
        if windows <= most:
            return cls(rows, raw, holds, ())
        chosen = torch.linspace(0, windows - 1, most).round().long()
        note = f"of {windows} windows of up to {length} rows, {most}, spread evenly over the recording, were used"
        return cls(rows.of(chosen), raw.of(chosen), holds, (note,))
