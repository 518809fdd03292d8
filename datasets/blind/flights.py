"""Flights of a quadrotor or a fixed wing with a hidden gap to the source, for a sealed check of diagnosis.

    python -m datasets.blind.flights --out data/blind_quadrotor --system quadrotor --count 30 --seed 7

Writes one CSV per recording and a separate key file (effects, parameters, strengths), whose SHA-256 is printed before
any recording is written. A diagnoser must never open the key. None of the library's physics is used.

Effects are scaled to a drawn strength: the root mean square, over rows and over the 13 readings, of the change that an
effect makes to the source's prediction half a second ahead from the true states, in units of the measurement noise; for
a fault of sensors, of the change in the readings.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from datasets.blind.flight_control import CONTROLLERS, PERIODS, Chain, Flyers, starts
from datasets.blind.flight_kinds import FOREIGN, NEUTRAL, named
from datasets.blind.flight_plants import PLANTS, RESTING, Array, Motion, step
from datasets.blind.flight_sensing import sensed, with_losses
from datasets.blind.kinds import Effects, Kind, Shape, evenly_mixed
from datasets.blind.sealing import as_csv, key_path, names, seal

System = Literal["quadrotor", "fixed_wing"]

ROWS, EPISODES = 100, 10
SUBSTEP = 0.005
"""s, of the integration"""
HORIZON = 0.5
"""s of prediction over which strengths are measured"""
NOISE = np.repeat((0.01, 0.02, 0.0025, 0.005), (3, 3, 4, 3))
"""standard deviations: m, m/s, quaternion, rad/s"""
STRENGTHS = (1.5, 15.0)
"""weakest and strongest effect"""
MIX = {"single": 0.67, "none": 0.165, "foreign": 0.165}
"""share of the recordings"""
STATES = ("x", "y", "z", "x_dot", "y_dot", "z_dot", "q_w", "q_x", "q_y", "q_z", "omega_x", "omega_y", "omega_z")
ACTIONS = {
    "quadrotor": ("thrust", "rate_x", "rate_y", "rate_z"),
    "fixed_wing": ("thrust", "elevator", "aileron", "rudder"),
}


@dataclass(frozen=True)
class Settings:
    """Which recordings are made, and where they are written."""

    out: Path
    """folder for the recordings"""
    system: System = "quadrotor"
    """which vehicle"""
    count: int = 30
    """how many recordings"""
    seed: int = 0
    """seed of all random numbers"""
    key: Path | None = None
    """file for the answers; by default beside the folder, <out>.key.json"""
    effects: Effects = "core"
    """the catalogue's effects that are drawn: core, as in the sets 2032, rest, those beside it, or all"""


@dataclass
class Draft:
    """A recording in the making."""

    rng: np.random.Generator
    """its own random numbers"""
    mixture: str
    """single, none or foreign"""
    kind: Kind | None = None
    """the effect, if there is one"""
    shape: Shape = field(default_factory=dict)
    target: float = 0.0
    """strength to reach"""
    size: float = 0.0
    strength: float = 0.0
    """at that size"""
    loss_draws: Array | None = None
    """(ROWS, EPISODES), uniform: which rows a dropout loses"""
    readings: Array | None = None
    """(ROWS, EPISODES, 13)"""
    commands: Array | None = None
    """(ROWS, EPISODES, 4)"""

    @property
    def effects(self) -> dict[str, Shape]:
        """Parameters by effect."""
        return {} if self.kind is None else {self.kind.name: self.kind.build(self.size, self.shape)}


@dataclass(frozen=True)
class Flights:
    """N simulated episodes."""

    motions: list[Motion]
    """ROWS"""
    states: Array
    """(ROWS, N, 13)"""
    sensed: Array
    """(ROWS, N, 13) readings without noise"""
    commands: Array
    """(ROWS, N, 4)"""


def make(settings: Settings) -> list[Draft]:
    """Draw and fly all recordings."""
    if settings.count < 1:
        raise ValueError(f"count is {settings.count}, must be at least 1")
    place = list(PLANTS).index(settings.system)
    seeds = np.random.SeedSequence([settings.seed, place, 17]).spawn(settings.count + 1)
    # Shares and kinds as even as the count allows, in random order.
    order = np.random.default_rng(seeds[0])
    mixtures = evenly_mixed(MIX, settings.count)
    order.shuffle(mixtures)
    drafts = [Draft(np.random.default_rng(seed), str(m)) for seed, m in zip(seeds[1:], mixtures, strict=True)]
    foreign = [kind for kind, systems in FOREIGN if settings.system in systems]
    for mixture, own in (("single", named(settings.effects, settings.system)), ("foreign", foreign)):
        members = [draft for draft in drafts if draft.mixture == mixture]
        chosen = np.concatenate([order.permutation(len(own)) for _ in range(-(-max(1, len(members)) // len(own)))])
        for draft, k in zip(members, chosen, strict=False):
            draft.kind, draft.shape = own[k], own[k].draw(draft.rng, ROWS * PERIODS[settings.system])
            draft.target = float(np.exp(draft.rng.uniform(*np.log(STRENGTHS))))
            draft.size = float(np.sqrt(own[k].low * own[k].high))
            if own[k].stage == "sensing":
                draft.loss_draws = draft.rng.random((ROWS, EPISODES))
    fly = CONTROLLERS[settings.system]([draft.rng for draft in drafts], ROWS, EPISODES)
    _seek([draft for draft in drafts if draft.kind is not None], drafts, settings.system, fly)
    flown = _flown(drafts, settings.system, fly, SUBSTEP)
    for k, draft in enumerate(drafts):
        own_columns = slice(k * EPISODES, (k + 1) * EPISODES)
        noise = draft.rng.normal(size=(ROWS, EPISODES, 13)) * NOISE
        draft.readings = _received(draft, flown.sensed[:, own_columns] + noise)
        draft.commands = flown.commands[:, own_columns]
    return drafts


def _seek(searched: list[Draft], drafts: list[Draft], system: System, fly: Flyers, rounds: int = 5) -> None:
    """Bring strengths to their targets: sizes in proportion, within the bounds of their kinds."""
    for _ in range(rounds):
        _measure(drafts, system, fly)
        for draft in searched:
            assert draft.kind is not None
            if draft.strength > 0 and abs(np.log(draft.target / draft.strength)) > 0.1:
                size = draft.size * draft.target / draft.strength
                draft.size = float(np.clip(size, draft.size / 8, draft.size * 8).clip(draft.kind.low, draft.kind.high))
    _measure(drafts, system, fly)


def _measure(drafts: list[Draft], system: System, fly: Flyers) -> None:
    """Set the strengths of drafts to those of their sizes."""
    flown = _flown(drafts, system, fly, 2 * SUBSTEP)
    gaps = _gaps(flown, system).reshape(len(drafts), EPISODES)
    for k, (draft, own) in enumerate(zip(drafts, gaps, strict=True)):
        draft.strength = float(np.sqrt(np.mean(own)))
        if draft.kind is not None and draft.kind.stage == "sensing":
            own_columns = slice(k * EPISODES, (k + 1) * EPISODES)
            change = _received(draft, flown.sensed[:, own_columns]) - flown.states[:, own_columns]
            draft.strength = float(np.sqrt(np.mean((change / NOISE) ** 2)))


def _flown(drafts: list[Draft], system: System, fly: Flyers, h: float) -> Flights:
    parameters = {
        name: np.repeat([_value(draft, name, neutral) for draft in drafts], EPISODES)
        for name, neutral in NEUTRAL.items()
    }
    at, period = starts(system, fly), PERIODS[system]
    chain = Chain(parameters, at.place.shape[0])
    substeps = round(period / h)
    motions: list[Motion] = []
    states: list[Array] = []
    commands: list[Array] = []
    path: list[Array] = []
    for row in range(ROWS):
        motions.append(at)
        states.append(as_states(at, states[-1][:, 6:10] if states else None))
        command = fly.command(row, states[-1])
        commands.append(command)
        chain.push(command)
        for k in range(substeps):
            time = row * period + k * h
            path.append(np.concatenate([at.place, at.velocity], 1))
            at = step(PLANTS[system], parameters, time, at, chain(time, h), h)
    true = np.stack(states)
    return Flights(motions, true, sensed(parameters, true, np.stack(path), h), np.stack(commands))


def _received(draft: Draft, rows: Array) -> Array:
    """Readings (ROWS, EPISODES, 13), of which a dropout may lose some."""
    return rows if draft.loss_draws is None else with_losses(rows, draft.loss_draws < _value(draft, "dropout.rate", 0))


def _value(draft: Draft, name: str, neutral: float) -> float:
    effect, parameter = name.split(".")
    return draft.effects.get(effect, {}).get(parameter, neutral)


def _gaps(flown: Flights, system: System, every: int = 4) -> Array:
    """(N,) mean square error of the source's prediction half a second ahead, in units of the noise."""
    period = PERIODS[system]
    horizon = round(HORIZON / period)
    rows = range(0, ROWS - horizon, every)
    count = flown.states.shape[1]
    source = {name: np.full(len(rows) * count, value) for name, value in NEUTRAL.items()}

    def stacked(name: str) -> Array:
        return np.concatenate([getattr(flown.motions[row], name) for row in rows])

    at = Motion(stacked("place"), stacked("velocity"), stacked("turned"), stacked("rates"), RESTING)
    for k in range(horizon):
        command = np.concatenate([flown.commands[row + k] for row in rows])
        for _ in range(round(period / (5 * SUBSTEP))):
            at = step(PLANTS[system], source, 0.0, at, command, 5 * SUBSTEP)
    true = np.concatenate([flown.states[row + horizon] for row in rows])
    error = (as_states(at, true[:, 6:10]) - true) / NOISE
    return np.asarray(np.mean(error**2, axis=1).reshape(len(rows), count).mean(0))


def as_states(at: Motion, near: Array | None) -> Array:
    """States (N, 13); of the two quaternions of a rotation the one nearer to `near` (N, 4), or with w > 0."""
    r = at.turned
    w = np.sqrt(np.maximum(0.0, 1 + r[:, 0, 0] + r[:, 1, 1] + r[:, 2, 2])) / 2
    if w.min() < 0.1:
        raise RuntimeError("a vehicle turned over; try another seed")
    x, y, z = r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]
    q = np.stack([w, x / (4 * w), y / (4 * w), z / (4 * w)], -1)
    if near is not None:
        q = q * np.where((q * near).sum(1) < 0, -1.0, 1.0)[:, None]
    return np.concatenate([at.place, at.velocity, q, at.rates], 1)


def key_text(settings: Settings, drafts: list[Draft]) -> str:
    """The answers as JSON; the same settings give the same text."""
    answers = []
    for name, draft in zip(names(len(drafts)), drafts, strict=True):
        effects = [
            {"effect": effect, "parameters": parameters, "strength": round(draft.strength, 4)}
            for effect, parameters in draft.effects.items()
        ]
        answers.append({"file": name, "kind": draft.mixture, "effects": effects})
    head = {"kind": settings.system, "seed": settings.seed, "noise": NOISE.tolist()}
    return json.dumps({**head, "recordings": answers}, indent=1) + "\n"


def lines(draft: Draft, system: System) -> Iterator[str]:
    """The CSV of a recording."""
    assert draft.readings is not None
    assert draft.commands is not None
    yield ",".join(("episode", "time", *STATES, *ACTIONS[system]))
    for episode in range(EPISODES):
        for row in range(ROWS):
            values = (*draft.readings[row, episode], *draft.commands[row, episode])
            yield ",".join((str(episode), f"{row * PERIODS[system]:.2f}", *(f"{value:.7f}" for value in values)))


def main(settings: Settings) -> None:
    """Make the recordings, print the key's SHA-256, then write the key and the recordings."""
    key = key_path(settings.out, settings.key)
    drafts = make(settings)
    recordings = (as_csv(lines(draft, settings.system)) for draft in drafts)
    seal(settings.out, key, key_text(settings, drafts), recordings)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
