"""The readers that are fuzzed: of each, whole files to damage, the ways to damage them, and how one is read."""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from random import Random

import numpy as np
import torch
from rosbags.rosbag2 import StoragePlugin

from renderers import LayeredRenderer, MLPRenderer, load_renderer, save_renderer
from tests import logs
from tests.fuzz import damage
from tests.recorded import STATES, a_table, write
from visadapt import policies
from visadapt.diagnosis.saved import load_effects
from visadapt.learning.training_state import TrainingState
from visadapt.recordings import Episode, load_recording, write_recording
from visadapt.setups.policy_file import describe, load_policy, load_source, residual_for, save_policy
from visadapt.setups.regulator import regulator
from visadapt.storage.run_folder import open_run
from visadapt.systems import CartPole
from visadapt.systems.parameter_file import load_parameters
from visadapt.targets.env_map import EnvMap
from visadapt.tasks.references import read_reference
from visadapt.tasks.regulate import Regulate, read_task
from visadapt.world import World

Damage = Callable[[bytes, bytes, Random], bytes]


@dataclass(frozen=True)
class Reader:
    """One reader of files."""

    file: str  # name of a file that it reads
    whole: Callable[[Path], Sequence[Path]]  # writes whole files into a folder
    odd: tuple[Damage, ...]  # changes beside those of bytes
    read: Callable[[Path], object]
    """raises the library's own errors alone; of files with a checksum gives what was read, as bytes, else None"""

    @cache  # noqa: B019  # readers live as long as the process
    def samples(self) -> list[bytes]:
        """The whole files."""
        with tempfile.TemporaryDirectory() as folder:
            return [path.read_bytes() for path in self.whole(Path(folder))]

    @cache  # noqa: B019
    def contents(self) -> list[object]:
        """What is read of them."""
        with tempfile.TemporaryDirectory() as folder:
            path, found = Path(folder) / self.file, []
            for content in self.samples():
                path.write_bytes(content)
                found.append(self.read(path))
            return found

    def damaged(self, rng: Random) -> tuple[bytes, bool]:
        """A damaged file, and whether only its bytes were, which a checksum shows."""
        content, other = rng.choice(self.samples()), rng.choice(self.samples())
        kinds = [damage.damaged_bytes] if not self.odd or rng.random() < 0.4 else self.odd
        for _ in range(rng.choice((1, 1, 2, 4))):
            with suppress(Exception):  # a change may need what an earlier one has destroyed
                content = rng.choice(kinds)(content, other, rng)
        return content, kinds[0] is damage.damaged_bytes


def _text(*texts: str) -> Callable[[Path], list[Path]]:
    def whole(folder: Path) -> list[Path]:
        paths = [folder / str(number) for number in range(len(texts))]
        for path, text in zip(paths, texts, strict=True):
            path.write_text(text)
        return paths

    return whole


def _tables(folder: Path) -> list[Path]:
    positions = {name: values for name, values in a_table().items() if not name.endswith("_dot")}
    episodes = {"episode": np.arange(80) // 40, **{name: np.tile(values[:40], 2) for name, values in a_table().items()}}
    return [write(folder / "all", a_table()), write(folder / "few", positions), write(folder / "two", episodes)]


def _hdf5(frames: bool, folder: Path) -> list[Path]:
    episodes = []
    for seed, rows in enumerate((40, 25)):
        table = a_table(rows=rows, seed=seed)
        state = None if frames else np.column_stack([table[name] for name in STATES])
        frame = np.zeros((rows, 8, 10), np.uint8) + np.arange(rows, dtype=np.uint8)[:, None, None] if frames else None
        episodes.append(Episode(table["time"], table["command"][:, None], state, frame))
    names = None if frames else STATES
    write_recording(folder / "two", episodes, names, ["command"])
    write_recording(folder / "one", episodes[:1])
    return [folder / "two", folder / "one"]


def _bags(version: int, folder: Path) -> list[Path]:
    if version == 1:
        return [logs.ros_bag(folder / "run.bag", 1)]
    bag = logs.ros_bag(folder / "run", 2, stamped=False, plugin=StoragePlugin.MCAP)
    return [next(bag.glob("*.mcap"))]


def _read_log(columns: dict[str, str], path: Path) -> None:
    load_recording(path, CartPole(), columns)


def _policies(folder: Path) -> list[Path]:
    torch.manual_seed(0)
    paths = [folder / "alone", folder / "with residual"]
    world = World(CartPole())
    for path in paths:
        policy = policies.StatePolicy(4)
        if path is paths[1]:
            policy.residual, policy.grounded_in = residual_for(policy, world), describe(world)
        save_policy(path, policy, {"source": describe(world)})
    task = Regulate(world.system, tolerance={"x": 0.5, "theta": 0.05})
    save_policy(folder / "with task", regulator(world, task).policy(), {"source": describe(world)})
    return [*paths, folder / "with task"]


def _training_state(path: Path) -> TrainingState:
    network = torch.nn.Linear(2, 1)
    return TrainingState(network, torch.optim.Adam(network.parameters()), torch.Generator(), 0.1, 100, None, path)


def _training(folder: Path) -> list[Path]:
    torch.manual_seed(0)
    state = _training_state(folder / "state")
    for _ in range(100):
        state.descend(state.network(torch.ones(1, 2)).sum())
    state.keep({"best": 0.5})
    return [folder / "state"]


def _renderers(folder: Path) -> list[Path]:
    torch.manual_seed(0)
    save_renderer(folder / "layered", LayeredRenderer(10, 12, 5.5, 7.5, 4.0, 1.0), {"seed": 0})
    save_renderer(folder / "mlp", MLPRenderer(10, 12), {"seed": 0})
    return [folder / "layered", folder / "mlp"]


def _values(module: torch.nn.Module) -> bytes:
    parts = (f"{name} ".encode() + value.numpy().tobytes() for name, value in sorted(module.state_dict().items()))
    return hashlib.sha256(b"".join(parts)).digest()


def _read_hdf5(frames: bool, path: Path) -> bytes:
    found = load_recording(path, CartPole(), frames=frames)
    arrays = [part for each in found.episodes for part in (each.time, each.action, each.state, each.frame)]
    return b"".join(b"" if part is None else part.tobytes() for part in arrays)


def _read_policy(path: Path) -> bytes:
    load_source(path)
    return _values(load_policy(path))


def _read_training(path: Path) -> bytes:
    state = _training_state(path)
    more = state.resume()
    return _values(state.network) + str((state.losses, more, state.generator.get_state().tolist())).encode()


RUN = {"seed": 0, "samples": 1000, "policy SHA-256": "0" * 64, "effect": []}
MAP = """actions = [{ index = 0, scale = 2.0 }]
period = 0.04
crop = [0, 0, 240, 200]
contrast = [0.0, 150.0]
[states]
x = { index = 0 }
theta = { index = 1, scale = -1.0, offset = 0.1 }
[limits]
x = 0.9
[start]
x = 0.2
[options]
width = 240
"""
TASK = "effort = 0.5\nseconds = 4\n[goal]\nx = 0.1\n[tolerance]\nx = 0.5\ntheta = 0.05\n[limits]\ntheta = 0.3\n"
PARAMETERS = "[parameters]\ncart_mass = 0.23 # kg\npole_mass = 0.087\npole_half_length = 0.1975\nmax_force = 1.77\n"
LINE = "time,x,y,z\n" + "".join(f"{0.5 * row},{0.2 * row},0,1\n" for row in range(12))
DIAGNOSIS = {
    "schema": 2,
    "system": "cartpole",
    "verdict": "identified",
    "causes": [
        {
            "effect": "viscous_friction",
            "parameters": {"coefficient": {"value": 2.1, "unit": "N s/m", "ci90": [1.9, None]}},
            "probability": 0.98,
            "gap_closed": 0.9,
            "slight": False,
            "indistinguishable_from": [],
        }
    ],
}

READERS = {
    "csv": Reader("run.csv", _tables, (damage.damaged_text,), lambda path: load_recording(path, CartPole())),
    "reference": Reader("line.csv", _text(LINE), (damage.damaged_text,), read_reference),
    "hdf5": Reader("run.h5", partial(_hdf5, False), (damage.odd_hdf5,), partial(_read_hdf5, False)),
    "frames": Reader("film.h5", partial(_hdf5, True), (damage.odd_hdf5,), partial(_read_hdf5, True)),
    "bag": Reader(
        "run.bag",
        partial(_bags, 1),
        (),
        partial(_read_log, logs.ROS | {"command": "/motor/command.temperature"}),
    ),
    "mcap": Reader("run.mcap", partial(_bags, 2), (), partial(_read_log, logs.ROS)),
    "ulog": Reader("run.ulg", lambda folder: [logs.ulog(folder / "run")], (), partial(_read_log, logs.PX4)),
    "parameters": Reader(
        "rig.toml", _text(PARAMETERS), (damage.damaged_text,), lambda path: load_parameters(path, CartPole)
    ),
    "task": Reader("task.toml", _text(TASK), (damage.damaged_text,), lambda path: read_task(path, CartPole())),
    "map": Reader("map.toml", _text(MAP), (damage.damaged_text,), EnvMap.load),
    "policy": Reader("policy.safetensors", _policies, (damage.odd_tensors,), _read_policy),
    "training": Reader("state.safetensors", _training, (damage.odd_tensors,), _read_training),
    "renderer": Reader(
        "renderer.safetensors", _renderers, (damage.odd_tensors,), lambda path: _values(load_renderer(path))
    ),
    "settings": Reader(
        "settings.json",
        _text(json.dumps({"settings": RUN, "versions": {"python": "3"}})),
        (damage.odd_json, damage.damaged_text),
        lambda path: open_run(path.parent, RUN),
    ),
    "diagnosis": Reader(
        "found.json",
        _text(json.dumps(DIAGNOSIS)),
        (damage.odd_json, damage.damaged_text),
        lambda path: load_effects(path, CartPole()),
    ),
}
