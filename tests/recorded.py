"""Tables of a cart-pole's motion, and CSV files of them, for the tests of recordings."""

from functools import cache

import numpy as np
import pytest
import torch

from visadapt.recordings import RecordingError, load_recording
from visadapt.systems import CartPole
from visadapt.world import World

STATES = ("x", "x_dot", "theta", "theta_dot")
HEADER = ("time", *STATES, "command")


def a_table(rows=41, period=0.05, seed=0, noise=1e-3):
    """Columns by name; each rate is the derivative of its variable."""
    time = np.arange(rows) * period
    rng = np.random.default_rng(seed)
    table = {
        "time": time,
        "x": 0.3 * np.sin(2 * time),
        "x_dot": 0.6 * np.cos(2 * time),
        "theta": 0.1 * np.sin(5 * time + 1),
        "theta_dot": 0.5 * np.cos(5 * time + 1),
        "command": np.sin(7 * time),
    }
    for name in STATES:
        table[name] = table[name] + noise * rng.normal(size=rows)
    return table


def a_run(start, noise, rows=200, period=0.05, seed=0, push=0.2):
    """The cart-pole itself under a controller and excitation of up to `push`, from an angle `start`; wrapped, noisy."""
    values = a_motion(start, rows, period, seed, push).copy()
    values[:, :4] += noise * np.random.default_rng((seed, 1)).normal(size=(rows, 4)) * [0.5, 3, 1, 3]
    values[:, 2] = (values[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return {"time": np.arange(rows) * period, **dict(zip(HEADER[1:], values.T, strict=True))}


@cache
def a_motion(start, rows, period, seed, largest):
    """States and commands (rows, 5) of such a run; many tests begin with the same one."""
    rng = np.random.default_rng(seed)
    world = World(CartPole(), period=period, substeps=2).double()
    now = world.start(torch.tensor([[0.1, 0.0, start, 0.0]], dtype=torch.float64))
    log, push = [], 0.0
    gains = torch.tensor([0.05, 0.1, 1.5, 0.3], dtype=torch.float64)
    for row in range(rows):
        if row % 3 == 0:
            push = rng.uniform(-largest, largest)
        balance = float(now.state[0] @ gains) if start < 1 else 0.0
        command = float(np.clip(balance + push, -1, 1))
        log.append([*now.state[0].tolist(), command])
        with torch.no_grad():
            now = world.step(now, torch.tensor([[command]], dtype=torch.float64))
    return np.array(log)


def write(path, table, separator=",", end="\n", before="", encoding="utf-8"):
    rows = zip(*(table[name] for name in table), strict=True)
    lines = [separator.join(table), *(separator.join(str(cell) for cell in row) for row in rows)]
    path.write_bytes((before + end.join(lines) + end).encode(encoding))
    return path


def load(*paths, columns=None, system=None):
    return load_recording(paths, system or CartPole(), columns)


def refuses(match, *paths, columns=None):
    with pytest.raises(RecordingError, match=match) as caught:
        load(*paths, columns=columns)
    assert "\n" not in str(caught.value)
