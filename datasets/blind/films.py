"""Films of a cart-pole with a hidden gap to the source, and no states, for a sealed check of diagnosis.

    python -m datasets.blind.films --out data/blind_films --look plain --count 40 --seed 7

Writes one HDF5 file per film (frames and commands), a calibration film of the same camera without faults (frames and
states, for `visadapt renderer`) beside the folder, and a separate key file, whose SHA-256 is printed before any film is
written. A diagnoser must never open the key. Plant, pictures and the camera's faults are code apart from the library.

The strength of a fault of the camera is the root mean square of what it changes in the pixels, in units of their noise;
of any other effect that of datasets.blind.gaps, in units of 2 mm and 5 mrad.
"""

from __future__ import annotations

import io
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import tyro
from numpy.typing import NDArray

from datasets.blind.camera_faults import CAMERA, FOREIGN_IN_FILMS, NOISE, clean, recorded, with_losses
from datasets.blind.drafts import POLE_REACH, RECORDING_SUBSTEPS, draw_case
from datasets.blind.kinds import LATER, NAMED, Kind, Shape, evenly_mixed
from datasets.blind.plant import PERIOD, Array
from datasets.blind.rigs import Rig
from datasets.blind.scene import LOOKS
from datasets.blind.sealing import key_path, names, seal
from datasets.blind.simulation import Case, Run, simulate
from datasets.blind.sizing import SEARCH_SUBSTEPS, Job, draw_job, seek

LookName = Literal["plain", "textured"]

MIX = {"single": 0.5, "pair": 0.2, "none": 0.15, "foreign": 0.15}
"""share of the films; of the singles half are the camera's, a pair is a fault of the camera and another effect"""
ROWS, EPISODES = 400, (4, 8)
"""frames of a film, approximately, and smallest and largest number of episodes"""
POSE_NOISE = (0.002, 0.0, 0.005, 0.0)
"""m, m/s, rad, rad/s: noise of the positions that the controller is given, and unit of strengths"""
STRENGTHS, WEAKEST_FAULT = (2.0, 30.0), 0.5
"""weakest and strongest effect on motion, and weakest on pixels"""
CART_REACH = 1.15
"""m: |x| never exceeds this, so that the cart stays in the frame of a camera that is moved"""
CALIBRATION_FRAMES = 2000

IN_MOTION: tuple[Kind, ...] = tuple(
    kind for kind in (*NAMED, *LATER) if kind.stage != "sensing" or kind.name == "angle_offset"
)
"""effects that are no camera's; of the sensors' faults, a film can show a pole that is bent"""

NOT_TOGETHER: tuple[frozenset[str], ...] = (frozenset({"camera_delay", "actuator_delay"}),)
"""never together in one film, since other sizes of them give the same film"""


@dataclass(frozen=True)
class Settings:
    """Which films are made, and where they are written."""

    out: Path
    """folder for the films"""
    look: LookName = "plain"
    """the scene, its light and its texture"""
    count: int = 40
    """how many films"""
    seed: int = 0
    """seed of all random numbers"""
    key: Path | None = None
    """file for the answers; by default beside the folder, <out>.key.json"""


@dataclass
class FilmDraft:
    """A film in the making."""

    rng: np.random.Generator
    """its own random numbers, so that redrawing one film does not change the others"""
    mixture: str
    """single, pair, none or foreign"""
    of_camera: bool
    """whether a single effect is the camera's"""
    camera: dict[str, Shape]
    """faults of the camera, foreign ones too"""
    case: Case | None = None
    """its machine and controller"""
    run: Run | None = None
    """what moved"""
    frames: NDArray[np.uint8] | None = None
    """(rows, episodes, H, W)"""
    strengths: dict[str, float] | None = None
    """by effect"""


def make(settings: Settings) -> list[FilmDraft]:
    """Draw, run and film all recordings."""
    if settings.count < 1:
        raise ValueError(f"count is {settings.count}, must be at least 1")
    seeds = np.random.SeedSequence([settings.seed, list(LOOKS).index(settings.look)]).spawn(settings.count + 1)
    # Shares as exact as the count allows, in random order.
    mixtures = evenly_mixed(MIX, settings.count)
    drafts = [
        FilmDraft(np.random.default_rng(seed), str(mixture), number % 2 == 0, {})
        for number, (seed, mixture) in enumerate(zip(seeds[1:], mixtures, strict=True))
    ]
    np.random.default_rng(seeds[0]).shuffle(drafts)
    for attempt in range(80):
        pending = [draft for draft in drafts if draft.frames is None]
        if not pending:
            return drafts
        _attempt(pending, settings.look, 0.95 ** (attempt // 2))
    raise RuntimeError("some films could not be made; try another seed")


def _attempt(drafts: list[FilmDraft], look: LookName, excitation: float) -> None:
    """Redraw, run and film the drafts; leave those that leave the frame or miss their strengths."""
    cases = [_draw_case(draft.rng, excitation) for draft in drafts]
    bare = simulate(cases, SEARCH_SUBSTEPS)
    kept = [(draft, case) for draft, case, run in zip(drafts, cases, bare, strict=True) if _in_frame(run)]
    parts: list[list[Job]] = []
    for draft, case in kept:
        faults, kinds = _draw_kinds(draft)
        draft.camera = {kind.name: _sized(draft.rng, kind) for kind in faults}
        parts.append([draw_job(draft.rng, kind.name, case, STRENGTHS) for kind in kinds])
    seek([job for own in parts for job in own], np.array(POSE_NOISE)[[0, 2]])
    ready = []
    for (draft, case), own in zip(kept, parts, strict=True):
        if all(0.9 * STRENGTHS[0] <= job.strength <= 1.1 * STRENGTHS[1] for job in own):
            case.effects = {job.name: job.parameters for job in own}
            # A late camera shows the pose of an earlier instant, as a late sensor reads it.
            late = draft.camera.get("camera_delay")
            effects = case.effects | ({"measurement_delay": late} if late else {})
            ready.append((draft, case, own, replace(case, effects=effects)))
    runs = simulate([filmed for *_, filmed in ready], RECORDING_SUBSTEPS)
    for (draft, case, own, _), run in zip(ready, runs, strict=True):
        strengths = {job.name: job.strength for job in own}
        strengths |= {name: _strength(draft, name, run, look) for name in draft.camera}
        if _in_frame(run) and all(strengths[name] >= WEAKEST_FAULT for name in draft.camera):
            draft.case, draft.run, draft.strengths = case, run, strengths
            draft.frames = _filmed(draft, run, look)


def _draw_case(rng: np.random.Generator, excitation: float) -> Case:
    episodes = int(rng.integers(EPISODES[0], EPISODES[1] + 1))
    case = draw_case(rng, round(ROWS / episodes), episodes, np.array(POSE_NOISE), Rig(), False, excitation)
    return replace(case, turns_exactly=True)


def _draw_kinds(draft: FilmDraft) -> tuple[list[Kind], list[Kind]]:
    """Faults of the camera, and other effects, which a film can tell apart."""

    def one(kinds: tuple[Kind, ...]) -> Kind:
        return kinds[int(draft.rng.integers(len(kinds)))]

    if draft.mixture == "none":
        return [], []
    if draft.mixture == "foreign":
        return [one(FOREIGN_IN_FILMS)], []
    if draft.mixture == "single":
        return ([one(CAMERA)], []) if draft.of_camera else ([], [one(IN_MOTION)])
    while True:
        fault, kind = one(CAMERA), one(IN_MOTION)
        if frozenset({fault.name, kind.name}) not in NOT_TOGETHER:
            return [fault], [kind]


def _sized(rng: np.random.Generator, kind: Kind) -> Shape:
    shape = kind.draw(rng, ROWS * PERIOD)
    return kind.build(float(np.exp(rng.uniform(np.log(kind.low), np.log(kind.high)))), shape)


def _in_frame(run: Run) -> bool:
    x, theta = run.reach
    return x <= CART_REACH and theta <= POLE_REACH


def _seen(run: Run, episode: int) -> Array:
    """Positions and angles (T, 2) that the frames show."""
    return run.clean[:, [0, 2], episode]


def _filmed(draft: FilmDraft, run: Run, look: LookName) -> NDArray[np.uint8]:
    out = []
    for episode in range(run.clean.shape[2]):
        frames = clean(draft.camera, LOOKS[look], _seen(run, episode), run.times[:, episode])
        rate = draft.camera.get("frame_drop", {"rate": 0.0})["rate"]
        out.append(with_losses(recorded(frames, draft.rng), rate, draft.rng))
    return np.stack(out, 1)


def _strength(draft: FilmDraft, name: str, run: Run, look: LookName) -> float:
    """Root mean square change that a fault makes by itself to the pixels of the first episode, over their noise."""
    usual = clean({}, LOOKS[look], run.true[:, [0, 2], 0], run.times[:, 0])
    if name == "frame_drop":
        lost = draft.camera[name]["rate"] * np.mean((usual[1:] - usual[:-1]) ** 2)
        return float(np.sqrt(lost) / NOISE)
    own = {name: draft.camera[name]}
    changed = clean(
        own, LOOKS[look], (run.clean if name == "camera_delay" else run.true)[:, [0, 2], 0], run.times[:, 0]
    )
    return float(np.sqrt(np.mean((changed - usual) ** 2)) / NOISE)


def key_text(settings: Settings, drafts: list[FilmDraft]) -> str:
    """The answers as JSON; the same settings give the same text."""
    answers = []
    for name, draft in zip(names(len(drafts), ".h5"), drafts, strict=True):
        assert draft.case is not None
        assert draft.strengths is not None
        every = {**draft.camera, **draft.case.effects}
        effects = [
            {"effect": effect, "parameters": parameters, "strength": round(draft.strengths[effect], 4)}
            for effect, parameters in every.items()
        ]
        answers.append(
            {"file": name, "kind": draft.mixture, "effects": effects, "driver": draft.case.driver.description}
        )
    head = {"kind": f"film_{settings.look}", "seed": settings.seed, "noise": 255 * NOISE}
    return json.dumps({**head, "recordings": answers}, indent=1) + "\n"


def _content(episodes: list[dict[str, NDArray[Any]]], state_names: tuple[str, ...] = ()) -> bytes:
    """A recording as HDF5, of version 1 of the format of docs/architecture.md."""
    file = io.BytesIO()
    with h5py.File(file, "w") as out:
        out.attrs["format"], out.attrs["version"], out.attrs["action_names"] = "visadapt recording", 1, ["command"]
        if state_names:
            out.attrs["state_names"] = list(state_names)
        for number, arrays in enumerate(episodes):
            group = out.create_group(f"episode_{number:05d}")
            for name, values in arrays.items():
                packed = {"compression": "gzip", "chunks": (16, *values.shape[1:])} if name == "frame" else {}
                group.create_dataset(name, data=values, fletcher32=True, **packed)
    return file.getvalue()


def _film(draft: FilmDraft) -> bytes:
    assert draft.run is not None
    assert draft.frames is not None
    run, frames = draft.run, draft.frames
    return _content(
        [
            {"time": run.times[:, k], "action": run.commands[:, k, None], "frame": frames[:, k]}
            for k in range(frames.shape[1])
        ]
    )


def calibration(look: LookName, seed: int) -> bytes:
    """Frames of known states, the camera without faults."""
    rng = np.random.default_rng([seed, list(LOOKS).index(look), 1])
    places = rng.uniform(
        (-CART_REACH - 0.2, -1.2 * POLE_REACH), (CART_REACH + 0.2, 1.2 * POLE_REACH), (CALIBRATION_FRAMES, 2)
    )
    times = PERIOD * np.arange(CALIBRATION_FRAMES, dtype=float)
    frames = recorded(clean({}, LOOKS[look], places, times), rng)
    arrays: dict[str, NDArray[Any]] = {
        "time": times,
        "action": np.zeros((len(times), 1)),
        "state": places,
        "frame": frames,
    }
    return _content([arrays], ("x", "theta"))


def calibration_path(folder: Path) -> Path:
    """File of a folder's calibration film."""
    return folder.with_name(folder.name + ".calibration.h5")


def main(settings: Settings) -> None:
    """Make the films, print the key's SHA-256, then write the key, the films and the calibration film."""
    key = key_path(settings.out, settings.key)
    drafts = make(settings)
    seal(settings.out, key, key_text(settings, drafts), map(_film, drafts), ".h5")
    calibration_path(settings.out).write_bytes(calibration(settings.look, settings.seed))


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
