"""From a policy that never saw the target to one tuned on it, from pixels: gymnasium's InvertedPendulum-v5 (MuJoCo).

    python -m train.inverted_pendulum [--budget 500] [--seeds 0 1 2] [--out runs/inverted_pendulum]

The target is one that no one here wrote. The source model is a cart-pole with the masses, length, gear and gravity
that the environment publishes; nothing else. In order:

    1. the renderer learns how the environment looks, from its frames at set states: a calibration of the camera that
       runs no step of the target and is not counted
    2. encoder and policy are trained in the source model alone, seen through that renderer
    3. for every seed, with at most `budget` counted samples of the target each, from frames alone:
       a residual grounded on them and the policy tuned with it, round by round;
       or, in one round, a diagnosis of them and the policy tuned in the source with the effects that it names
    4. scores before and after

Writes film.mp4, film.png (before, and after a diagnosis with the first seed), losses.png, renderer.png and metrics.json
to `out`, and the rows of results/inverted_pendulum.csv. Interrupt it anywhere; started again, it goes on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
import tyro

from experiments.curves import plot_losses
from experiments.endings import ends_in_one_line
from experiments.film_runs import film_run
from experiments.kept_scores import kept_score
from experiments.learnt_camera import learnt_renderer
from experiments.result_tables import Row, speed_row, write_rows
from renderers import LayeredRenderer
from visadapt.evaluation import CartPoleScore
from visadapt.films.cartpole_film import CartPoleFilm, CartPolePanel
from visadapt.policies import Policy
from visadapt.progress import Report, reporting, staged
from visadapt.setups.base import Setup
from visadapt.setups.cartpole import cartpole_frames
from visadapt.storage.run_folder import open_run, write_json
from visadapt.targets import Observation, SyntheticTarget, Target
from visadapt.targets.gymnasium import GymnasiumTarget
from visadapt.targets.inverted_pendulum import MAP, REACH_M, SOURCE, START, inverted_pendulum
from visadapt.targets.rollout import Run
from visadapt.world import World

ANGLE_LIMIT = 0.2
"""rad, beyond which the environment ends an episode"""
GUESS = (59.5, 68.8, 60.0, 0.75)
"""Of the camera, from a look at the frames."""
METHODS = {"ours, frames alone": ("residual", False), "ours, frames alone, diagnosed": ("diagnosed", True)}
"""By name in the table: the name of its folders, and whether the samples are diagnosed."""


@dataclass(frozen=True)
class Settings:
    """What is adapted, and where results go."""

    budget: int = 500
    """N: target samples in all, all counted"""
    round_samples: int = 100
    """B: target samples in a round"""
    seeds: tuple[int, ...] = (0,)
    """of the adaptations; renderer and source policy are made once, with seed 0"""
    frames: int = 4000
    """of set states, that the renderer is trained on"""
    renderer_steps: int = 800
    episodes: int = 100
    """episodes of each evaluation"""
    out: Path = Path("runs/inverted_pendulum")
    results: Path = Path("results/inverted_pendulum.csv")


class SeenSource(SyntheticTarget):
    """The source physics, integrated finely, seen through the learnt renderer; it ends where the environment would."""

    def __init__(self, setup: Setup) -> None:
        super().__init__(system=SOURCE, period=setup.source.period, start=START, angle_limit=ANGLE_LIMIT)
        assert setup.observe is not None
        self.observe = setup.observe

    def _observe(self) -> Observation:
        seen = super()._observe()
        with torch.no_grad():
            frame = self.observe(seen.state.nan_to_num().clamp(-10, 10))
        inside = seen.state[:, 0].abs() <= REACH_M
        return replace(seen, alive=seen.alive & inside, frame=(255 * frame).round().clamp(0, 255).byte())


def main(settings: Settings) -> None:
    """Do the whole job in `settings.out`, going on from what is there."""
    out = settings.out
    chosen = {key: value for key, value in asdict(settings).items() if key not in ("out", "results", "seeds")}
    about = open_run(out, chosen)
    target = inverted_pendulum()
    scores: dict[str, CartPoleScore] = {}
    adaptations: dict[str, dict[str, Any]] = {}
    films: list[tuple[str, Run]] = []

    def look(name: str, where: Target, policy: Policy) -> None:
        scores[name] = kept_score(out / f"{name}.json", policy, where, settings.episodes)
        print(f"{name}: {scores[name]}", flush=True)

    with reporting() as report:
        setup = cartpole_frames(World(SOURCE, period=target.period), _renderer(settings, target, report))
        source = out / "source" / "policy.safetensors"
        policy = setup.pretrain(source, 0, report)
        look("source", SeenSource(setup), policy)
        look("before", target, policy)
        films.append(("InvertedPendulum-v5, before", film_run(target, policy)))
        for seed in settings.seeds:
            for method, (name, diagnose) in METHODS.items():
                policy, work, budget = setup.load(source), out / f"{name}-{seed}", settings.budget
                in_round = budget if diagnose else settings.round_samples
                adapted = setup.adapt(policy, target, work, budget, in_round, seed, report, diagnose=diagnose)
                look(f"after-{name}-{seed}", target, policy)
                found = adapted.rounds[-1].explanation
                named = {one.name: {p.name: float(getattr(one, p.name)) for p in one.table} for one in found.effects}
                adaptations[f"{method}, seed {seed}"] = {
                    "ledger": asdict(adapted.ledger),
                    "verdict": found.verdict,
                    "effects": named,
                }
                if diagnose and len(films) == 1:
                    films.append((f"after {adapted.ledger.used:,} samples", film_run(target, policy)))
                if not diagnose and seed == settings.seeds[0]:
                    plot_losses(out / "losses.png", adapted.rounds)
        film = CartPoleFilm(_panels(films), target.period)
        film.write_still(out / "film.png", t=5.0)
        film.write(out / "film.mp4", staged(report, "film"))
    about = {**about, "seeds": settings.seeds, "not counted": f"{settings.frames} frames at set states"}
    numbers = {name: asdict(each) for name, each in scores.items()}
    write_json(out / "metrics.json", {"scores": numbers, "adaptations": adaptations, **about})
    write_rows(settings.results, _rows(settings, scores))
    print(f"film.mp4, film.png, losses.png and metrics.json are in {out}, the table is {settings.results}")


def _renderer(settings: Settings, target: GymnasiumTarget, report: Report) -> LayeredRenderer:
    """Learnt from the environment's frames at set states."""
    reach = torch.tensor([1.0, 0.0, 0.35, 0.0])
    states = reach * (2 * torch.rand(settings.frames, 4, generator=torch.Generator().manual_seed(0)) - 1)
    path = settings.out / "renderer.safetensors"
    return learnt_renderer(path, states, target.show, GUESS, settings.renderer_steps, report)


def _panels(films: Sequence[tuple[str, Run]]) -> list[CartPolePanel]:
    """The runs as the environment draws them at the states that they went through, larger than the policy sees them."""
    options = {**MAP.options, "width": 480, "height": 400}
    view = replace(MAP, crop=(0, 0, 480, 400), width=480, height=400, options=options)
    large = GymnasiumTarget("InvertedPendulum-v5", view)
    panels = []
    for title, shown in films:
        assert shown.episode.state is not None
        picture = large.show(shown.episode.state)
        panels.append(CartPolePanel(title, shown, picture, angle_limit=ANGLE_LIMIT))
    return panels


def _rows(settings: Settings, scores: dict[str, CartPoleScore]) -> list[Row]:
    """Speeds before and after."""
    what, system = "inverted_pendulum", "InvertedPendulum-v5"
    rows = [
        speed_row(what, "unadapted", "source", 0, [scores["source"]], system),
        speed_row(what, "unadapted", "target", 0, [scores["before"]], system),
    ]
    for method, (name, _) in METHODS.items():
        after = [scores[f"after-{name}-{seed}"] for seed in settings.seeds]
        rows.append(speed_row(what, method, "adapted", settings.budget, after, system))
    return rows


if __name__ == "__main__":
    with ends_in_one_line("inverted_pendulum"):
        main(tyro.cli(Settings, description=__doc__))
