"""Episodes of a target, each kept once it is over, so that an interrupted round loses at most the one that ran."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from visadapt.policies import Policy
from visadapt.recordings import Episode
from visadapt.storage.checkpoints import fitting, load_tree, save_tree
from visadapt.targets import Target, TargetError
from visadapt.targets.rollout import Run, run

CUT = "-cut"  # Ends the name of the file of an episode that ends where the target failed
EXPLORATION = 0.05  # Standard deviation of white noise on the commands while data are collected


class Kept:
    """The episodes of an unfinished collection in a folder, with the random numbers that follow each."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def load(self, generator: torch.Generator) -> list[Episode]:
        """The episodes kept so far; `generator` goes on from the last of them."""
        episodes = []
        for path in self._files():
            tree = load_tree(path)
            with fitting(path):
                arrays: dict[str, Any] = {
                    name: None if one is None else one.numpy() for name, one in tree["episode"].items()
                }
                episodes.append(Episode(**arrays))
                generator.set_state(tree["generator"])
        return episodes

    def cut(self) -> list[int]:
        """Which of them, from 0 on, end where the target failed."""
        return [number for number, path in enumerate(self._files()) if path.stem.endswith(CUT)]

    def add(self, number: int, episode: Episode, generator: torch.Generator, cut: bool) -> None:
        """Keep the episode of this number; `cut`: it ends where the target failed."""
        self.folder.mkdir(parents=True, exist_ok=True)
        arrays = {name: None if one is None else torch.from_numpy(one) for name, one in asdict(episode).items()}
        name = f"{number:06d}{CUT if cut else ''}.safetensors"
        save_tree(self.folder / name, {"episode": arrays, "generator": generator.get_state()})

    def remove(self) -> None:
        """Once the episodes are written elsewhere."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _files(self) -> list[Path]:
        return sorted(self.folder.glob("*.safetensors"))


def collect(
    policy: Policy,
    target: Target,
    wanted: int,
    longest: int,
    generator: torch.Generator,
    added: Tensor | None = None,
    kept: Kept | None = None,
) -> list[Episode]:
    """Episodes of `wanted` samples under `policy`, one after the other as on a machine.

    Args:
        longest: samples of an episode.
        added: (steps, n_action), added to the commands of each.
        kept: where each episode is kept once it is over, and what a target showed before it failed; a collection that
            was interrupted goes on after these.
    """
    episodes = kept.load(generator) if kept else []

    def keep(runs: Sequence[Run], cut: bool) -> None:
        episodes.append(runs[0].episode)
        if kept:
            kept.add(len(episodes), episodes[-1], generator, cut)

    failed = partial(keep, cut=True) if kept else None
    wanted -= sum(episode.samples for episode in episodes)
    while wanted > 0:
        runs = run(target, policy, 1, min(wanted, longest), generator, EXPLORATION, added, failed=failed)
        if runs[0].episode.samples == 0:
            raise TargetError(f"{target.name}: the episode is over before its first step")
        keep(runs, cut=False)
        wanted -= episodes[-1].samples
    return episodes
