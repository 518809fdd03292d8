"""The source policies of the vehicles: what `benchmarks.flight` starts from.

    python -m train.flight_policies [--vehicles quadrotor fixed_wing]

Writes assets/<vehicle>.safetensors, trained in the source alone by backpropagation through the physics, and prints
how far 100 flights that were not trained on miss. Interrupt it anywhere; started again, it goes on.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

from datasets import quadrotor_references
from visadapt.progress import reporting
from visadapt.setups.flight import Flight, fixed_wing, quadrotor, score
from visadapt.systems import FixedWing, Quadrotor
from visadapt.systems.parameter_file import ParameterFileError, load_parameters
from visadapt.tasks.courses import AlongReferences


@dataclass(frozen=True)
class Settings:
    """What is trained, and where it goes."""

    vehicles: tuple[str, ...] = ("quadrotor", "fixed_wing")
    params: Path | None = None
    """a TOML file with the parameters of one's own vehicle, in its table [parameters]; give --out too"""
    references: Path = Path("data/quadrotor_references.npz")
    """made where it is not there"""
    seed: int = 0
    out: Path = Path("assets")


def main(settings: Settings) -> None:
    """Train what is missing."""
    torch.set_num_threads(1)
    with reporting() as report:
        for name in settings.vehicles:
            flight = made(name, settings.references, settings.params)
            began = time.perf_counter()
            policy = flight.pretrain(settings.out / f"{name}.safetensors", settings.seed, report)
            took = time.perf_counter() - began
            print(f"{name}: {score(flight.target(), policy, seed=2026)} in the source; {took:.0f} s", flush=True)


def made(vehicle: str, references: Path, params: Path | None = None) -> Flight:
    """A vehicle, the default one or that of a file, and its courses."""
    if vehicle == "fixed_wing":
        return fixed_wing(system=load_parameters(params, FixedWing) if params else None)
    train, test = quadrotor_references.ready(references)
    own = load_parameters(params, Quadrotor) if params else None
    return quadrotor(AlongReferences(train), AlongReferences(test), own)


if __name__ == "__main__":
    try:
        main(tyro.cli(Settings, description=__doc__))
    except ParameterFileError as error:
        raise SystemExit(f"flight_policies: {error}") from error
