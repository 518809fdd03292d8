"""Trains what `make demo` begins with: the encoder that has learnt to see, and the CartPole policy of the source.

    python -m train.source_policy

Both are trained in the source alone, through the learnt renderer in assets/, and replace the weights in assets/.
Interrupt it anywhere; started again, it goes on and ends with the same weights.
"""

from __future__ import annotations

import shutil
from dataclasses import asdict, dataclass
from pathlib import Path

import tyro

from visadapt.progress import reporting
from visadapt.setups.cartpole_frames import PixelSettings, PixelTask
from visadapt.storage.run_folder import open_run
from visadapt.systems import CartPole
from visadapt.world import World


@dataclass(frozen=True)
class Settings:
    """What is trained, and where it goes."""

    assets: Path = Path("assets")
    """folder of renderer.safetensors, and of the weights that this writes"""
    work: Path = Path("runs/source")
    """folder that an interrupted training goes on from"""
    seed: int = 0


def main(settings: Settings) -> None:
    """Train encoder and policy and put them into `assets`."""
    training = PixelSettings()
    open_run(settings.work, {"seed": settings.seed, **asdict(training)})
    task = PixelTask.load_renderer(World(CartPole()), settings.assets / "renderer.safetensors", training)
    with reporting() as report:
        task.pretrain(settings.work, settings.seed, report)
    for name in ("encoder.safetensors", "policy.safetensors"):
        shutil.copy(settings.work / name, settings.assets / name)


if __name__ == "__main__":
    main(tyro.cli(Settings))
