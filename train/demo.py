"""From a policy that fails on the target to one that holds it, from pixels: what `make demo` runs.

    python -m train.demo [--from-scratch] [--budget 1000] [--out runs/demo]

A CartPole policy was trained in the source simulator. On the target a hidden force of 2 (sin t + 1) N pushes the
cart. The demo executes the policy there for at most `budget` counted samples, learns what is different from the
camera's frames alone, tunes the policy in closed loop by backpropagation through renderer, residual and physics, and
writes

    film.mp4      source, target before, target after, side by side
    film.png      a still of it
    losses.png    both losses over the rounds
    metrics.json  scores, the ledger of target samples, settings and versions

Interrupt it anywhere; started again, it goes on and ends with the same numbers.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import tyro

from experiments.curves import plot_losses
from experiments.endings import ends_in_one_line
from experiments.film_runs import film_run
from experiments.kept_scores import kept_score
from renderers import DrawnCartPole
from train import renderer as renderer_training
from visadapt.evaluation import CartPoleScore
from visadapt.films.cartpole_film import CartPoleFilm, CartPolePanel
from visadapt.progress import reporting, staged
from visadapt.setups.cartpole import cartpole_frames
from visadapt.storage.run_folder import open_run, write_json
from visadapt.targets import SyntheticTarget, Target, no_effects, sine_force
from visadapt.targets.rollout import Run
from visadapt.weights import shipped


@dataclass(frozen=True)
class Settings:
    """What is adapted, and where results go."""

    from_scratch: bool = False
    """train renderer, encoder and source policy too, instead of taking the shipped ones"""
    budget: int = 1000
    """N: target samples in all, all counted"""
    round_samples: int = 200
    """B: target samples in a round"""
    episodes: int = 100
    """episodes of each evaluation"""
    seed: int = 0
    out: Path = Path("runs/demo")


def main(settings: Settings) -> None:
    """Run the demo in `settings.out`, going on from what is there."""
    out = settings.out / "from-scratch" if settings.from_scratch else settings.out
    stream = DrawnCartPole()
    source, target = SyntheticTarget(no_effects, stream), SyntheticTarget(sine_force, stream)
    setup = cartpole_frames(renderer=_renderer(settings, out))
    chosen = {key: value for key, value in asdict(settings).items() if key != "out"}
    about = open_run(out, {**chosen, "training": setup.settings.numbers()})
    scores: dict[str, CartPoleScore] = {}
    films: list[tuple[str, Run]] = []

    def look(name: str, title: str, where: Target) -> None:
        """Score the policy as it is now, and film one episode."""
        scores[name] = kept_score(out / f"{name}.json", policy, where, settings.episodes)
        print(f"{title}: {scores[name]}", flush=True)
        films.append((title, film_run(where, policy)))

    with reporting() as report:
        if settings.from_scratch:
            policy = setup.pretrain(out / "policy.safetensors", settings.seed, report)
        else:
            policy = setup.load(shipped("cartpole_frames"))
        look("source", "Source, 0 samples", source)
        look("before", "Target, before", target)
        adapted = setup.adapt(policy, target, out, settings.budget, settings.round_samples, settings.seed, report)
        look("after", f"Target, after {adapted.ledger.used:,} samples", target)
        film = CartPoleFilm([CartPolePanel(title, shown, drawn=stream) for title, shown in films], target.period)
        film.write_still(out / "film.png", t=3.0)
        film.write(out / "film.mp4", staged(report, "film"))
    plot_losses(out / "losses.png", adapted.rounds)
    numbers = {name: asdict(each) for name, each in scores.items()}
    write_json(out / "metrics.json", {"ledger": asdict(adapted.ledger), "scores": numbers, **about})
    print(f"film.mp4, film.png, losses.png and metrics.json are in {out}")


def _renderer(settings: Settings, out: Path) -> Path:
    if not settings.from_scratch:
        return shipped("renderer")
    path = out / "renderer.safetensors"
    if not path.exists():
        renderer_training.train(renderer_training.Settings(kinds=("layered",), out=out))
    return path


if __name__ == "__main__":
    with ends_in_one_line("demo"):
        main(tyro.cli(Settings, description=__doc__))
