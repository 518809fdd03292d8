"""From a policy that fails on the target to one that holds it, from pixels: what `make demo` runs.

    python -m train.demo [--from-scratch] [--budget 1000] [--out runs/demo]

A CartPole policy was trained in the source simulator. On the target a hidden force of 2 (sin t + 1) N pushes the
cart. The demo executes the policy there for at most `budget` counted samples, learns what is different from the
camera's frames alone, tunes the policy by backpropagation through renderer, residual and physics, and writes

    film.mp4      source, target before, target after, side by side
    film.png      a still of it
    losses.png    both losses over the rounds
    metrics.json  scores, the ledger of target samples, settings and versions

Interrupt it anywhere; started again, it goes on and ends with the same numbers.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import tyro

from renderers import DrawnCartPole
from train import renderer as renderer_training
from train.scoring import filmed, score
from visadapt.evaluation.cartpole_score import EPISODES, Evaluation
from visadapt.films.cartpole_film import CartPoleFilm, CartPolePanel
from visadapt.films.plots import plot_losses
from visadapt.progress import reporting, staged
from visadapt.setups.cartpole_frames import PixelSettings, PixelTask
from visadapt.storage.run_folder import once, open_run, write_json
from visadapt.systems import CartPole
from visadapt.targets import SyntheticTarget, Target, TargetError, no_effects, sine_force
from visadapt.targets.rollout import Run
from visadapt.world import World


@dataclass(frozen=True)
class Settings:
    """What is adapted, and where results go."""

    from_scratch: bool = False
    """train renderer, encoder and source policy too, instead of taking them from assets/"""
    budget: int = 1000
    """N: target samples in all, all counted"""
    round_samples: int = 200
    """B: target samples in a round"""
    observations: str = "camera"
    """frames that ground the residual: the target's own ("camera"), or rendered from estimated states ("rendered")"""
    told_states: bool = False
    """learn from states that the target tells, as the paper does, instead of from its frames alone"""
    episodes: int = EPISODES
    """episodes of each evaluation"""
    seed: int = 0
    out: Path = Path("runs/demo")
    assets: Path = Path("assets")


def main(settings: Settings) -> None:
    """Run the demo in `settings.out`, going on from what is there."""
    out = settings.out / "from-scratch" if settings.from_scratch else settings.out
    training = PixelSettings()
    chosen = {key: value for key, value in asdict(settings).items() if key not in ("out", "assets")}
    about = open_run(out, {**chosen, "training": asdict(training)})
    stream = DrawnCartPole()
    source, target = SyntheticTarget(no_effects, stream), SyntheticTarget(sine_force, stream)
    renderer = _renderer(settings, out)
    with reporting() as report:
        task = PixelTask.load_renderer(World(CartPole()), renderer, training)
        if settings.from_scratch:
            encoder, policy = task.pretrain(out, settings.seed, report)
        else:
            encoder, policy = task.load(settings.assets)
        scores: dict[str, dict[str, Any]] = {}
        films: list[tuple[str, Run]] = []

        def look(name: str, title: str, where: Target) -> None:
            """Score the policy as it is now, and film one episode."""
            scores[name] = once(out / f"{name}.json", lambda: score(where, policy, settings.episodes))
            print(f"{title}: {Evaluation(**scores[name])}", flush=True)
            films.append((title, filmed(where, policy)))

        look("source", "Source, 0 samples", source)
        look("before", "Target, before", target)
        adapted = task.adapt(
            policy,
            encoder,
            target,
            out,
            settings.budget,
            settings.round_samples,
            settings.seed,
            settings.observations,
            settings.told_states,
            report,
        )
        look("after", f"Target, after {adapted.ledger.used:,} samples", target)
        film = CartPoleFilm([CartPolePanel.redrawn(title, shown, stream) for title, shown in films], target.period)
        film.write_still(out / "film.png", t=3.0)
        film.write(out / "film.mp4", staged(report, "film"))
    plot_losses(out / "losses.png", adapted.rounds)
    write_json(out / "metrics.json", {"ledger": asdict(adapted.ledger), "scores": scores, **about})
    print(f"film.mp4, film.png, losses.png and metrics.json are in {out}")


def _renderer(settings: Settings, out: Path) -> Path:
    if not settings.from_scratch:
        return settings.assets / "renderer.safetensors"
    path = out / "renderer.safetensors"
    if not path.exists():
        renderer_training.train(renderer_training.Settings(kinds=("layered",), out=out))
    return path


if __name__ == "__main__":
    try:
        main(tyro.cli(Settings, description=__doc__))
    except (TargetError, ValueError, OSError) as error:
        raise SystemExit(f"demo: {error}") from error
    except KeyboardInterrupt:
        raise SystemExit("interrupted: run it again to go on") from None
