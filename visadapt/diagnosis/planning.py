"""The experiment that settles an ambiguity: the excitation of the commands that tells two explanations apart best.

An ambiguous diagnosis names effects that fit a recording equally well. Each explanation is simulated under every
excitation of a family (square waves, sines, pseudo-random binary sequences, white noise; the largest that keeps all
states within 0.9 of the system's ranges, about their middles), and every explanation is fitted to what each shows. The
worth of an excitation is the log posterior odds of the true against the other explanation: the least over all pairs of
the first explanation and another that it tells from it, with either of them true. This is the expected information of
Box and Hill (1967), Technometrics 9(1), with fits in place of a linear model and the worst case in place of the mean.

The odds are those of readings without noise under the recording's noise, which is what they are on average: drawn noise
would add a few units at random, and the best of many excitations would be the luckiest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from visadapt.diagnosis.excitations import excitations, operating_point
from visadapt.diagnosis.explanations import explanations
from visadapt.diagnosis.policy_bound import StatesToActions, actions
from visadapt.diagnosis.result import AMBIGUOUS, Diagnosis, Push, named_effects
from visadapt.diagnosis.search.fitted_models import FittedModels
from visadapt.diagnosis.search.preparation import limited, prepare
from visadapt.diagnosis.words import number, with_unit
from visadapt.effects import EFFECTS, Effect
from visadapt.estimation.fit_states import CAREFUL, QUICK, with_effect
from visadapt.estimation.likelihood import FitState
from visadapt.history import History
from visadapt.processes import one_thread
from visadapt.progress import Progress
from visadapt.recordings import Episode, Recording
from visadapt.storage.atomic_files import replacing
from visadapt.systems import System
from visadapt.world import World

SIZES = (0.05, 0.1, 0.14, 0.2, 0.28, 0.4, 0.57, 0.8)
"""Amplitudes that are tried, and the standard deviation of white noise, as shares of half the command's range."""
MARGIN = 0.9
"""Share of the states' ranges, about their middles, that an experiment may reach; it may stay where it starts."""
SUBSTEP = 0.025  # Longest integration step of a simulation, in prediction times
WORTH = 3.0  # Log odds up to which an experiment is said to settle nothing
CERTAIN = 100.0  # Log odds above which more make no difference


@dataclass(frozen=True)
class Plan:
    """An excitation that is added to a policy's commands, or is all of the commands, and what is expected of it.

    >>> import numpy as np, visadapt as va
    >>> time, added = 0.05 * np.arange(201), np.zeros((201, 1))
    >>> print(va.Plan((("gust",), ("spring",)), "a sine of 0.8 Hz", time, added, ("command",), 12.0, 5.0))
    to tell gust from spring: add a sine of 0.8 Hz to the commands, for 10 s (expected log odds 12; 5 for white noise)
    """

    explanations: tuple[tuple[str, ...], ...]
    """names of the effects of each; the first is told apart from the others, if the experiment `settles` anything"""
    excitation: str
    """in words"""
    time: NDArray[np.floating]
    """(T,) s"""
    added: NDArray[np.floating]
    """(T, n_action) in the command's units"""
    actions: tuple[str, ...]
    """names of the commands"""
    log_odds: float
    """expected log odds of the true against the other explanation, in the worst case"""
    white: float
    """the same for white noise of the largest admissible size; NaN where none is admissible"""
    is_all: bool = False
    """whether `added` is all of the commands: no policy was given"""
    alike: tuple[tuple[str, ...], ...] = ()
    """names of the effects of each explanation that this excitation is not expected to tell from the first"""

    @property
    def settles(self) -> bool:
        """Whether the experiment is expected to tell the explanations apart."""
        return self.log_odds > WORTH

    def __str__(self) -> str:
        first, others = " and ".join(self.explanations[0]), _either(self.explanations[1:])
        if not self.settles:
            return f"no excitation was found that tells {first} from {others}"
        white = "" if math.isnan(self.white) else f"; {self.white:.0f} for white noise"
        what = f"command {self.excitation}" if self.is_all else f"add {self.excitation} to the commands"
        alike = f"; it does not tell it from {_either(self.alike)}" if self.alike else ""
        return (
            f"to tell {first} from {others}: {what}, for {self.time[-1]:.3g} s (expected log odds "
            f"{self.log_odds:.0f}{white}){alike}"
        )

    def write(self, path: str | Path) -> None:
        """Write a CSV with the columns `time` and, for each command, what is added to it, or all of it (`is_all`)."""
        with replacing(path) as temporary:
            header = ",".join(("time", *self.actions))
            np.savetxt(temporary, np.column_stack((self.time, self.added)), "%.9g", ",", header=header, comments="")


@one_thread()
@torch.inference_mode()
def plan(
    found: Diagnosis,
    recording: Recording,
    source: World,
    policy: StatesToActions | None = None,
    samples: int = 200,
    seed: int = 0,
    progress: Progress | None = None,
) -> Plan:
    """Design the experiment that tells the explanations of an ambiguous diagnosis apart.

    Args:
        found: the diagnosis of `recording`.
        recording: of states; the experiment starts in its first state.
        source: the world that was diagnosed, without effects.
        policy: gives the commands to which the excitation is added. Without one the excitation is all of the commands:
            about 0 where that is inside the command's range, otherwise about the mean of those recorded.
        samples: length of the experiment, in commands.
        seed: of all noise drawn.
        progress: called with (excitations tried, excitations in all, nan).

    Raises:
        ValueError: the diagnosis is not ambiguous, the recording has no states, or the machine leaves the ranges of its
            states under every excitation.

    >>> import pathlib, tempfile, torch, visadapt as va
    >>> policy, source = va.load_policy(va.shipped("cartpole_states")), va.World(va.CartPole())
    >>> runs = va.run(va.SyntheticTarget(), policy, 2, 30, torch.Generator().manual_seed(0))
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "run.h5"
    >>> va.write_recording(path, [run.episode for run in runs], ["x", "x_dot", "theta", "theta_dot"], ["command"])
    >>> run = va.load_recording(path, source.system)
    >>> found = va.diagnose(run, source, catalogue=[va.effects.ConstantForce])
    >>> va.plan(found, run, source, policy)
    Traceback (most recent call last):
    ValueError: only an ambiguous diagnosis needs an experiment; the verdict is no_gap
    """
    if found.verdict != AMBIGUOUS:
        raise ValueError(f"only an ambiguous diagnosis needs an experiment; the verdict is {found.verdict}")
    if not recording.measured:
        raise ValueError("a plan needs a recording of states, not of frames")
    sets = _explained(found)
    generator = torch.Generator().manual_seed(seed)
    trials = _Trials.of(sets, recording, found.where.pushes, source.system, policy, samples, generator)
    worth = trials.worth(sets, progress)
    best, apart = _best(worth)
    least = worth[:, apart].amin(1)
    white = least[[name.startswith("white") for name in trials.names]]
    names = [tuple(effect.name for effect in each) for each in sets]
    return Plan(
        explanations=(names[0], *(names[1:][k] for k in apart)),
        excitation=f"{trials.names[best]} ({SIZES[int(trials.largest[best])]:g} of half the range{trials.about})",
        time=recording.period * np.arange(samples),
        added=trials.added[trials.row(best)].numpy(),
        actions=tuple(action.name for action in source.system.actions),
        log_odds=float(least[best]),
        white=float(white.max()) if bool(white.isfinite().any()) else math.nan,
        is_all=policy is None,
        alike=tuple(each for k, each in enumerate(names[1:]) if k not in apart),
    )


@dataclass(frozen=True)
class _Trials:
    """Every explanation simulated under every excitation, in each of the SIZES."""

    recording: Recording  # whose period, noise and measured states the experiment has
    system: System
    measured: tuple[int, ...]  # columns of the state
    noise: Tensor  # (n,) standard deviation of the readings of each state
    names: list[str]  # of the E excitations, in words
    added: Tensor  # (sizes times E, T, n_action) to a policy's commands; without a policy, all of the commands
    about: str  # the constant commands about which these are, in words
    shown: list[tuple[Tensor, Tensor]]  # of each explanation the readings and the commands, a row for each of `added`
    largest: Tensor  # (E,) the largest admissible of the SIZES of each excitation, by index; -1 without any

    @classmethod
    def of(
        cls,
        sets: Sequence[Sequence[Effect]],
        recording: Recording,
        pushes: Sequence[Push],
        system: System,
        policy: StatesToActions | None,
        samples: int,
        generator: torch.Generator,
    ) -> _Trials:
        """Simulate them from the first state of the recording.

        Raises:
            ValueError: the machine leaves the ranges of its states under every excitation.
        """
        noise, start, measured = _noise_and_start(sets[0], recording, system, pushes)
        names, unit = excitations(system, recording.period, samples, generator)
        sizes = torch.tensor(SIZES, dtype=unit.dtype)[:, None, None, None]
        constant = operating_point(recording, system) if policy is None else torch.zeros_like(unit[0, 0])
        added = (constant + sizes * unit).flatten(0, 1)
        added = system.within_range(added) if policy is None else added
        about = "".join(
            f", about {action.name} {with_unit(number(value), action.unit)}"
            for action, value in zip(system.actions, constant.tolist(), strict=True)
            if value
        )
        runs = [_simulate(each, system, recording, added, policy, noise, start, generator) for each in sets]
        admissible = torch.stack([inside for _, inside in runs]).all(0).unflatten(0, (len(SIZES), len(names)))
        largest = admissible.long().cumprod(0).sum(0) - 1
        if bool((largest < 0).all()):
            hint = "" if policy else ": give the policy of the rig"
            raise ValueError(f"the machine leaves the ranges of its states under every excitation{hint}")
        return cls(recording, system, measured, noise, names, added, about, [shown for shown, _ in runs], largest)

    def row(self, excitation: int) -> int:
        """The row of `added`, and of what is shown, with an excitation in its largest admissible size."""
        return int(self.largest[excitation]) * len(self.names) + excitation

    def worth(self, sets: Sequence[Sequence[Effect]], progress: Progress | None) -> Tensor:
        """Log odds (E, sets - 1) of the true against the other of two explanations, the first and each of the others,
        whichever is true; minus infinity where no size is admitted."""
        worth = torch.full((len(self.names), len(sets) - 1), -math.inf)
        for done, k in enumerate(torch.nonzero(self.largest >= 0)[:, 0].tolist()):
            row = self.row(k)
            runs = [(states[row], commands[row]) for states, commands in self.shown]
            recordings = [_recording(self.recording, self.system, self.measured, *run, self.noise) for run in runs]
            for rival in range(1, len(sets)):
                worth[k, rival - 1] = min(
                    _lead(sets[truth], sets[other], recordings[truth], self.system)
                    for truth, other in ((0, rival), (rival, 0))
                )
            if progress is not None:
                progress(done + 1, len(self.names), math.nan)
        return worth


def _best(worth: Tensor) -> tuple[int, list[int]]:
    """The best excitation, and the rivals that it tells from the first explanation, by the log odds (E, rivals).

    It tells most rivals and, among those that tell as many, has the highest log odds of the one that it tells least.
    Where no excitation tells any, the rivals are all.
    """
    told = worth > WORTH
    if not bool(told.any()):
        return int(worth.amin(1).argmax()), list(range(worth.shape[1]))
    least = torch.where(told, worth, CERTAIN).amin(1)
    most = told.sum(1) == told.sum(1).max()
    best = int(torch.where(most, least, -math.inf).argmax())
    return best, told[best].nonzero()[:, 0].tolist()


def _either(sets: Sequence[Sequence[str]]) -> str:
    return " or ".join(" and ".join(names) for names in sets)


def _explained(found: Diagnosis) -> list[list[Effect]]:
    """The explanations of an ambiguous diagnosis, as effects at their found values."""
    # Repeated readings are found in the readings themselves: no experiment tells more, and no model has them.
    causes = [cause for cause in found.causes if not EFFECTS[cause.effect].repeats_readings]
    sets = explanations(causes)
    if len(sets) < 2:
        raise ValueError("the diagnosis gives no values of the effects that it cannot tell apart: there is no plan")
    return [named_effects(found.verdict, each) for each in sets]


def _start(source: FitState, effects: Sequence[Effect]) -> FitState:
    """Where the fit of a set starts: the fit of the source, with the effects at their values."""
    fits = source
    for effect in effects:
        fits = with_effect(fits, [float(getattr(effect, parameter.name)) for parameter in effect.table])
    return fits


def _noise_and_start(
    effects: Sequence[Effect], recording: Recording, system: System, pushes: Sequence[Push]
) -> tuple[Tensor, Tensor, tuple[int, ...]]:
    """Standard deviations (n,) of the measurement noise, 0 of what was not measured; the first state (n,); and the
    columns of the state that were measured, without velocities that were derived."""
    classes = tuple(type(effect) for effect in effects)
    prepared = prepare(limited(recording, system), system, classes, pushes)
    models = FittedModels(system, prepared.rows, classes, prepared.source)
    fits = models.fit([(classes, _start(models.source.fits, effects))], CAREFUL)[0].fits
    noise = torch.zeros(len(system.states), dtype=torch.float64)
    noise[list(prepared.rows.channels)] = (fits.log_noise[0] / 2).exp()
    return noise, fits.state[0, 0, 0], prepared.rows.channels


def _simulate(
    effects: Sequence[Effect],
    system: System,
    recording: Recording,
    added: Tensor,
    policy: StatesToActions | None,
    noise: Tensor,
    first: Tensor,
    generator: torch.Generator,
) -> tuple[tuple[Tensor, Tensor], Tensor]:
    """Readings without noise (N, T + 1, n) and commands (N, T + 1, n_action) under each of N excitations, and (N,)
    whether all states stay within their ranges; the policy sees readings with noise."""
    substeps = math.ceil(recording.period / (SUBSTEP * system.prediction_time))
    world = World(system, effects, recording.period, substeps=substeps).double()
    low, high = torch.tensor([(one.low, one.high) for one in system.states], dtype=torch.float64).T
    middle = (low + high) / 2
    least, most = torch.lerp(middle, low, MARGIN), torch.lerp(middle, high, MARGIN)
    least, most = torch.minimum(least, first), torch.maximum(most, first)  # a machine may rest at an end: an empty tank

    def within(states: Tensor) -> Tensor:
        return ((states >= least) & (states <= most)).all(1)

    def read(at: Tensor) -> Tensor:
        return at + noise * torch.randn(at.shape, generator=generator, dtype=at.dtype)

    at = world.start(first.expand(len(added), -1))
    measured, at = world.measure(at, generator)
    history = History.start(read(measured), added.shape[-1])
    readings, commands, inside = [measured], [], within(at.state)
    for t in range(added.shape[1]):
        command = added[:, t] if policy is None else actions(policy, system, history).to(added) + added[:, t]
        command = system.within_range(command)
        at = world.step(at, command)
        measured, at = world.measure(at, generator)
        inside &= within(at.state)
        at = replace(at, state=torch.where(inside[:, None], at.state, first))  # a run that left must stay finite
        history = history.acting(command).observing(read(measured))
        readings.append(measured)
        commands.append(command)
    return (torch.stack(readings, 1), torch.stack((*commands, 0 * commands[-1]), 1)), inside


def _recording(
    like: Recording, system: System, measured: tuple[int, ...], states: Tensor, commands: Tensor, noise: Tensor
) -> Recording:
    """One simulated experiment of states (T, n) and commands (T, n_action): the `measured` columns of the state, whose
    readings have the standard deviations `noise` (n,)."""
    columns = list(measured)
    time = like.period * np.arange(len(states))
    episode = Episode(time, commands.numpy(), states[:, columns].numpy())
    # A fit assumes at least the noise of rounding to the resolution; these readings have none, so it assumes `noise`.
    rounding = tuple((math.sqrt(12) * noise[columns]).tolist())
    names = tuple(system.states[column].name for column in columns)
    return Recording((episode,), names, like.period, ("the simulated experiment",), resolution=rounding)


def _lead(truth: Sequence[Effect], other: Sequence[Effect], recording: Recording, system: System) -> float:
    """Log posterior odds of the truth against another explanation, both fitted to the recording."""
    sets = [tuple(type(effect) for effect in effects) for effects in (truth, other)]
    catalogue = list(dict.fromkeys((*sets[0], *sets[1])))
    prepared = prepare(recording, system)
    models = FittedModels(system, prepared.rows, catalogue, prepared.source)
    # Both in one batch: fitted one after the other, the second would be stopped early if it fell far behind the first.
    starts = [(kinds, _start(models.source.fits, effects)) for kinds, effects in zip(sets, (truth, other), strict=True)]
    first, second = models.fit(starts, QUICK)
    if first.log_odds == -math.inf:
        return -math.inf  # nothing is learnt about the truth
    return min(first.log_odds - second.log_odds, CERTAIN)
