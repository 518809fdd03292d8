"""Recordings that begin while motors still act on commands from before: those of a part of a longer run.

What a delay, a lag or play makes of the first commands depends on those before, which no row has; they count as 0.
Where those were not 0, the first rows contradict the others, and a gust or a push seems to act beside such an effect.
So these rows are left out where fewer parameters explain the others, and would explain the first rows too, had another
command been given before.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from visadapt.diagnosis.search.fitted_models import FittedModels, ScoredModel, less
from visadapt.diagnosis.search.search import Search
from visadapt.diagnosis.words import listed, number, plain
from visadapt.effects.actuation import follows_late
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.fit_states import CAREFUL
from visadapt.estimation.likelihood import differentiate
from visadapt.estimation.segments import Segments
from visadapt.recordings import Recording

FORGOTTEN = 0.005  # Share of a command's range, up to which what acts may still depend on earlier commands

LONG = 1e4  # s for which a command is held before the recording, so that every motor follows it

CONTRADICTS = 10.0
"""Log likelihood by which parameters that fit the later rows must be less likely on all rows, for the first rows to
contradict them."""

MOST_LEFT_OUT = 0.6  # Share of an episode's rows

TRIED = (21, 5, 5, 5, 5, 5)
"""How many commands before each episode are tried, over its range and then between those next to the best: of play that
is narrower than the range, most do the same."""


def without_rows_on_earlier_commands(
    recording: Recording, search: Search, best: ScoredModel
) -> tuple[Recording, str] | None:
    """The recording without the first rows of its episodes, and a warning that says so: those in which the best set of
    effects acts on commands from before, if fewer parameters explain the others, or nothing explains these rows; else
    None."""
    late = [effect for effect in best.effects if follows_late(effect, search.system)]
    explained = search.explains_all(best)
    if not late or search.rows.jumps or (explained and len(late) == len(best.effects)):
        return None
    firsts = _first_on_own_commands(search, best)
    rows = torch.tensor([len(episode.time) for episode in recording.episodes])
    if bool((firsts > MOST_LEFT_OUT * rows).any()):
        return None
    found = _explaining(search, best, firsts)
    if found is None or (explained and found.fits.theta.shape[1] >= best.fits.theta.shape[1]):
        return None
    late = [effect for effect in found.effects if follows_late(effect, search.system)]
    usable, left_out = [], 0.0
    for index, (episode, first) in enumerate(zip(recording.episodes, firsts.tolist(), strict=True)):
        read = recording.usable[index] if recording.usable else [True]
        own = np.broadcast_to(read, (len(episode.time), len(recording.measured))).copy()
        own[:first] = False
        usable.append(own)
        left_out = max(left_out, float(episode.time[first] - episode.time[0]))
    told = (
        f"up to the first {number(left_out, 2)} s of each episode are left out: they still depend on commands from "
        f"before, by {listed([plain(effect.name) for effect in late])}"
    )
    return replace(recording, usable=tuple(usable)), told


def _first_on_own_commands(search: Search, found: ScoredModel) -> Tensor:
    """(E,) the first row of each episode from which on what acts depends on the recorded commands alone."""
    rows, actions = search.rows, search.system.actions
    world = CandidateModel(search.system, found.effects, rows).at(found.fits.theta[0])
    bounds = rows.command.new_tensor([[action.low, action.high] for action in actions]).T
    held = pad(rows.held, (1, 0), value=LONG)
    low, high = (
        world.actuate(torch.cat((before.expand(len(held), 1, -1), rows.command), 1), held)[:, 1:] for before in bounds
    )
    depends = ((high - low).abs().amax(2) > FORGOTTEN * (bounds[1] - bounds[0])).any(2)
    return (depends * torch.arange(1, depends.shape[1] + 1)).amax(1)


def _explaining(search: Search, best: ScoredModel, firsts: Tensor) -> ScoredModel | None:
    """The best set of effects on the rows from the first of each episode on, if it explains these and, with a constant
    command before each episode, the rows before them too: else something other than earlier commands acts there."""
    rows = search.rows
    used = rows.used * (rows.index >= firsts[rows.episode][:, None])[..., None]
    kept = used.flatten(1).any(1).nonzero()[:, 0]
    if not len(kept):
        return None
    later = Search(search.system, replace(rows, used=used).select(kept), search.catalogue, jobs=search.jobs)
    others = [effect for effect in best.effects if not follows_late(effect, search.system)]
    (whole,) = later.fit([(best.effects, best.fits.on(kept))], CAREFUL)
    explained, contradicts = search.explains_all(best), _contradicts(search, best, whole)
    if explained and not contradicts:
        return None
    fewer = [less(best, removed) for removed in (*([effect] for effect in others), others)]
    later.fit([(effects, fits.on(kept)) for effects, fits in fewer], CAREFUL)
    if explained or not later.explains_all(later.best):
        if not contradicts:
            return None
        later.go_on_from([], exchange=True)
    found = later.best
    return found if later.explains_all(found) and _explains_first_rows(search, found, int(firsts.max())) else None


def _contradicts(search: Search, best: ScoredModel, later: ScoredModel) -> bool:
    """Whether parameters that fit later rows are much less likely on all rows than those that fit all."""
    model = CandidateModel(search.system, best.effects, search.rows)
    all_rows, later_rows = (
        float(differentiate([model], replace(best.fits, theta=each.fits.theta)).likelihood.sum())
        for each in (best, later)
    )
    return all_rows - later_rows > CONTRADICTS


def _explains_first_rows(search: Search, found: ScoredModel, rows_before: int) -> bool:
    """Whether a set explains all rows if a constant command was given for so many rows before each episode."""
    actions = search.system.actions
    low, high = search.rows.command.new_tensor([[action.low, action.high] for action in actions]).T
    episodes = len(search.rows.command)
    before, reach = (0.5 * (low + high)).expand(episodes, -1), 0.5 * (high - low)
    for count in TRIED:
        for action in range(len(actions)):
            tried = before + torch.linspace(-1, 1, count)[:, None, None] * torch.diag(reach)[action]
            tried = tried.clamp(low, high)
            likelihood = torch.stack([_by_episode(search, found, each, rows_before) for each in tried])
            before = tried[likelihood.argmax(0), torch.arange(episodes)]
        reach = 2 / (count - 1) * reach
    rows = _with_commands_before(search.rows, before, rows_before)
    models = FittedModels(search.system, rows, search.catalogue, search.source.fits, search.jobs)
    (fitted,) = models.fit([(found.effects, replace(search.best.fits, theta=found.fits.theta))], CAREFUL)
    return models.explains_all(fitted)


def _by_episode(search: Search, found: ScoredModel, before: Tensor, rows_before: int) -> Tensor:
    """(E,) log likelihood of the episodes with commands (E, n_action) before them."""
    rows = _with_commands_before(search.rows, before, rows_before)
    model = CandidateModel(search.system, found.effects, rows)
    fits = replace(search.best.fits, theta=found.fits.theta, log_process=found.fits.log_process)
    likelihood = differentiate([model], replace(fits, log_noise=found.fits.log_noise)).likelihood[0]
    return likelihood.new_zeros(len(before)).index_add(0, rows.episode, likelihood)


def _with_commands_before(rows: Segments, before: Tensor, count: int) -> Segments:
    """The same windows in episodes that begin `count` rows earlier, with constant commands (E, n_action) until then."""
    command = torch.cat((before[:, None].expand(-1, count, -1), rows.command), 1)
    held = pad(rows.held, (count, 0), value=rows.period)
    return replace(rows, command=command, held=held, first=rows.first + count)
