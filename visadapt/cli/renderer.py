"""visadapt renderer: a renderer from recorded frames and states."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from renderers import LayeredRenderer, save_renderer
from renderers.learnt import FAINT
from renderers.training import fit
from visadapt.cli.errors import InputError
from visadapt.cli.progress import progress
from visadapt.cli.run_folders import run_settings, unfinished
from visadapt.cli.target import load_target
from visadapt.estimation.frame_residuals import evenly_spaced, size_of, structure
from visadapt.estimation.poses import PoseFinder, reach_of
from visadapt.progress import staged
from visadapt.recordings import Episode
from visadapt.recordings.checks import LEAST_ROWS, check_units
from visadapt.recordings.clock import RawEpisode
from visadapt.recordings.hdf5 import read_names, read_recording
from visadapt.recordings.loading import refuse_video
from visadapt.recordings.physics import are_degrees
from visadapt.recordings.sensors import TURN
from visadapt.storage.atomic_files import replacing
from visadapt.storage.checkpoints import load_tree, save_tree
from visadapt.systems import CartPole
from visadapt.targets import Start
from visadapt.targets.gymnasium import GymnasiumTarget
from visadapt.world import World

CALIBRATION_STATES, CALIBRATION_RANGE = 4000, (1.0, 0.35)
"""States that an environment is put into, and the largest |x| in m and |theta| in rad of these."""

NOT_LEARNT = 0.4
"""Error where cart and pole are, over how far they stand out, above which they are not where they are drawn."""

MOST_READ = 100  # Frames from which the pose is read

DRAWN_AT_ONCE = 64  # Frames, which bounds the memory that drawing takes

HELD_OUT_EVERY = 10
"""Every tenth frame is left out of the training and compared with what the renderer makes of its state."""


def run(options: argparse.Namespace) -> None:
    """Train the renderer, write it if it draws frames that it was not trained on, and say how well it does."""
    if bool(options.recording) == bool(options.target):
        raise InputError("give recordings, or a gymnasium environment by --target and --map")
    if options.recording and (options.map or options.show or options.within):
        raise InputError("--map, --show and --within are for --target: recordings have their frames")
    x, theta, frames = _from_recordings(options.recording) if options.recording else _from_target(options)
    _check(options, x, frames)
    (height, width), (column, row) = frames.shape[1:], options.hinge
    torch.manual_seed(options.seed)
    renderer = LayeredRenderer(height, width, column, row, options.scale, options.pole)
    held_out = torch.arange(len(frames)) % HELD_OUT_EVERY == 0
    settings = run_settings(options, "recording", "map")
    out = Path(options.out)
    with unfinished(out, settings) as folder, progress() as report:
        state = folder / "training.safetensors"
        kept, keep = load_tree(state) if state.exists() else None, partial(save_tree, state)
        generator, bar = torch.Generator().manual_seed(options.seed), staged(report, "renderer")
        shown = x[~held_out], theta[~held_out], frames[~held_out]
        fit(renderer, *shown, options.iterations, generator, progress=bar, keep=keep, kept=kept)
        with torch.no_grad():
            poses = zip(x[held_out].split(DRAWN_AT_ONCE), theta[held_out].split(DRAWN_AT_ONCE), strict=True)
            drawn = torch.cat([renderer(*each) for each in poses])
        seen = frames[held_out] / 255
        residual = seen - drawn
        # Almost all of a frame is background, which says nothing of a pole that is missing.
        background = renderer.background.detach().sigmoid()
        contrast = torch.maximum((seen - background).abs(), (drawn - background).abs())
        moves = contrast > FAINT
        error, stands_out = (255 * float(each[moves].abs().mean()) for each in (residual, contrast))
        if is_learnt := error <= NOT_LEARNT * stands_out:
            with replacing(out) as temporary:
                save_renderer(temporary, renderer, {**settings, "error": size_of(structure(residual))})
    if not is_learnt:  # The training is of no use, and a better guess makes another one
        raise InputError(
            f"the renderer has not learnt to draw these frames: where cart and pole are, it is {error:.0f} grey levels "
            f"off, and they stand out by {stands_out:.0f}. Are the states those of the frames (row by row, x to the "
            "right, theta clockwise from upright, in m and rad), and --hinge, --scale and --pole near those of the "
            "camera? Or are --iterations too few?"
        )
    column, row = renderer.origin.tolist()
    read = _read_from(renderer, x[held_out], theta[held_out], frames[held_out])
    print(
        f"{out}: in {len(drawn)} frames left out of the training, {error:.2f} grey levels of 255 off where cart and "
        f"pole are, on average; {read}; hinge at {column:.1f},{row:.1f} px, {renderer.gain[0]:.1f} px a metre"
    )


def _read_from(renderer: LayeredRenderer, x: Tensor, theta: Tensor, frames: Tensor) -> str:
    """How well the pose is read from frames (N, H, W) of known x (N,) and theta (N,), in words."""
    few = evenly_spaced(len(frames), MOST_READ)
    poses = PoseFinder(renderer, reach_of(renderer, CartPole()))(frames[few])
    if not poses.explained.any():
        return "no pose is read from them"
    off_x, off_theta = (poses.pose - torch.stack((x, theta), -1)[few])[poses.explained].T
    off_theta = torch.atan2(off_theta.sin(), off_theta.cos())  # theta may be given a turn further
    return (
        f"in {len(off_x)} of {len(few)} the pose is read, x {off_x.abs().median():.2g} m off and theta "
        f"{off_theta.abs().median():.2g} rad (medians)"
    )


def _check(options: argparse.Namespace, x: Tensor, frames: Tensor) -> None:
    """Raises InputError where nothing could be learnt: too few frames, nothing that moves in them, or a first guess of
    the camera far off them."""
    if len(frames) < 2 * HELD_OUT_EVERY:
        raise InputError(f"{len(frames)} frames are too few to learn from; some hundred are right")
    if int((frames.amax(0).int() - frames.amin(0).int()).max()) <= 255 * FAINT:
        raise InputError(
            f"no pixel of the frames changes by more than {255 * FAINT:.0f} grey levels of 255: frames in which cart "
            "and pole move, and are lighter or darker than what is behind them, are right"
        )
    if options.iterations < 3:
        raise InputError(f"--iterations {options.iterations}: at least 3 are right")
    (height, width), (column, row) = frames.shape[1:], options.hinge
    if not (-width <= column <= 2 * width and -height <= row <= 2 * height):
        raise InputError(
            f"--hinge {column:g},{row:g}: more than a frame's size outside the frames, which are {width} px wide and "
            f"{height} px high; the column and row at which the hinge is seen at x = 0 are right"
        )
    distance = options.scale * float(x.abs().median())
    if distance > 2 * width:
        raise InputError(
            f"x goes from {float(x.min()):.3g} to {float(x.max()):.3g}: at --scale {options.scale:g} px a metre the "
            f"cart is mostly {distance:.0f} px or more from x = 0, in frames {width} px wide; x in m is right"
        )


def _from_target(options: argparse.Namespace) -> tuple[Tensor, Tensor, Tensor]:
    """As `_from_recordings`, of states that an environment is put into: a calibration, for which it is not stepped."""
    target = load_target(options, World(CartPole()), True)
    if not isinstance(target, GymnasiumTarget):
        raise InputError(f"{options.target}: cannot be put into chosen states; give recordings of frames and states")
    largest_x, largest_theta = options.within or CALIBRATION_RANGE
    count, generator = options.show or CALIBRATION_STATES, torch.Generator().manual_seed(options.seed)
    states = Start(largest_x, 0.0, largest_theta, 0.0).draw(count, generator)
    return states[:, 0], states[:, 2], torch.from_numpy(target.show(states.double().numpy()))


def _from_recordings(paths: list[str]) -> tuple[Tensor, Tensor, Tensor]:
    """Cart positions (N,) in m, pole angles (N,) in rad and frames (N, H, W) uint8 of all recordings."""
    states: list[NDArray[np.floating]] = []
    frames: list[NDArray[np.uint8]] = []
    for path in paths:
        refuse_video(path, "states")
        names, _ = read_names(path, CartPole)
        for name in ("x", "theta"):
            if name not in names:
                raise InputError(f"{path}: has no state {name!r}; it has {', '.join(names)}")
        pose = [names.index("x"), names.index("theta")]
        episodes = read_recording(path)
        widths = {episode.state.shape[1] for episode in episodes if episode.state is not None}
        if widths - {len(names)}:
            raise InputError(
                f"{path}: states of {max(widths)} columns, which are not named; the attribute state_names says which "
                'they are, as in "x,theta"'
            )
        for number, episode in enumerate(episodes):
            where = f"{path}, episode {number}"
            if episode.state is None or episode.frame is None:
                alone = "frames" if episode.state is None else "states"
                raise InputError(f"{where}: holds {alone} alone; frames and states are needed")
            size, wanted = episode.frame.shape[1:], (frames[0] if frames else episode.frame).shape[1:]
            if size != wanted:
                raise InputError(f"{where}: frames of {size} rows and columns; those before have {wanted}")
            states.append(episode.state[:, pose])
            frames.append(episode.frame)
        _check_angles(path, episodes, states[-len(episodes) :])
    x, theta = torch.from_numpy(np.concatenate(states)).float().unbind(1)
    return x, theta, torch.from_numpy(np.concatenate(frames))


def _check_angles(path: str, episodes: Sequence[Episode], poses: Sequence[NDArray[np.floating]]) -> None:
    """Raises an error where the angles of a file's poses (T, 2) are evidently in degrees.

    Poses may have been set by hand, in any order. So how fast they change is judged only where an angle is larger than
    a turn: only a pole that turns on has such an angle, in radians.
    """
    judged = []
    for number, (episode, pose) in enumerate(zip(episodes, poses, strict=True)):
        if len(pose) >= LEAST_ROWS and episode.action.shape[1] == 1:
            time, action, state = (each.astype(float) for each in (episode.time, episode.action, pose))
            judged.append(RawEpisode(Path(path), time, action, state, ("x", "theta"), number=number))
    if not judged:
        return
    theta = np.concatenate([pose[:, 1] for pose in poses])
    if np.abs(theta).max() > TURN:
        check_units(judged, CartPole())
    elif are_degrees(judged, CartPole()):
        raise InputError(
            f"{path}: theta goes from {theta.min():.3g} to {theta.max():.3g} and answers the command as if in degrees; "
            "radians are right"
        )
