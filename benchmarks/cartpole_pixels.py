"""The CartPole from pixels: source, target before, and the curve over counted target samples (the paper's Table 2).

    python -m benchmarks.cartpole_pixels

Each seed adapts the shipped source policy anew, in rounds of 100 samples up to 1,000, and once with 50; the policy is
scored as it stands after 50, 100, 200, 500 and 1,000 samples, on 100 episodes whose starts and phases no training
saw. No score chooses a checkpoint. Ours learns from the camera's frames alone; beside it, at 200 samples, stands the
same with the states that the target tells (as in the paper).

Writes results/cartpole_pixels.csv and assets/curve.png. Interrupt it anywhere; started again, it goes on.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
import tyro

from experiments.curves import plot_curve
from experiments.kept_scores import kept_score
from experiments.parallel import Jobs, in_processes
from experiments.result_tables import print_speed, read_rows, speed_row, write_rows
from renderers import DrawnCartPole
from visadapt.evaluation import CartPoleScore
from visadapt.setups.cartpole import cartpole_frames
from visadapt.storage.run_folder import open_run
from visadapt.targets import SyntheticTarget, no_effects, sine_force
from visadapt.weights import shipped

EXPERIMENT = "CartPole, pixels, 2(sin t + 1) N"


@dataclass(frozen=True)
class Variant:
    """One adaptation per seed, scored after some of its rounds."""

    method: str
    budget: int
    round_samples: int
    scored: tuple[int, ...]
    """samples after which the policy is scored"""
    states_from_target: bool = False


OURS = "ours, frames alone"
VARIANTS = (
    Variant(OURS, 1000, 100, (100, 200, 500, 1000)),
    Variant(OURS, 50, 50, (50,)),
    Variant("ours, states told by the target", 200, 100, (200,), states_from_target=True),
)


@dataclass(frozen=True)
class Settings:
    """What is run, and where."""

    seeds: int = 3
    episodes: int = 100
    variants: tuple[int, ...] = tuple(range(len(VARIANTS)))
    """which of VARIANTS are run and tabled"""
    jobs: Jobs = 2
    """adaptations at once, one core each"""
    work: Path = Path("runs/cartpole_pixels")
    out: Path = Path("results/cartpole_pixels.csv")
    picture: Path = Path("assets/curve.png")


def main(settings: Settings) -> None:
    """Run what is missing, then write the table."""
    jobs: list[tuple[int | None, int]] = [(None, 0)]
    jobs += [(number, seed) for number in settings.variants for seed in range(settings.seeds)]
    results = in_processes(_scores, settings, jobs)
    reference = results[None, 0]
    rows = [speed_row(EXPERIMENT, "unadapted", domain, 0, [reference[domain]]) for domain in ("source", "target")]
    for number in settings.variants:
        variant = VARIANTS[number]
        for samples in variant.scored:
            scores = [results[number, seed][str(samples)] for seed in range(settings.seeds)]
            rows.append(speed_row(EXPERIMENT, variant.method, "adapted", samples, scores))
    write_rows(settings.out, rows)
    drawn = [row for row in read_rows(settings.out) if row["method"] in (OURS, "unadapted")]
    plot_curve(settings.picture, drawn)
    for row in rows:
        print_speed(row)


def _scores(settings: Settings, number: int | None, seed: int) -> dict[str, CartPoleScore]:
    """Scores of one job by samples: of the unadapted policy, or of one seed of a variant."""
    torch.set_num_threads(1)
    stream = DrawnCartPole()
    source, target = SyntheticTarget(no_effects, stream), SyntheticTarget(sine_force, stream)
    setup = cartpole_frames()
    policy = setup.load(shipped("cartpole_frames"))

    def scored(where: SyntheticTarget, path: Path) -> CartPoleScore:
        return kept_score(path, policy, where, settings.episodes)

    if number is None:
        folder = settings.work / "unadapted"
        open_run(folder, {"episodes": settings.episodes})
        return {"source": scored(source, folder / "source.json"), "target": scored(target, folder / "target.json")}
    variant = VARIANTS[number]
    if variant.states_from_target:
        setup = replace(setup, label=None)
    folder = settings.work / f"variant-{number}" / f"seed-{seed}"
    about = {"seed": seed, "episodes": settings.episodes, **asdict(variant), **setup.settings.numbers()}
    open_run(folder, about)
    paths = {samples: folder / f"score-{samples}.json" for samples in variant.scored}
    if not all(path.exists() for path in paths.values()):
        adapted = setup.adapt(policy, target, folder, variant.budget, variant.round_samples, seed)
        for samples, path in paths.items():
            adapted.restore(policy, samples)
            scored(target, path)
    return {str(samples): scored(target, path) for samples, path in paths.items()}


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
