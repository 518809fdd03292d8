"""Simulates many blind recordings at once: every episode of each is a column of the same arrays."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from datasets.blind.chain import NEUTRAL, Actuation, Sensing
from datasets.blind.control import Controllers, Driver
from datasets.blind.kinds import Shape
from datasets.blind.plant import (
    CART_DRY,
    CART_FORCES,
    MAX_FORCE,
    PERIOD,
    PIVOT_DRY,
    PIVOT_TORQUES,
    Array,
    Load,
    Parameters,
    Plant,
    Table,
    nominal,
    predict,
)
from datasets.blind.rigs import Rig

HORIZON = 0.5
"""s of prediction over which an effect's strength is measured, in whole periods"""


@dataclass
class Case:
    """What determines a recording."""

    driver: Driver
    """controller, excitation and first states"""
    effects: dict[str, Shape]
    """parameters by name of the effect"""
    noise: Array
    """(rows, 4, episodes): m, m/s, rad, rad/s"""
    loss_draws: Array
    """(rows, episodes), uniform: which rows a dropout loses"""
    rig: Rig = field(default_factory=Rig)
    """sensors and clock"""
    turns_exactly: bool = False
    """of its dry friction (`Plant`); alike for all cases of a set"""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and episodes."""
        rows, episodes = self.loss_draws.shape
        return rows, episodes


@dataclass
class Run:
    """A simulated case: (rows, 4, episodes), commands (rows, episodes)."""

    true: Array
    """states"""
    measured: Array
    """readings with noise"""
    clean: Array
    """readings without it"""
    commands: Array
    """of the controller"""
    times: Array
    """s, (rows, episodes): when a row is measured and its command begins to act"""
    lengths: Array
    """s, (rows, episodes): for how long the command acts"""

    @property
    def reach(self) -> tuple[float, float]:
        """Largest |x| (m) and |theta| (rad)."""
        return float(np.abs(self.true[:, 0]).max()), float(np.abs(self.true[:, 2]).max())

    def predicted_gap(self, deviations: Array) -> float:
        """Strength of an effect on commands or states.

        Root mean square, over a row in every 0.1 s and over x and theta, of the error of the source's prediction of the
        true states half a second ahead, in units of the measurement noise (`deviations`, m and rad).
        """
        period = float(self.lengths.mean())
        ahead = round(HORIZON / period)
        rows = np.arange(0, len(self.true) - ahead, round(0.1 / period))
        start = self.true[rows].transpose(1, 0, 2).reshape(4, -1)
        commands, lengths = (
            np.stack([values[rows + k].reshape(-1) for k in range(ahead)]) for values in (self.commands, self.lengths)
        )
        end = self.true[rows + ahead].transpose(1, 0, 2).reshape(4, -1)
        return _strength((end - predict(start, commands, lengths))[[0, 2]], deviations)

    def sensed_gap(self, deviations: Array) -> float:
        """Strength of an effect on readings: the change in x and theta (rms), in units of the noise."""
        return _strength((self.clean - self.true)[:, [0, 2]].transpose(1, 0, 2).reshape(2, -1), deviations)


def _strength(difference: Array, deviations: Array) -> float:
    with np.errstate(over="ignore"):
        return float(np.sqrt(np.mean((difference / deviations[:, None]) ** 2)))


def simulate(cases: list[Case], substeps: int) -> list[Run]:
    """Run the cases in closed loop, `substeps` of the plant in 50 ms, those of one period side by side.

    A pole beyond 1 rad or a cart beyond 5 m is stopped there, and `Run.reach` shows it.
    """
    runs: dict[int, Run] = {}
    for period in dict.fromkeys(case.rig.period for case in cases):
        own = [i for i, case in enumerate(cases) if case.rig.period == period]
        steps = math.ceil(substeps * max(cases[i].rig.longest for i in own) / PERIOD - 1e-9)
        runs |= zip(own, _simulate([cases[i] for i in own], period, steps), strict=True)
    return [runs[i] for i in range(len(cases))]


def _simulate(cases: list[Case], period: float, substeps: int) -> list[Run]:
    """Cases of one nominal period (s), with so many substeps of the plant in each row."""
    columns = np.cumsum([0, *(case.shape[1] for case in cases)])
    spans = [slice(int(a), int(b)) for a, b in pairwise(columns)]
    n, rows = int(columns[-1]), max(case.shape[0] for case in cases)
    noise, loss_draws = np.zeros((rows, 4, n)), np.ones((rows, n))
    times, lengths = np.repeat(period * np.arange(rows)[:, None], n, 1), np.full((rows, n), period)
    for case, span in zip(cases, spans, strict=True):
        own = case.shape[0]
        noise[:own, :, span], loss_draws[:own, span] = case.noise, case.loss_draws
        times[:own, span], lengths[:own, span] = case.rig.clock(*case.shape)
        times[own:, span] += times[own - 1, span] + lengths[own - 1, span] - own * period
    drive = Controllers([case.driver for case in cases], period)
    chain = _chain(cases, spans, n)
    plant = _plant(cases, spans, n, rows * max(case.rig.longest for case in cases))
    plant.turns_exactly = cases[0].turns_exactly
    start = drive.start if plant.slosh is None else np.concatenate((drive.start, drive.start[:2]))
    actuation, sensing = Actuation(chain, n), Sensing(chain, drive.start, float(lengths.min()) / substeps)
    true, measured, clean = (np.empty((rows, 4, n)) for _ in range(3))
    commands = np.empty((rows, n))
    state = start
    for row in range(rows):
        time, h = times[row], lengths[row] / substeps
        true[row] = state[:4]
        measured[row], clean[row] = sensing.read(time, state, noise[row], loss_draws[row])
        commands[row] = drive(row, state[:4], measured[row])
        actuation.push(time, commands[row])
        for k in range(substeps):
            t = time + k * h
            after = plant.step(t, state, MAX_FORCE * actuation(t, h), h)
            lost = (np.abs(after[2]) > 1.0) | (np.abs(after[0]) > 5.0)
            state = np.where(lost, state * np.array([1.0, 0.0, 1.0, 0.0, 1.0, 0.0])[: len(state), None], after)
            sensing.pass_by(t + h, state)
    return [
        Run(
            true[:own, :, span],
            measured[:own, :, span],
            clean[:own, :, span],
            commands[:own, span],
            times[:own, span],
            lengths[:own, span],
        )
        for own, span in zip((case.shape[0] for case in cases), spans, strict=True)
    ]


def _chain(cases: list[Case], spans: list[slice], n: int) -> Parameters:
    chain = {name: np.full(n, value) for name, value in NEUTRAL.items()}
    for case, span in zip(cases, spans, strict=True):
        for effect, parameters in case.effects.items():
            for name, value in parameters.items():
                if f"{effect}.{name}" in chain:
                    chain[f"{effect}.{name}"][span] = value
        rig = case.rig
        chain["encoder.position"][span], chain["encoder.angle"][span] = rig.counts
        chain["velocity.derived"][span] = rig.velocities in ("differences", "filtered")
        chain["velocity.time_constant"][span] = rig.time_constant
    return chain


def _plant(cases: list[Case], spans: list[slice], n: int, seconds: float) -> Plant:
    plant = nominal(n)
    slosh = (np.zeros(n), np.ones(n), np.zeros(n))
    members: dict[str, list[tuple[NDArrayInt, Shape, int]]] = {}
    for case, span in zip(cases, spans, strict=True):
        for effect, parameters in case.effects.items():
            if effect in MASSES:
                getattr(plant, MASSES[effect])[span] *= parameters["scale"]
            elif effect == "track_tilt":
                plant.tilt[span] = parameters["angle"]
            elif effect == "load_dependent_friction":
                plant.gear = np.zeros(n) if plant.gear is None else plant.gear
                plant.gear[span] = parameters["share"]
            elif effect == "sloshing":
                slosh[0][span], slosh[2][span] = parameters["mass"], parameters["damping"]
                slosh[1][span] = 2 * np.pi * parameters["frequency"]
            else:
                members.setdefault(effect, []).append((np.arange(n)[span], parameters, case.shape[1]))
    if slosh[0].any():
        plant.slosh = slosh
    tables: tuple[tuple[dict[str, Load], Table], ...] = (
        (CART_FORCES, plant.forces),
        (PIVOT_TORQUES, plant.torques),
        (CART_DRY, plant.dry_forces),
        (PIVOT_DRY, plant.dry_torques),
    )
    for laws, table in tables:
        for effect in sorted(members.keys() & laws.keys()):
            table.append((*_together(effect, members[effect], seconds), laws[effect]))
    return plant


MASSES = {"cart_mass": "cart_mass", "pole_mass": "pole_mass", "pole_length": "half_length"}
"""the plant's parameter that an effect scales"""

NDArrayInt = np.ndarray[tuple[int, ...], np.dtype[np.intp]]


def _together(
    effect: str, members: list[tuple[NDArrayInt, Shape, int]], seconds: float
) -> tuple[NDArrayInt, Parameters]:
    """Columns and parameters, one value a column, of all cases that have this effect."""
    index = np.concatenate([columns for columns, _, _ in members])
    counts = [count for _, _, count in members]
    parameters = {name: np.repeat([p[name] for _, p, _ in members], counts) for name in members[0][1]}
    if "path_seed" in parameters:
        paths = [_paths(effect, p, count, int(seconds / 0.01)) for _, p, count in members]
        parameters["path"] = np.concatenate(paths)
    return index, parameters


def _paths(effect: str, shape: Shape, episodes: int, samples: int) -> Array:
    """Random force paths of unit size, (episodes, samples) every 10 ms; fewer samples are the start of the same."""
    paths = np.zeros((episodes, samples))
    for episode in range(episodes):
        rng = np.random.default_rng([int(shape["path_seed"]), episode])
        if effect == "kicks":
            # 30 ms long, of either sign, with exponential gaps.
            time = 0.0
            while (time := time + float(rng.exponential(shape["interval"]))) * 100 < samples:
                paths[episode, int(time * 100) : int(time * 100) + 3] = rng.choice((-1.0, 1.0))
        else:
            # Ornstein-Uhlenbeck, started from its stationary distribution.
            keep = np.exp(-0.01 / shape["correlation"])
            steps = rng.standard_normal(samples)
            value = steps[0]
            for k in range(samples):
                value = value if k == 0 else keep * value + np.sqrt(1 - keep**2) * steps[k]
                paths[episode, k] = value
    return paths
