"""From a policy that never saw the target to one tuned on it, from pixels: gymnasium's InvertedPendulum-v5 (MuJoCo).

    python -m train.inverted_pendulum [--budget 500] [--seeds 0 1 2] [--out runs/inverted_pendulum]

The target is one that no one here wrote. The source model is a cart-pole with the masses, length, gear and gravity
that the environment publishes; nothing else. In order:

    1. the renderer learns how the environment looks, from its frames at set states: a calibration of the camera that
       runs no step of the target and is not counted
    2. encoder and policy are trained in the source model alone, seen through that renderer
    3. for every seed: at most `budget` counted samples of the target, states estimated from their frames alone, a
       residual grounded on them and the policy tuned through renderer, residual and physics, round by round
    4. scores before and after, and what viscous friction and pole damping would explain of the gap that was met

Writes film.mp4, film.png (before, and after with the first seed), losses.png, renderer.png and metrics.json to `out`,
and the rows of results/inverted_pendulum.csv. Interrupt it anywhere; started again, it goes on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch import Tensor

from experiments.curves import plot_losses
from experiments.kept_scores import kept_score
from experiments.learnt_camera import learnt_renderer
from experiments.result_tables import Row, speed_row, write_rows
from renderers import LayeredRenderer
from visadapt.evaluation import CartPoleScore
from visadapt.films.cartpole_film import CartPoleFilm, CartPolePanel
from visadapt.learning.grounding import gap
from visadapt.learning.windows import Windows
from visadapt.policies import Policy
from visadapt.progress import Report, reporting, staged
from visadapt.recordings import Episode
from visadapt.setups.base import Setup
from visadapt.setups.cartpole import cartpole_frames
from visadapt.storage.run_folder import open_run, write_json
from visadapt.targets import Observation, SyntheticTarget, Target, TargetError
from visadapt.targets.gymnasium import GymnasiumTarget
from visadapt.targets.inverted_pendulum import MAP, REACH_M, SOURCE, START, inverted_pendulum
from visadapt.targets.rollout import Run, film_run
from visadapt.world import World

ANGLE_LIMIT = 0.2
"""rad, beyond which the environment ends an episode"""
GUESS = (59.5, 68.8, 60.0, 0.75)
"""Of the camera, from a look at the frames."""


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
    adaptations: dict[int, dict[str, Any]] = {}
    films: list[tuple[str, Run]] = []

    def look(name: str, where: Target, policy: Policy) -> None:
        scores[name] = kept_score(out / f"{name}.json", policy, where, settings.episodes)
        print(f"{name}: {scores[name]}", flush=True)

    with reporting() as report:
        world = World(SOURCE, period=target.period)
        setup = cartpole_frames(world, _renderer(settings, target, report))
        source = out / "source" / "policy.safetensors"
        policy = setup.pretrain(source, 0, report)
        look("source", SeenSource(setup), policy)
        look("before", target, policy)
        films.append(("InvertedPendulum-v5, before", film_run(target, policy)))
        for seed in settings.seeds:
            policy = setup.load(source)
            work, budget, in_round = out / f"seed-{seed}", settings.budget, settings.round_samples
            adapted = setup.adapt(policy, target, work, budget, in_round, seed, report)
            look(f"after-{seed}", target, policy)
            adaptations[seed] = {"ledger": asdict(adapted.ledger), "gap": _gap(world, adapted.episodes)}
            if len(films) == 1:
                films.append((f"after {adapted.ledger.used:,} samples", film_run(target, policy)))
                plot_losses(out / "losses.png", adapted.rounds)
        film = CartPoleFilm(_panels(films), target.period)
        film.write_still(out / "film.png", t=5.0)
        film.write(out / "film.mp4", staged(report, "film"))
    about = {**about, "seeds": settings.seeds, "not counted": f"{settings.frames} frames at set states"}
    numbers = {name: asdict(each) for name, each in scores.items()}
    write_json(out / "metrics.json", {"scores": numbers, "adaptations": adaptations, **about})
    write_rows(settings.results, _rows(scores, adaptations))
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


def _gap(source: World, episodes: list[Episode]) -> dict[str, float]:
    """Viscous friction and pole damping that explain most of the gap in the velocities, by least squares.

    From states estimated from frames, so nothing privileged; `explained` is the share of its mean square explained.
    """
    windows = Windows.cut(episodes, "state")
    left = gap(source, windows)[:, 1::2]
    state = (windows.state + windows.next_state) / 2

    def pushed(load: Tensor) -> Tensor:
        """Velocities (N, 2) gained in a period under a load (N, 2) of force and torque."""
        with_load, without = (source.system.derivative(state, windows.action, at) for at in (load, 0 * load))
        return source.period * (with_load - without)[:, 1::2]

    nothing = torch.zeros(len(state))
    friction = pushed(torch.stack((-state[:, 1], nothing), 1))
    damping = pushed(torch.stack((nothing, -state[:, 3]), 1))
    unit = left.square().mean(0).sqrt()
    design = torch.stack([(part / unit).flatten() for part in (friction, damping)], 1)
    wanted = (left / unit).flatten()
    found = torch.linalg.lstsq(design, wanted[:, None]).solution[:, 0]
    explained = 1 - (wanted - design @ found).square().mean() / wanted.square().mean()
    return {"viscous_friction": float(found[0]), "pole_damping": float(found[1]), "explained": float(explained)}


def _rows(scores: dict[str, CartPoleScore], adaptations: dict[int, dict[str, Any]]) -> list[Row]:
    """Speeds before and after, and what the gap is: the spread of these is over seeds."""
    used = max(sum(steps for _, steps in each["ledger"]["entries"]) for each in adaptations.values())
    what, system, method = "inverted_pendulum", "InvertedPendulum-v5", "ours, frames alone"
    after = [scores[f"after-{seed}"] for seed in adaptations]
    rows = [
        speed_row(what, "unadapted", "source", 0, [scores["source"]], system),
        speed_row(what, "unadapted", "target", 0, [scores["before"]], system),
        speed_row(what, method, "adapted", used, after, system),
    ]
    for key, unit in {"viscous_friction": "N s/m", "pole_damping": "N m s/rad", "explained": "1"}.items():
        found = np.array([each["gap"][key] for each in adaptations.values()])
        mean, std = round(float(found.mean()), 4), round(float(found.std()), 4)
        rows.append(Row(what, system, method, "target", used, f"gap: {key}", unit, mean, std, None, 0, len(found)))
    return rows


if __name__ == "__main__":
    try:
        main(tyro.cli(Settings, description=__doc__))
    except (TargetError, ValueError, OSError) as error:
        raise SystemExit(f"inverted_pendulum: {error}") from error
    except KeyboardInterrupt:
        raise SystemExit("interrupted: run it again to go on") from None
