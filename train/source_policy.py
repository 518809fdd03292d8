"""Trains the policies of the CartPole that are shipped: the one that sees frames, which `make demo` begins with, and
the one that sees states.

    python -m train.source_policy

Both are trained in the source alone, the first through the shipped renderer, and replace the weights in the package.
Interrupt it anywhere; started again, it goes on and ends with the same weights.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import tyro

from visadapt.progress import reporting
from visadapt.setups.base import Setup
from visadapt.setups.cartpole import cartpole_frames, cartpole_states
from visadapt.storage.run_folder import open_run


@dataclass(frozen=True)
class Settings:
    """What is trained, and where it goes."""

    weights: Path = Path("visadapt/weights")
    """folder of the weights that this writes"""
    work: Path = Path("runs/source")
    """folder that an interrupted training goes on from"""
    seed: int = 0


def main(settings: Settings) -> None:
    """Train what is missing in `work` and put the policies into `weights`."""
    setups: dict[str, Setup] = {"cartpole_frames": cartpole_frames(), "cartpole_states": cartpole_states()}
    with reporting() as report:
        for name, setup in setups.items():
            folder = settings.work / name
            open_run(folder, {"seed": settings.seed, **setup.settings.numbers()})
            setup.pretrain(folder / "policy.safetensors", settings.seed, report)
            shutil.copy(folder / "policy.safetensors", settings.weights / f"{name}.safetensors")


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
