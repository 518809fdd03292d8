"""Repeated readings: rows that were lost, and angles at which a sensor stood still.

Because of noise, a sensor in motion hardly gives the same number twice; where it does, the previous reading was
repeated. Such readings do not measure the state: they are excluded from fits, and counted here. An encoder gives the
same number twice where the quantity moves by less than one of its steps: at turning points, and at rest. Equal readings
therefore count as repeated only in runs that readings enter and leave at speed, and only where there are more of them
than the encoder's steps explain. Of a row that was lost all readings are equal, and one that moves at speed shows it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from visadapt.estimation.segments import interpolated, resolutions

MIN_JUMP_STEPS, MIN_OTHER_STEPS = 8, 1.5
"""For a run of equal readings to count as repeated, the larger of the two changes into and out of it must exceed
MIN_JUMP_STEPS steps of the sensor's resolution, and the smaller MIN_OTHER_STEPS: else the quantity may have stood
still."""

MIN_REST_ROWS = 4  # Equal rows at the start of an episode, above which the machine rests

MAX_CHANCE = 1e-3
"""Probability that an encoder's steps give as many equal readings, below which they count as repeated."""

NEAR_STEPS, NEAR_SHARE = 4.0, 0.2
"""Changes up to this many steps, or up to this share of the median change, from which the frequency of changes of less
than one step is estimated."""

LEAST_FROZEN = 0.5  # Share of the angles in the zone where a sensor stands still that are read as the one before

ZONE_EDGE_POINTS = 120  # Angles tried for either edge of the zone in which the angle sensor stands still

SMOOTHING_RATIO = 1 / 3  # Assumed standard deviation of a smoothed angle over that of a measured one


@dataclass(frozen=True)
class RepeatedReadings:
    """Which readings are repeated, by episode."""

    used: list[Tensor]  # (T, m) 1 where a reading is a measurement
    lost: list[Tensor]  # (T,) whether the whole row is repeated
    seen: list[Tensor]  # (T,) whether the row and the one before may be used, so that its loss would be seen
    frozen: list[Tensor]  # (T,) whether the angle is repeated and the rest of the row is not
    silent: list[Tensor]  # (T,) whether a row tells nothing of the angles at which the sensor stands still


def find_repeats(
    measured: Sequence[Tensor],
    channels: tuple[int, ...],
    angle_sensor: Sequence[int],
    usable: Sequence[Tensor] | None = None,
) -> RepeatedReadings:
    """Find repeated readings in episodes (T, m) of these columns of the state.

    Args:
        angle_sensor: the columns of the angle, which may stand still on its own, and of its rate; empty without one.
        usable: (T, m) of each episode, above 0 where there is a reading; None: everywhere.
    """
    changes = torch.cat([values.diff(dim=0) for values in measured])
    usable = usable or [torch.ones_like(values) for values in measured]
    steps = resolutions(measured, usable)
    by_chance = [_equal_by_chance(changes[:, k], step) for k, step in enumerate(steps)]
    of_angle = torch.tensor([c in angle_sensor for c in channels], dtype=torch.bool)
    angle = channels.index(angle_sensor[0]) if angle_sensor and angle_sensor[0] in channels else None
    both = [read_twice(read) for read in usable]
    same = [
        torch.stack([_repeats(values[:, k], steps[k]) for k in range(len(channels))], 1) & twice
        for values, twice in zip(measured, both, strict=True)
    ]
    resting = [_resting(values, torch.tensor(steps).to(values)) for values in measured]
    whole_rows = [
        ~(~_equal(values) & (read > 0)).any(1) & each.any(1) & ~rest & _after_a_change(values, twice)
        for values, read, twice, each, rest in zip(measured, usable, both, same, resting, strict=True)
    ]
    lost = _unless_by_chance(whole_rows, min(by_chance))
    # A rate from a separate sensor may go on while the angle stands still.
    frozen = missed = [torch.zeros_like(whole) for whole in lost]
    if angle is not None:
        alone = [each[:, angle] & ~whole & ~rest for each, whole, rest in zip(same, whole_rows, resting, strict=True)]
        frozen = _unless_by_chance(alone, by_chance[angle])
        if any(bool(still.any()) for still in frozen):
            # What a sensor slower than the rows might have shown in a row is unknown.
            unknown = [row & ~twice.all(1) for row, twice in zip(lost, both, strict=True)]
            frozen = [still | row for still, row in zip(frozen, unknown, strict=True)]
            lost = [row & ~other for row, other in zip(lost, unknown, strict=True)]
        if not _lie_in_a_zone([values[:, angle] for values in measured], frozen):
            frozen, missed = missed, frozen
    used = []
    doubtful = frozen if angle is None else _between_held([values[:, angle] for values in measured], frozen)
    for whole, still, apart in zip(lost, doubtful, missed, strict=True):
        partial = of_angle & (still | apart)[:, None]
        # The first reading after a standstill may still be mixed with the repeated value.
        waking = torch.zeros_like(partial)
        waking[1:] = partial[:-1] & ~partial[1:]
        used.append(1.0 - (whole[:, None] | partial | waking).double())
    silent = [whole | (still & ~sure) for whole, still, sure in zip(lost, doubtful, frozen, strict=True)]
    seen = [torch.ones_like(whole) for whole in lost]
    return RepeatedReadings(used, lost, seen, frozen, silent)


def _lie_in_a_zone(angles: Sequence[Tensor], frozen: Sequence[Tensor]) -> bool:
    """Whether most of the angles (T,) of episodes between those that the readings around the `frozen` ones show are
    frozen too; else the sensor misses readings, whatever the angle is."""
    held = torch.cat([*frozen])
    if not bool(held.any()):
        return False
    true = [
        interpolated(angle[:, None], (~still).double()[:, None], torch.arange(len(angle)).double())[:, 0]
        for angle, still in zip(angles, frozen, strict=True)
    ]
    angle = torch.cat(true)
    # Whole turns apart or not.
    centre = torch.atan2(angle[held].sin().mean(), angle[held].cos().mean())
    angle = torch.atan2((angle - centre).sin(), (angle - centre).cos())
    low, high = angle[held].quantile(torch.tensor([0.05, 0.95]).to(angle))
    return float(held[(angle >= low) & (angle <= high)].double().mean()) > LEAST_FROZEN


def _between_held(angles: Sequence[Tensor], frozen: Sequence[Tensor]) -> list[Tensor]:
    """Which readings (T,) of episodes equal the one before and lie within the range of those that are `frozen`.

    Where the sensor stands still, runs of equal readings that a slow motion enters or leaves are repeated as well.
    """
    held = torch.cat([angle[still] for angle, still in zip(angles, frozen, strict=True)])
    if not len(held):
        return list(frozen)
    low, high = held.min(), held.max()
    return [_equal(angle) & (angle >= low) & (angle <= high) for angle in angles]


def _equal(values: Tensor) -> Tensor:
    """Which values (T, ...) equal those of the row before."""
    return torch.cat((torch.zeros_like(values[:1], dtype=torch.bool), values.diff(dim=0) == 0))


def read_twice(usable: Tensor) -> Tensor:
    """Which of the `usable` (T, m) readings, those above 0, follow one of the row before, which they may repeat."""
    read = usable > 0
    return torch.cat((torch.zeros_like(read[:1]), read[1:] & read[:-1]))


def _after_a_change(values: Tensor, twice: Tensor) -> Tensor:
    """Which rows (T,) follow a change of what was read in them and in the row before; where everything was, all do."""
    changed = (~_equal(values) & twice).any(1).cumsum(0) > 0
    return changed | twice.all(1)


def _resting(values: Tensor, steps: Tensor) -> Tensor:
    """Which rows (T, m) repeat the first one of an episode because the machine rests: they are too many to have been
    lost, or a sensor, of resolutions `steps` (m,), leaves them slowly."""
    still = (values == values[:1]).all(1).cumprod(0) > 0
    count = int(still.sum())
    change = (values[count : count + 1] - values[:1]).abs()
    slowly = (change > 0) & (change <= MIN_JUMP_STEPS * steps)
    return still if count > MIN_REST_ROWS or slowly.any() else torch.zeros_like(still)


def _repeats(readings: Tensor, step: float) -> Tensor:
    """(T,) rows that repeat the row before, in runs that readings of resolution `step` enter and leave at speed.

    A run from the first row on has no change that enters it, one up to the last row none that leaves it.
    """
    change = readings.diff(prepend=readings[:1])
    same = change == 0
    same[0] = False
    # Rows of a run share a number; the jump into a run is the change at its first row, the jump out that of the next.
    run = (~same).cumsum(0) - 1
    change[0] = torch.inf
    jumps = torch.cat((change[~same].abs(), readings.new_full((1,), torch.inf)))
    smaller, larger = torch.minimum(jumps[run], jumps[run + 1]), torch.maximum(jumps[run], jumps[run + 1])
    return same & (larger > MIN_JUMP_STEPS * step) & (smaller > MIN_OTHER_STEPS * step)


def _equal_by_chance(change: Tensor, step: float) -> float:
    """Expected number of the changes (N,) of a moving quantity that a resolution of `step` rounds to 0."""
    size = change[change != 0].abs()
    if not len(size) or step == 0:
        return 0.0
    near = max(NEAR_STEPS * step, NEAR_SHARE * float(size.median()))
    return float((size <= near * (1 + 1e-6)).sum()) * step / (2 * near)


def _unless_by_chance(equal: list[Tensor], expected: float) -> list[Tensor]:
    """The marks (T,) of each episode; all False if chance may explain their number: if, with `expected` marks on
    average (Poisson), at least as many occur with a probability above MAX_CHANCE."""
    count = sum(int(marks.sum()) for marks in equal)
    # Probability of at least `count`: the regularised lower incomplete gamma function.
    explained = (
        count == 0 or float(torch.special.gammainc(torch.tensor(float(count)), torch.tensor(expected))) > MAX_CHANCE
    )
    return [torch.zeros_like(marks) for marks in equal] if explained else equal


def zone(repeated: Tensor, angle: Tensor, deviation: float) -> tuple[Tensor, Tensor]:
    """Start and end (2,) in rad of the zone of angles in which a sensor stands still, and their standard deviations.

    Given whether each of N readings is `repeated`, and their estimated angles, whole turns apart or not, with a normal
    error of `deviation` rad. Posterior mean over a grid of both edges, with a uniform prior; then over a finer grid
    around it.
    """
    # Within half a turn of the zone's middle, which may be where the pole hangs.
    inside = angle[repeated]
    centre = torch.atan2(inside.sin().mean(), inside.cos().mean())
    centre = centre + 2 * math.pi * ((inside.median() - centre) / (2 * math.pi)).round()
    angle = centre + torch.atan2((angle - centre).sin(), (angle - centre).cos())
    inside = angle[repeated]
    # An edge may lie anywhere between the last angle with a repeated reading and the next without.
    least, most, middle = inside.min(), inside.max(), float(inside.median())
    lower, higher = angle[~repeated & (angle < least)], angle[~repeated & (angle > most)]
    first, last = lower.max() if len(lower) else least, higher.min() if len(higher) else most
    low = torch.linspace(float(first) - 3 * deviation, middle, ZONE_EDGE_POINTS, dtype=angle.dtype)
    high = torch.linspace(middle, float(last) + 3 * deviation, ZONE_EDGE_POINTS, dtype=angle.dtype)
    edges, spread = _zone_on((low, high), repeated, angle, deviation)
    wide = [torch.maximum(2 * grid.diff()[0], 4 * error) for grid, error in zip((low, high), spread, strict=True)]
    finer = [
        edge + width * torch.linspace(-1, 1, ZONE_EDGE_POINTS).to(edge) for edge, width in zip(edges, wide, strict=True)
    ]
    return _zone_on(finer, repeated, angle, deviation)


def _zone_on(grids: Sequence[Tensor], repeated: Tensor, angle: Tensor, deviation: float) -> tuple[Tensor, Tensor]:
    """The same over given values of start and end."""
    low, high = grids
    below = torch.special.ndtr((low[:, None] - angle) / deviation)
    above = torch.special.ndtr((angle - high[:, None]) / deviation)
    chance = (1 - below[:, None] - above[None]).clamp(1e-6, 1 - 1e-6)
    score = torch.where(repeated, chance.log(), (1 - chance).log()).sum(-1)
    weight = (score - score.max()).exp()
    weight = weight / weight.sum()
    start, end = (weight.sum(1) * low).sum(), (weight.sum(0) * high).sum()
    spread = (weight.sum(1) * (low - start).square()).sum(), (weight.sum(0) * (high - end).square()).sum()
    return torch.stack((start, end)), torch.stack(spread).sqrt()
