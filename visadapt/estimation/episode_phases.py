"""A phase for each episode: that of a periodic effect which keeps running while episodes begin at any time.

Such an effect is fitted as a class with more parameters: `phase` is that of the first episode, `phase_2`, `phase_3` and
so on are those of the others. A `CandidateModel` gives every row the phase of its own episode.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from visadapt.effects import Effect, Role
from visadapt.effects.base import with_table


def with_episode_phases(effect: type[Effect], episodes: int) -> type[Effect]:
    """The effect with a phase for each episode; itself where it has no phase, or there is one episode.

    >>> import visadapt as va
    >>> [p.name for p in with_episode_phases(va.effects.PeriodicForce, 3).table]
    ['amplitude', 'frequency', 'phase', 'offset', 'phase_2', 'phase_3']
    """
    phase = next((p for p in effect.table if p.role is Role.PHASE), None)
    if phase is None or episodes < 2:
        return effect
    names = [f"{phase.name}_{number}" for number in range(2, episodes + 1)]
    others = [replace(phase, name=name, role=Role.EPISODE_PHASE) for name in names]
    return with_table(effect.name, (*effect.table, *others))


def with_common_phase(effect: type[Effect]) -> type[Effect]:
    """The same effect with one phase for all episodes."""
    if not has_episode_phases(effect):
        return effect
    return with_table(effect.name, tuple(p for p in effect.table if p.role is not Role.EPISODE_PHASE))


def with_own_phases(effect: type[Effect], values: Sequence[float]) -> tuple[float, ...]:
    """All parameters of an effect, from those that it has `with_common_phase`: later episodes get the first's phase."""
    phases = [v for p, v in zip(with_common_phase(effect).table, values, strict=True) if p.role is Role.PHASE]
    return (*values, *phases * (len(effect.table) - len(values)))


def in_episode(effect: type[Effect], values: Sequence[float], episode: int) -> Effect:
    """The effect with these parameter values as it acts in an episode, counted from 0.

    >>> import visadapt as va
    >>> kind = with_episode_phases(va.effects.PeriodicForce, 2)
    >>> round(in_episode(kind, (2.0, 0.5, 0.1, 0.0, 0.7), 1).phase.item(), 6)
    0.7
    """
    given = dict(zip((p.name for p in effect.table), values, strict=True))
    phases = [p.name for p in effect.table if p.is_phase]
    plain = with_common_phase(effect)
    own = {phases[0]: given[phases[episode]]} if has_episode_phases(effect) else {}
    return plain(**{p.name: given[p.name] for p in plain.table} | own)


def has_episode_phases(effect: type[Effect]) -> bool:
    """Whether the effect has a phase for each episode."""
    return any(p.role is Role.EPISODE_PHASE for p in effect.table)


def phase_columns(effects: Sequence[type[Effect]], episodes: int) -> Tensor | None:
    """(E, P) the column of the parameters from which each parameter of an episode is read; None where no effect
    has a phase for each episode, and all episodes read the same columns."""
    if not any(has_episode_phases(effect) for effect in effects):
        return None
    roles = [p.role for effect in effects for p in effect.table]
    out = torch.arange(len(roles)).repeat(episodes, 1)
    first = 0
    for effect in effects:
        columns = range(first, first + len(effect.table))
        first = columns.stop
        if has_episode_phases(effect):
            phase = next(k for k in columns if roles[k] is Role.PHASE)
            out[1:, phase] = torch.tensor([k for k in columns if roles[k] is Role.EPISODE_PHASE])
    return out
