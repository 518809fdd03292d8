"""Rows within pushes, which are set aside where pushes hide what else acts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from visadapt.diagnosis.result import Push
from visadapt.estimation.segments import stretches_without
from visadapt.recordings import Recording
from visadapt.systems import System

MARGIN = 0.1  # Prediction times before and after a push that are set aside with it: its ends are not known exactly


def share_left_out(pushes: Sequence[Push], recording: Recording, system: System) -> float:
    """Share of a recording's rows that are left out: those within pushes, or close to one, and the few between two."""
    stamps = [torch.tensor(np.asarray(episode.time)) for episode in recording.episodes]
    whole = [(k, 0, len(each)) for k, each in enumerate(stamps)]
    kept = stretches_without(pushed_rows(pushes, stamps, system), whole)
    return 1 - sum(end - begin for _, begin, end in kept) / sum(end for _, _, end in whole)


def pushed_rows(pushes: Sequence[Push], stamps: Sequence[Tensor], system: System) -> list[Tensor]:
    """(T,) for each episode with stamps (T,), in s: whether a row is within a push, or close to one."""
    out = [torch.zeros(len(each), dtype=torch.bool) for each in stamps]
    margin = MARGIN * system.prediction_time
    for push in pushes:
        time = stamps[push.episode]
        out[push.episode] |= (time >= push.start - margin) & (time <= push.end + margin)
    return out
