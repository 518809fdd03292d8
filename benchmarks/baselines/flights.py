"""The paper's vehicles under drag (its Tables 1 and 3), as the baselines are set them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from benchmarks.baselines.problem import Problem, Sizes
from datasets import quadrotor_references
from experiments.flights import EXPERIMENTS, FlightExperiment, flight_target
from experiments.kept_scores import read_score
from experiments.result_tables import Row, miss_row
from visadapt.evaluation import FlightScore
from visadapt.setups.base import Setup
from visadapt.targets import FlightTarget
from visadapt.targets.synthetic import no_effects


@dataclass(frozen=True)
class FlightProblem(Problem):
    """A vehicle on courses that were not trained on, under what `benchmarks.flight` hides."""

    experiment: FlightExperiment

    baselines = ("mpc", "ppo", "pets")

    def setup(self, sizes: Sizes) -> Setup:
        return _setup(self.name)

    def target(self) -> FlightTarget:
        setup = _setup(self.name)
        return flight_target(setup, self.experiment.effects(setup), test=False)

    def scored(self, domain: str) -> FlightTarget:
        setup = _setup(self.name)
        return flight_target(setup, no_effects if domain == "source" else self.experiment.effects(setup))

    def row(self, method: str, domain: str, samples: int, scores: Sequence[Path]) -> Row:
        found = [read_score(path, FlightScore) for path in scores]
        vehicle = self.experiment.vehicle.name
        return miss_row(self.name, vehicle, method, domain, samples, self.experiment.measure, found)

    @property
    def sizes(self) -> Sizes:
        budget, each = self.experiment.budget, self.experiment.round_samples
        return Sizes(plans=((budget, each),), scored=tuple(range(each, budget + 1, each)), source_steps=2_000_000)


@cache
def _setup(name: str) -> Setup:
    """Of one of EXPERIMENTS, whose references are read once."""
    return EXPERIMENTS[name].setup(quadrotor_references.ready)


FLIGHTS = tuple(FlightProblem(name, False, each) for name, each in EXPERIMENTS.items() if each.hidden == "drag")
