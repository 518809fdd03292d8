"""The source policies of the vehicles: what `benchmarks.flight` starts from.

    python -m train.flight_policies [--vehicles quadrotor fixed_wing]

Writes visadapt/weights/<vehicle>.safetensors, trained in the source alone by backpropagation through the physics, and
prints how far 100 flights that were not trained on miss. Interrupt it anywhere; started again, it goes on.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

from datasets import quadrotor_references
from experiments.flights import flight_target
from visadapt.evaluation import score
from visadapt.progress import reporting
from visadapt.setups.base import Setup
from visadapt.setups.flight import fixed_wing, quadrotor
from visadapt.systems import FixedWing, Quadrotor
from visadapt.systems.parameter_file import ParameterFileError, load_parameters
from visadapt.world import World


@dataclass(frozen=True)
class Settings:
    """What is trained, and where it goes."""

    vehicles: tuple[str, ...] = ("quadrotor", "fixed_wing")
    params: Path | None = None
    """a TOML file with the parameters of one's own vehicle, in its table [parameters]; give --out too"""
    seed: int = 0
    out: Path = Path("visadapt/weights")


def main(settings: Settings) -> None:
    """Train what is missing."""
    torch.set_num_threads(1)
    with reporting() as report:
        for name in settings.vehicles:
            setup = vehicle(name, settings)
            began = time.perf_counter()
            policy = setup.pretrain(settings.out / f"{name}.safetensors", settings.seed, report)
            took = time.perf_counter() - began
            print(f"{name}: {score(policy, flight_target(setup))} in the source; {took:.0f} s", flush=True)


def vehicle(name: str, settings: Settings) -> Setup:
    """A vehicle, the default one or that of a file, and what it is to fly."""
    if name == "fixed_wing":
        wing = load_parameters(settings.params, FixedWing) if settings.params else FixedWing()
        return fixed_wing(World(wing))
    train, test = quadrotor_references.ready()
    own = load_parameters(settings.params, Quadrotor) if settings.params else Quadrotor()
    return quadrotor(train, test, World(own, period=train.period, substeps=2))


if __name__ == "__main__":
    try:
        main(tyro.cli(Settings, description=__doc__))
    except ParameterFileError as error:
        raise SystemExit(f"flight_policies: {error}") from error
