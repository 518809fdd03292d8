"""The sensors of the blind flights: late positions, turned axes, gyroscopes' offsets; then noise, and lost rows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from datasets.blind.flight_plants import Array, Parameters


def sensed(p: Parameters, states: Array, path: Array, h: float) -> Array:
    """Readings (rows, N, 13) of states without noise, of vehicles whose positions and velocities every `h` s, beginning
    with the first row, are `path` (steps, N, 6)."""
    out = states.copy()
    per_row = len(path) // len(states)
    back = np.round(p["positioning_delay.delay"] / h).astype(int)
    steps = np.maximum(0, np.arange(len(states))[:, None] * per_row - back)
    out[..., :6] = path[steps, np.arange(states.shape[1])]
    turned = _quaternion(*(p[f"attitude_offset.{angle}"] for angle in ("roll", "pitch", "yaw")))
    out[..., 6:10] = _product(states[..., 6:10], turned)
    # The sensor's axes are R(roll, pitch, yaw) times the body's: it reads their components of the rates.
    rates = np.concatenate([np.zeros_like(states[..., :1]), states[..., 10:]], -1)
    out[..., 10:] = _product(_product(turned * (1, -1, -1, -1), rates), turned)[..., 1:]
    out[..., 10:] += np.stack([p[f"rate_offset.{axis}"] for axis in "xyz"], -1)
    return out


def with_losses(rows: Array, lost: NDArray[np.bool_]) -> Array:
    """Readings (rows, N, 13) of which each that is `lost` (rows, N) repeats the one before; never the first."""
    out = rows.copy()
    for row in range(1, len(rows)):
        out[row] = np.where(lost[row][:, None], out[row - 1], rows[row])
    return out


def _quaternion(roll: Array, pitch: Array, yaw: Array) -> Array:
    """(N, 4) of a turn about x by roll, about y by pitch, about z by yaw, in this order about fixed axes."""
    zero = np.zeros_like(roll)
    about_x = np.stack([np.cos(roll / 2), np.sin(roll / 2), zero, zero], -1)
    about_y = np.stack([np.cos(pitch / 2), zero, np.sin(pitch / 2), zero], -1)
    about_z = np.stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], -1)
    return _product(about_z, _product(about_y, about_x))


def _product(a: Array, b: Array) -> Array:
    """Hamilton's product of quaternions (..., 4)."""
    av, bv = a[..., 1:], b[..., 1:]
    scalar = a[..., :1] * b[..., :1] - (av * bv).sum(-1, keepdims=True)
    return np.concatenate([scalar, a[..., :1] * bv + b[..., :1] * av + np.cross(av, bv)], -1)
