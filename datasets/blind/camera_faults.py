"""What a blind film's camera does wrong, by numpy and scipy, not the library: faults of the catalogue and foreign ones.

Grey levels are in [0, 1], pixel centres lie at whole numbers. A frame passes rotation, zoom and shift about its centre,
occlusion, blur, gamma, brightness, then noise and 8 bits; then frames are lost.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from datasets.blind.kinds import Kind, Shape, scale, sign, signed
from datasets.blind.plant import Array
from datasets.blind.scene import HEIGHT, WIDTH, Look, draw, pixels

NOISE = 2.0 / 255
"""standard deviation of a pixel"""
TOGETHER = 100  # Frames drawn at a time


def _turned(rng: np.random.Generator, _: float) -> Shape:
    return {"direction": float(rng.uniform(-np.pi, np.pi))}


def _box(rng: np.random.Generator, _: float) -> Shape:
    return {
        "column": float(rng.integers(15, WIDTH - 15)),
        "row": float(rng.integers(15, HEIGHT - 15)),
        "aspect": float(np.exp(rng.uniform(-0.5, 0.5))),
        "grey": float(rng.uniform(0.0, 1.0)),
    }


def _covering(size: float, shape: Shape) -> Shape:
    """A box of whole pixels, of `size` px on average, inside the frame."""
    half_width, half_height = 0.5 * size * shape["aspect"], 0.5 * size / shape["aspect"]
    return {
        "left": float(max(0, round(shape["column"] - half_width))),
        "top": float(max(0, round(shape["row"] - half_height))),
        "right": float(min(WIDTH, round(shape["column"] + half_width))),
        "bottom": float(min(HEIGHT, round(shape["row"] + half_height))),
        "grey": shape["grey"],
    }


CAMERA: tuple[Kind, ...] = (
    Kind(
        "camera_shift",
        "camera",
        1.0,
        10.0,
        lambda size, shape: {"dx": size * np.cos(shape["direction"]), "dy": size * np.sin(shape["direction"])},
        _turned,
    ),
    Kind("camera_rotation", "camera", 0.015, 0.2, signed("angle"), sign),
    Kind("camera_zoom", "camera", 0.015, 0.2, scale, sign),
    Kind("blur", "camera", 0.5, 2.0, lambda size, shape: {"sigma": size}),
    Kind(
        "brightness",
        "camera",
        0.06,
        0.4,
        lambda size, shape: {"gain": float(np.exp(shape["sign"] * size)), "offset": shape["offset"]},
        lambda rng, length: sign(rng, length) | {"offset": float(rng.uniform(-0.08, 0.08))},
    ),
    Kind("gamma", "camera", 0.08, 0.6, lambda size, shape: {"exponent": float(np.exp(shape["sign"] * size))}, sign),
    Kind("occlusion", "camera", 12.0, 45.0, _covering, _box),
    Kind("camera_delay", "camera", 0.015, 0.12, lambda size, shape: {"delay": size}),
    Kind("frame_drop", "camera", 0.03, 0.3, lambda size, shape: {"rate": size}),
)
"""those of the catalogue, their sizes drawn between the smallest and the largest"""

FOREIGN_IN_FILMS: tuple[Kind, ...] = (
    Kind("lens_distortion", "camera", 0.02, 0.1, signed("coefficient"), sign),
    Kind(
        "moving_shadow",
        "camera",
        0.08,
        0.4,
        lambda size, shape: {"depth": size, "speed": shape["speed"], "width": shape["width"], "start": shape["start"]},
        lambda rng, _: {
            "speed": float(rng.uniform(5.0, 25.0)),
            "width": float(rng.uniform(10.0, 25.0)),
            "start": float(rng.uniform(0.0, WIDTH)),
        },
    ),
    Kind(
        "flicker",
        "camera",
        0.04,
        0.25,
        lambda size, shape: {"amplitude": size, "frequency": shape["frequency"]},
        lambda rng, _: {"frequency": float(rng.uniform(0.7, 9.0))},
    ),
    Kind(
        "another_cart",
        "camera",
        0.1,
        0.4,
        lambda size, shape: {"width": float(np.exp(shape["sign"] * size)), "grey": 0.5 * size},
        sign,
    ),
)
"""no effect of the catalogue: coefficient of r^2, r over half the frame's width; shadow's depth, px/s, px and px; share
and Hz; the cart's width over the usual one, and by how much its grey is nearer to the wall's"""


def clean(effects: dict[str, Shape], look: Look, places: Array, times: Array) -> Array:
    """Frames (T, H, W) in [0, 1] of places (T, 2) in m and rad at times (T,) in s, before noise and 8 bits."""
    if "another_cart" in effects:
        other = effects["another_cart"]
        grey = look.cart + other["grey"] * (look.wall - look.cart)
        look = replace(look, cart=grey, cart_width=other["width"] * look.cart_width)
    columns, rows, magnified = _looks_at(effects)
    out = [
        draw(look, part, columns, rows, magnified) for part in np.split(places, range(TOGETHER, len(places), TOGETHER))
    ]
    frames = np.concatenate(out)
    if "moving_shadow" in effects:
        shadow = effects["moving_shadow"]
        middle = (shadow["start"] + shadow["speed"] * times) % (WIDTH + 100.0) - 50.0
        across = (np.arange(WIDTH) - middle[:, None]) / shadow["width"]
        frames = frames * (1 - shadow["depth"] * np.exp(-0.5 * across**2))[:, None]
    if "flicker" in effects:
        turns = effects["flicker"]["frequency"] * times
        frames = frames * (1 + effects["flicker"]["amplitude"] * np.sin(2 * np.pi * turns))[:, None, None]
    if "occlusion" in effects:
        box = effects["occlusion"]
        frames[:, int(box["top"]) : int(box["bottom"]), int(box["left"]) : int(box["right"])] = box["grey"]
    if "blur" in effects:
        frames = gaussian_filter(frames, effects["blur"]["sigma"], axes=(1, 2), mode="nearest")
    if "gamma" in effects:
        frames = frames ** effects["gamma"]["exponent"]
    if "brightness" in effects:
        frames = effects["brightness"]["gain"] * frames + effects["brightness"]["offset"]
    return frames


def _looks_at(effects: dict[str, Shape]) -> tuple[Array, Array, float]:
    """Columns and rows (H, W) of the scene that the pixels look at, and the magnification."""
    columns, rows = pixels()
    middle = (WIDTH - 1) / 2, (HEIGHT - 1) / 2
    shift = effects.get("camera_shift", {"dx": 0.0, "dy": 0.0})
    across, down = columns - middle[0] - shift["dx"], rows - middle[1] - shift["dy"]
    zoom = effects.get("camera_zoom", {"scale": 1.0})["scale"]
    angle = effects.get("camera_rotation", {"angle": 0.0})["angle"]
    across, down = (
        (np.cos(angle) * across + np.sin(angle) * down) / zoom,
        (np.cos(angle) * down - np.sin(angle) * across) / zoom,
    )
    if "lens_distortion" in effects:
        bent = 1 + effects["lens_distortion"]["coefficient"] * (across**2 + down**2) / middle[0] ** 2
        across, down = bent * across, bent * down
    return across + middle[0], down + middle[1], zoom


def recorded(frames: Array, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Frames (T, H, W) with the pixels' noise, in 8 bits."""
    noisy = frames + NOISE * rng.standard_normal(frames.shape)
    return np.asarray(np.round(255 * np.clip(noisy, 0.0, 1.0)), np.uint8)


def with_losses(frames: NDArray[np.uint8], rate: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The frames of an episode, of which each but the first is lost with this probability, the last shown again."""
    lost = rng.random(len(frames)) < rate
    lost[0] = False
    shown = np.maximum.accumulate(np.where(lost, 0, np.arange(len(frames))))
    return frames[shown]
