"""Frames of the cart-pole with their states, to train renderers on.

python -m datasets.cartpole_frames --help

Cart positions are uniform over a little more than the camera's reach, so that some carts are cut by the frame's edge.
Most pole angles are near upright, where a balancing policy keeps the pole; the others are uniform over the full circle.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import tyro
from numpy.typing import NDArray

from renderers import DrawnCartPole
from visadapt.storage.atomic_files import replacing


@dataclass(frozen=True)
class Settings:
    """What is drawn, and where it is written."""

    out: Path = Path("data/cartpole_frames.h5")
    """file to write"""
    frames: int = 4000
    """how many frames"""
    seed: int = 0
    """of the states"""
    margin: float = 0.2
    """m beyond the camera's reach"""
    upright: float = 0.7
    """share of the angles that are normally distributed around upright"""
    spread: float = 0.15
    """rad, their standard deviation"""


@dataclass(frozen=True)
class Frames:
    """States and the camera's frames of them."""

    x: NDArray[np.float64]
    """(N,) cart positions in m"""
    theta: NDArray[np.float64]
    """(N,) pole angles in rad"""
    frames: NDArray[np.uint8]
    """(N, H, W)"""


def make(settings: Settings) -> Frames:
    """Draw the states and their frames."""
    if settings.frames < 1:
        raise ValueError(f"frames is {settings.frames}, must be at least 1")
    if not 0 <= settings.upright <= 1:
        raise ValueError(f"upright is {settings.upright}, must be a share between 0 and 1")
    draw = DrawnCartPole()
    rng = np.random.default_rng(settings.seed)
    far = draw.camera.reach + settings.margin
    x = rng.uniform(-far, far, settings.frames)
    near = rng.normal(0.0, settings.spread, settings.frames)
    anywhere = rng.uniform(-np.pi, np.pi, settings.frames)
    theta = np.where(rng.random(settings.frames) < settings.upright, near, anywhere)
    return Frames(x, theta, draw(x, theta))


def main(settings: Settings) -> None:
    """Write the data set as HDF5: x, theta, frames, and the settings as JSON in an attribute."""
    made = make(settings)
    with replacing(settings.out) as temporary, h5py.File(temporary, "w") as file:
        file["x"], file["theta"] = made.x, made.theta
        file.create_dataset("frames", data=made.frames, chunks=(1, *made.frames.shape[1:]), compression="gzip")
        file.attrs["settings"] = json.dumps(dataclasses.asdict(settings), default=str)
    print(f"{settings.out}: {len(made.frames)} frames of {made.frames.shape[2]} x {made.frames.shape[1]} px")


def read(path: Path) -> Frames:
    """Read a data set that `main` wrote.

    Raises:
        ValueError: one line that names the file and what is wrong with it.
    """
    if not path.is_file():
        raise ValueError(f"{path}: there is no such data set; make it with python -m datasets.cartpole_frames")
    try:
        with h5py.File(path, "r") as file:
            made = Frames(file["x"][:], file["theta"][:], file["frames"][:])
    except (OSError, KeyError) as error:
        raise ValueError(f"{path}: not a complete data set of frames ({error})") from error
    if made.frames.ndim != 3 or made.frames.dtype != np.uint8 or not len(made.x) == len(made.theta) == len(made.frames):
        raise ValueError(f"{path}: frames must be (N, H, W) uint8 with an x and a theta for each")
    return made


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
