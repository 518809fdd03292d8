"""A short training as a job of `experiments.parallel`, which new processes find here."""

import time
from dataclasses import dataclass
from pathlib import Path

import torch

from experiments.parallel import Jobs
from visadapt.learning.tuning import TuneSettings, tune
from visadapt.policies import StatePolicy
from visadapt.systems import CartPole
from visadapt.tasks.balance import PAPER_CARTPOLE, Balance
from visadapt.world import World


@dataclass(frozen=True)
class Settings:
    folder: Path
    jobs: Jobs = 2


def tuned(settings: Settings, seed: int) -> list[float]:
    """Losses of a short training; leaves a file for every attempt."""
    torch.set_num_threads(1)
    (settings.folder / f"{seed}-{time.time_ns()}").touch()
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    task = TuneSettings(Balance(PAPER_CARTPOLE), iterations=30, batch=4)
    losses = tune(StatePolicy(4), World(CartPole()), None, task, generator)
    time.sleep(1.0)  # so that the node is lost while jobs run on it
    return losses
