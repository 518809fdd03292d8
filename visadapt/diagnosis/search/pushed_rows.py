"""Rows within pushes: they are set aside where pushes hide what else acts, and must depart from what is predicted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from visadapt.diagnosis.result import Push
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.kalman import forward
from visadapt.estimation.likelihood import FitState, linear_problem, variances
from visadapt.estimation.segments import Segments, stretches_without
from visadapt.recordings import Recording
from visadapt.systems import System

MARGIN = 0.1  # Prediction times before and after a push that are set aside with it: its ends are not known exactly

WITHIN_NOISE = 0.01
"""Probability of innovations as large as those during a push, above which the noise alone gives them."""


def depart_from(model: CandidateModel, fits: FitState, pushes: Sequence[Push]) -> tuple[Push, ...]:
    """The pushes in whose rows the readings depart from what a fitted set predicts, by more than its noise.

    Loads are found in accelerations over several rows. Where a joint turns fast, these are not exact, and a load may
    seem to act although every row is as predicted.
    """
    if not pushes:
        return ()
    problem = linear_problem([model], fits).data()
    used = model.shown(fits.theta[0])[1]
    squared = forward(problem, *variances(model, fits, problem)).white[..., 0].square() * used
    return tuple(push for push in pushes if not _is_as_predicted(model.rows, squared, used, push))


def _is_as_predicted(rows: Segments, squared: Tensor, used: Tensor, push: Push) -> bool:
    """Whether innovations (W, T, m), squared and over their variance, are those of noise during a push; not where none
    of the readings is `used` (W, T, m)."""
    during = (rows.episode == push.episode)[:, None] & (rows.inside > 0)
    during &= (rows.time >= push.start) & (rows.time <= push.end + rows.period)
    count = used[during].sum()
    return bool(count) and bool(torch.special.gammaincc(count / 2, squared[during].sum() / 2) >= WITHIN_NOISE)


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
