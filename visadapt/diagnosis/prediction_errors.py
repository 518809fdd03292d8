"""Prediction errors of the source and of the causes, by horizon and channel, and the gap between them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from visadapt.diagnosis.result import Gap, Noise
from visadapt.diagnosis.search import heldout
from visadapt.systems import System


@dataclass(frozen=True)
class PredictionErrors:
    """Root mean square errors of predictions by horizon and channel (H, m), in units of `deviation`."""

    before: Tensor  # of the source
    after: Tensor  # of the source with the causes
    floor: Tensor  # of the states that the smoother estimates: noise
    black_box: Tensor  # the best that a black box reaches beside the causes
    deviation: Tensor  # (m,) standard deviations of the measurement noise, in the states' units
    period: float  # s between rows
    held_out: bool  # whether the rows that are predicted were not fitted; False where they are too few to hold some out
    several: bool  # whether whole episodes were held out; of a single episode, stretches of it are

    def closed_by(self, rms: Tensor) -> float:
        """Share of the gap that the set with these errors (H, m) closes."""
        return heldout.closed(_last(self.before), _last(rms), _last(self.floor))

    def gap(self) -> Gap:
        """The errors at the longest horizon, over all channels."""
        before, after, floor, box = (_last(e) for e in (self.before, self.after, self.floor, self.black_box))
        held_out = f"held-out {'episodes' if self.several else 'stretches'}"
        measure = (
            f"root mean square error of predictions {float(f'{len(self.before) * self.period:.2g}'):g} s ahead on "
            f"{held_out if self.held_out else 'the rows that were fitted'}, in standard deviations of the "
            "measurement noise"
        )
        return Gap(measure, before, after, floor, box, heldout.closed(before, after, floor))

    def noise(self, system: System, channels: Sequence[int]) -> dict[str, Noise]:
        """The noise of each state that was read."""
        read = [system.states[channel] for channel in channels]
        return {one.name: Noise(value, one.unit) for one, value in zip(read, self.deviation.tolist(), strict=True)}

    def by_state(self, system: System, channels: Sequence[int], explained: bool) -> dict[str, float]:
        """Share by state of the squared error above `after` if the causes explain the gap, else above the noise floor.

        NaN where the state was not measured, 0 where there is no gap: what is above the floor is then chance.
        """
        least = self.after if explained else self.floor
        excess = (self.before[-1].square() - least[-1].square()).clamp(min=0)
        whole = 0.0 if math.isnan(self.gap().closed) else float(excess.sum())
        shares = {variable.name: math.nan for variable in system.states}
        for k, channel in enumerate(channels):
            shares[system.states[channel].name] = float(excess[k]) / whole if whole > 0 else 0.0
        return shares


def _last(errors: Tensor) -> float:
    return float(heldout.overall(errors)[-1])
