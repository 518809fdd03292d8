"""Maximum likelihood of the parameters of given effects, from whole episodes whose states are known with noise.

What a diagnosis computes for one set of effects, without its search. Dropout and frozen_zone are not in the likelihood:
they are estimated from repeated readings, which the fit leaves out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import torch
from torch import Tensor

from visadapt.effects import Dropout, Effect, FrozenZone, LateSensors, Role, SensingEffect, Stage
from visadapt.effects.catalogue import sized, twins
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.covariance import inverse_information
from visadapt.estimation.episode_phases import (
    has_episode_phases,
    with_common_phase,
    with_episode_phases,
    with_own_phases,
)
from visadapt.estimation.fit_states import (
    CAREFUL,
    QUICK,
    Effects,
    initial_fit,
    neutral,
    single_fit,
    stacked,
    widths,
    with_effect,
)
from visadapt.estimation.fitting import fit
from visadapt.estimation.likelihood import FitState
from visadapt.estimation.profiles import profile_of
from visadapt.estimation.repeated_readings import SMOOTHING_RATIO, RepeatedReadings, find_repeats, zone
from visadapt.estimation.screening import screen
from visadapt.estimation.segments import Segments, cut
from visadapt.systems import System

ALIKE = 1.0  # Log likelihood within which fits count as equally good


@dataclass(frozen=True)
class EffectFit:
    """Effects fitted to episodes."""

    values: dict[type[Effect], Tensor]
    """(P,) parameters of each effect, `sized` to the system, in the order of its table; a phase is that of the first
    episode"""
    covariance: dict[type[Effect], Tensor]  # (P, P) of each effect's parameters
    states: list[Tensor]  # (T, n_state) of each episode: the true states, smoothed
    shifts: Tensor
    """(E,) s to add to an episode's times so that the first one's phase holds there"""


@torch.no_grad()
def fit_effects(
    system: System, effects: Sequence[Effect], measured: Sequence[Tensor], commands: Sequence[Tensor], period: float
) -> EffectFit:
    """Fit the parameters of `effects`, all together, within the ranges that they state for this system.

    Phases are fitted for each episode: a disturbance need not begin with it.

    Args:
        system: the source.
        effects: at most one of each class; their present values are one of two starting points.
        measured: (T, n_state) of each episode, what sensors read.
        commands: (T, n_action) of each episode.
        period: s between rows.

    Raises:
        ValueError: an effect cannot be fitted or is given twice, or passive data cannot tell two apart.
    """
    kinds = [with_episode_phases(sized(type(effect), system), len(measured)) for effect in effects]
    check_fittable(kinds, system)
    fitted = tuple(kind for kind in kinds if not kind.repeats_readings)
    ends = accumulate(len(kind.table) for kind in fitted)
    columns = {kind: slice(end - len(kind.table), end) for kind, end in zip(fitted, ends, strict=True)}
    measured = [values.double() for values in measured]
    commands = [values.double() for values in commands]
    profile = profile_of(system)
    channels = tuple(range(len(system.states)))
    repeats = find_repeats(measured, channels, profile.angle_sensor)
    stamps = [period * torch.arange(len(values)).double() for values in measured]
    rows = cut(measured, repeats.used, commands, stamps, channels, period, profile.window_rows)
    present = [
        value
        for effect, kind in zip(effects, kinds, strict=True)
        if kind in fitted
        for value in with_own_phases(kind, [float(getattr(effect, p.name)) for p in with_common_phase(kind).table])
    ]
    found = _fitted(system, fitted, rows, present)
    covariance = inverse_information(fitted, found) if fitted else torch.zeros(0, 0)
    states = _by_episode(rows, found.state[0], measured)
    values, spreads = {}, {}
    for kind, span in columns.items():
        plain = with_common_phase(kind)
        stated = slice(span.start, span.start + len(plain.table))
        values[plain] = _within_a_turn(plain, found.theta[0, stated])
        spreads[plain] = covariance[stated, stated]
    if Dropout in kinds:
        values[Dropout], spreads[Dropout] = _lost(repeats)
    if FrozenZone in kinds:
        values[FrozenZone], spreads[FrozenZone] = _frozen(repeats, states, found, profile.angle_sensor[0])
    return EffectFit(values, spreads, states, _shifts(fitted, columns, found.theta[0], len(measured)))


def remembers(effect: type[Effect], system: System) -> bool:
    """Whether it is a sensing effect whose reading depends on earlier rows in another way than by being late or by
    repeating them."""
    if not issubclass(effect, SensingEffect) or issubclass(effect, LateSensors) or effect.repeats_readings:
        return False
    without_effect = effect(**dict.fromkeys((p.name for p in effect.table), 0.0))
    return without_effect.memory(torch.zeros(1, len(system.states)), 1.0).numel() > 0


def check_fittable(kinds: Sequence[type[Effect]], system: System) -> None:
    """Raise ValueError, which names it, for an effect that cannot be fitted, is given twice, or that passive data of
    the system cannot tell from another."""
    for index, kind in enumerate(kinds):
        if remembers(kind, system):
            raise ValueError(f"{kind.name} cannot be fitted: what it measures depends on earlier rows")
        if kind.stage is Stage.CAMERA:
            raise ValueError(f"{kind.name} cannot be fitted to states: only frames show it")
        others = [*kinds[:index], *kinds[index + 1 :]]
        if kind in others:
            raise ValueError(f"{kind.name} is given more than once: leave all but one out")
        for twin in twins(kind, others, system):
            raise ValueError(f"passive data cannot tell apart {kind.name} and {twin.name}: leave one of them out")


def _fitted(system: System, effects: Effects, rows: Segments, present: Sequence[float]) -> FitState:
    """The likeliest fit from two starts: `present`, which stays where the data do not show an effect; and effects added
    one by one, the most promising first."""
    chosen: Effects = ()
    base = initial_fit(system, rows)
    for _ in effects:
        base = _best(system, chosen, [base], rows, QUICK)
        rest = [effect for effect in effects if effect not in chosen]
        leads = screen(system, chosen, base, rows, rest)
        effect, values = (leads[0].effect, leads[0].values) if leads else (rest[0], neutral(rest[0]))
        chosen, base = (*chosen, effect), with_effect(base, values)
    column = {p: k for k, p in enumerate((effect, p.name) for effect in chosen for p in effect.table)}
    order = [column[effect, p.name] for effect in effects for p in effect.table]
    starts = [replace(base, theta=base.theta[:, order])]
    if list(present) != [value for effect in effects for value in neutral(effect)]:
        starts.insert(0, replace(base, theta=torch.tensor([list(present)], dtype=torch.float64)))
    if effects:
        # With process noise a fit may end where noise explains what an effect would.
        starts += [_best(system, effects, starts, rows, QUICK, process_noise=False)]
    return _best(system, effects, starts, rows, CAREFUL)


def _best(
    system: System,
    effects: Effects,
    starts: Sequence[FitState],
    rows: Segments,
    effort: tuple[int, int],
    process_noise: bool = True,
) -> FitState:
    """The likeliest fit of one set of effects from several starts; of fits that are `ALIKE`, that from the first."""
    iterations, care = effort
    models = [CandidateModel(system, effects, rows, care) for _ in starts]
    out = fit(models, stacked(starts), iterations, process_noise)
    likelihood = out.likelihood.nan_to_num(-math.inf)
    first = int((likelihood >= likelihood.max() - ALIKE).int().argmax())
    return single_fit(out, first, len(models[0].table))


def _within_a_turn(effect: type[Effect], values: Tensor) -> Tensor:
    """The parameters (P,) with phases between -pi and pi: during a fit they may go further."""
    turns = torch.tensor([float(p.role is Role.PHASE) for p in effect.table]) * (values / (2 * math.pi)).round()
    return values - 2 * math.pi * turns


def _shifts(effects: Effects, columns: Mapping[type[Effect], slice], theta: Tensor, episodes: int) -> Tensor:
    """(E,) s by which each episode's phase is ahead of the first's; zeros unless one effect alone depends on time."""
    timed = [
        effect
        for effect in effects
        if any(p.role is Role.FREQUENCY or (p.is_edge and p.unit == "s") for p in effect.table)
    ]
    if len(timed) != 1 or not has_episode_phases(timed[0]):
        return theta.new_zeros(episodes)
    pairs = list(zip(timed[0].table, theta[columns[timed[0]]].tolist(), strict=True))
    frequency = next(value for p, value in pairs if p.role is Role.FREQUENCY)
    phases = theta.new_tensor([value for p, value in pairs if p.is_phase])
    return (phases - phases[0]).remainder(2 * math.pi) / (2 * math.pi * frequency)


def _by_episode(rows: Segments, state: Tensor, measured: Sequence[Tensor]) -> list[Tensor]:
    """States (W, T, n) of windows, which cover the episodes, put together: (T, n) of each episode."""
    out = [torch.empty_like(values) for values in measured]
    lengths = rows.inside.sum(1).long().tolist()
    for window, (episode, first) in enumerate(zip(rows.episode.tolist(), rows.first.tolist(), strict=True)):
        out[episode][first : first + lengths[window]] = state[window, : lengths[window]]
    return out


def _lost(repeats: RepeatedReadings) -> tuple[Tensor, Tensor]:
    """The rate at which rows are lost, (1,), and its posterior variance, (1, 1), under a uniform prior."""
    lost, rows = sum(int(x.sum()) for x in repeats.lost), sum(len(x) - 1 for x in repeats.lost)
    variance = (lost + 1) * (rows - lost + 1) / ((rows + 2) ** 2 * (rows + 3))
    return torch.tensor([lost / max(1, rows)]).double(), torch.tensor([[variance]]).double()


def _frozen(repeats: RepeatedReadings, states: Sequence[Tensor], found: FitState, angle: int) -> tuple[Tensor, Tensor]:
    """Start and end (2,) of the angles at which the sensor stands still, and their covariance (2, 2)."""
    # A first reading has none before it to repeat.
    seen = torch.cat([~silent[1:] for silent in repeats.silent])
    held = torch.cat([frozen[1:] for frozen in repeats.frozen])[seen]
    if not bool(held.any()):
        variance = widths((FrozenZone,)).square() / 12  # of a uniform distribution
        return torch.tensor(neutral(FrozenZone), dtype=torch.float64), torch.diag(variance)
    noise = SMOOTHING_RATIO * float((found.log_noise[0, angle] / 2).exp())
    edges, deviations = zone(held, torch.cat([state[1:, angle] for state in states])[seen], noise)
    return edges, torch.diag(deviations.square())
