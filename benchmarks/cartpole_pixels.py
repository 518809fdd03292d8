"""The CartPole from pixels: source, target before, and the curve over counted target samples (the paper's Table 2).

    python -m benchmarks.cartpole_pixels

Each seed adapts the shipped source policy anew, in rounds of 100 samples up to 1,000, and once with 50; the policy is
scored as it stands after 50, 100, 200, 500 and 1,000 samples, on 100 episodes whose starts and phases no training
saw. No score chooses a checkpoint. Ours learns from the camera's frames alone; beside it, at 200 samples, stand
the same with rendered frames, and with the states that the target tells (as in the paper).

Writes results/cartpole_pixels.csv and assets/curve.png. Interrupt it anywhere; started again, it goes on.
"""

from __future__ import annotations

import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import tyro

from renderers import DrawnCartPole
from visadapt.evaluation.cartpole_score import Evaluation, evaluate
from visadapt.evaluation.result_tables import read_rows, say, speed_row, write_rows
from visadapt.films.plots import plot_curve
from visadapt.setups.cartpole_frames import PixelTask
from visadapt.storage.run_folder import once, open_run
from visadapt.systems import CartPole
from visadapt.targets import SyntheticTarget, no_effects, sine_force
from visadapt.targets.rollout import see_frames
from visadapt.world import World

EXPERIMENT = "CartPole, pixels, 2(sin t + 1) N"
SCORE_SEED = 2026


@dataclass(frozen=True)
class Variant:
    """One adaptation per seed, scored after some of its rounds."""

    method: str
    budget: int
    round_samples: int
    scored: tuple[int, ...]
    """samples after which the policy is scored"""
    observations: str = "camera"
    told_states: bool = False


OURS = "ours, frames alone"
VARIANTS = (
    Variant(OURS, 1000, 100, (100, 200, 500, 1000)),
    Variant(OURS, 50, 50, (50,)),
    Variant("ours, frames alone, grounded on rendered frames", 200, 100, (200,), observations="rendered"),
    Variant("ours, states told by the target", 200, 100, (200,), told_states=True),
)


@dataclass(frozen=True)
class Settings:
    """What is run, and where."""

    seeds: int = 3
    episodes: int = 100
    variants: tuple[int, ...] = tuple(range(len(VARIANTS)))
    """which of VARIANTS are run and tabled"""
    jobs: int = 2
    """adaptations at once, one core each"""
    work: Path = Path("runs/cartpole_pixels")
    out: Path = Path("results/cartpole_pixels.csv")
    picture: Path = Path("assets/curve.png")
    assets: Path = Path("assets")


def main(settings: Settings) -> None:
    """Run what is missing, then write the table."""
    jobs: list[tuple[Settings, int | None, int]] = [(settings, None, 0)]
    jobs += [(settings, number, seed) for number in settings.variants for seed in range(settings.seeds)]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(settings.jobs, mp_context=context) as pool:
        found = list(pool.map(_scores, *zip(*jobs, strict=True)))
    reference, results = found[0], dict(zip(jobs[1:], found[1:], strict=True))
    rows = [speed_row(EXPERIMENT, "unadapted", domain, 0, [reference[domain]]) for domain in ("source", "target")]
    for number in settings.variants:
        variant = VARIANTS[number]
        for samples in variant.scored:
            scores = [results[settings, number, seed][str(samples)] for seed in range(settings.seeds)]
            rows.append(speed_row(EXPERIMENT, variant.method, "adapted", samples, scores))
    write_rows(settings.out, rows)
    drawn = [row for row in read_rows(settings.out) if row["method"] in (OURS, "unadapted")]
    plot_curve(settings.picture, drawn)
    for row in rows:
        say(row)


def _scores(settings: Settings, number: int | None, seed: int) -> dict[str, Evaluation]:
    """Scores of one job by samples: of the unadapted policy, or of one seed of a variant."""
    torch.set_num_threads(1)
    stream = DrawnCartPole()
    source, target = SyntheticTarget(no_effects, stream), SyntheticTarget(sine_force, stream)
    task = PixelTask.load_renderer(World(CartPole()), settings.assets / "renderer.safetensors")
    encoder, policy = task.load(settings.assets)

    def score(where: SyntheticTarget, path: Path) -> Evaluation:
        def fresh() -> dict[str, object]:
            return asdict(evaluate(where, policy, see_frames, SCORE_SEED, settings.episodes)[0])

        return Evaluation(**once(path, fresh))

    if number is None:
        folder = settings.work / "unadapted"
        open_run(folder, {"episodes": settings.episodes})
        return {"source": score(source, folder / "source.json"), "target": score(target, folder / "target.json")}
    variant = VARIANTS[number]
    folder = settings.work / f"variant-{number}" / f"seed-{seed}"
    open_run(folder, {"seed": seed, "episodes": settings.episodes, **asdict(variant), **asdict(task.settings)})
    adapted = task.adapt(
        policy,
        encoder,
        target,
        folder,
        variant.budget,
        variant.round_samples,
        seed,
        variant.observations,
        variant.told_states,
    )
    scores = {}
    for samples in variant.scored:
        adapted.restore(policy, samples)
        scores[str(samples)] = score(target, folder / f"score-{samples}.json")
    return scores


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
