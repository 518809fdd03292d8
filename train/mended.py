"""A film diagnosed, and the policy mended by what was named: the first picture of the README.

    python -m train.mended [--samples 300] [--out runs/mended]

The CartPole policy of the package sees frames alone. On this target the camera was turned by 0.05 rad, about 3 degrees,
and the motor gives 0.6 of the force that is asked of it; nobody tells. The policy is run for 300 counted samples; their
frames and commands are diagnosed, and the policy is tuned in the simulator with what is named, through the camera that
is named: `visadapt adapt --diagnose`. Writes the run, scores.json and mended.png, and goes on when interrupted.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.curves import save_figure
from experiments.film_runs import film_run
from experiments.kept_scores import kept_score
from renderers import DrawnCartPole
from visadapt.diagnosis.result import Estimate
from visadapt.diagnosis.words import estimate, interval, plain, with_unit
from visadapt.effects import ActuatorGain, CameraRotation
from visadapt.evaluation import CartPoleScore
from visadapt.films.widgets import INK, MUTED, STYLE, TEAL
from visadapt.progress import reporting
from visadapt.setups.cartpole import cartpole_frames
from visadapt.storage.run_folder import open_run, read_json, write_json
from visadapt.targets import SyntheticTarget
from visadapt.targets.rollout import Run
from visadapt.weights import shipped

HIDDEN = {"camera_rotation": 0.05, "actuator_gain": 0.6}
"""rad; share of the commanded force"""
SHOWN_AT = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)  # s, of the frames in the picture


@dataclass(frozen=True)
class Settings:
    """What is run, and where."""

    samples: int = 300
    """of the target, counted, in one round"""
    episodes: int = 100
    """of a score"""
    seed: int = 0
    out: Path = Path("runs/mended")


def main(settings: Settings) -> None:
    """Score, adapt, score again; draw both runs and what was named between them."""
    effects = [CameraRotation(angle=HIDDEN["camera_rotation"]), ActuatorGain(scale=HIDDEN["actuator_gain"])]
    target = SyntheticTarget(lambda batch, generator: effects, DrawnCartPole())
    setup = cartpole_frames()
    policy = setup.load(shipped("cartpole_frames"))
    out = settings.out
    about = open_run(out, {key: value for key, value in asdict(settings).items() if key != "out"})
    before = kept_score(out / "before.json", policy, target, settings.episodes)
    runs = [film_run(target, policy)]
    print(f"before: {before}", flush=True)
    with reporting() as report:
        samples = settings.samples
        setup.adapt(policy, target, out, samples, samples, settings.seed, report, diagnose=True)
    after = kept_score(out / "after.json", policy, target, settings.episodes)
    runs.append(film_run(target, policy))
    print(f"after {samples} samples: {after}")
    found = read_json(out / "round-01" / "diagnosis.json")
    write_json(out / "scores.json", {"before": asdict(before), "after": asdict(after), "hidden": HIDDEN, **about})
    draw(out / "mended.png", runs, [before, after], found, settings.samples)


@matplotlib.rc_context(STYLE)
def draw(path: Path, runs: list[Run], scores: list[CartPoleScore], found: dict[str, Any], samples: int) -> None:
    """Write the picture: frames of the runs before and after, as the policy saw them, and the diagnosis in between."""
    figure = Figure(figsize=(10.4, 5.6), dpi=150)
    titles = ("Before", f"After {samples} samples")
    width = 0.155
    for bottom, title, run, score in zip((0.63, 0.05), titles, runs, scores, strict=True):
        figure.text(0.02, bottom + 0.29, f"{title}: {_in_words(score)}", va="bottom", size=12, weight="bold", color=INK)
        for column, at in enumerate(SHOWN_AT):
            _frame(figure.add_axes((0.02 + column * (width + 0.006), bottom, width, 0.27)), run, at)
    figure.text(
        0.02,
        0.545,
        f"Diagnosis of these {samples} frames: {found['verdict']}",
        va="top",
        size=12,
        weight="bold",
        color=TEAL,
    )
    for line, cause in enumerate(found["causes"]):
        figure.text(0.02, 0.49 - 0.05 * line, _cause(cause), va="top", size=11, color=INK)
    save_figure(figure, path)


def _frame(axes: Axes, run: Run, at: float) -> None:
    """The frame of a run at `at` s, as the policy saw it; empty where the episode had ended."""
    episode = run.episode
    assert episode.frame is not None
    axes.set(xticks=[], yticks=[])
    row = round(at / (episode.time[1] - episode.time[0]))
    lasts = row < len(episode.frame)
    axes.imshow(episode.frame[row] if lasts else np.full_like(episode.frame[0], 245), cmap="gray", vmin=0, vmax=255)
    axes.set_xlabel(f"{at:g} s" if lasts else f"ended at {episode.time[-1]:.1f} s", color=MUTED)


def _in_words(score: CartPoleScore) -> str:
    up = f"{score.survived} of {score.episodes} episodes last"
    return up if score.mean_speed is None else f"{up}, mean cart speed {score.mean_speed:.3f} m/s"


def _cause(cause: dict[str, Any]) -> str:
    """A cause as JSON holds it, in a line, beside what was hidden."""
    found = {name: Estimate(**value) for name, value in cause["parameters"].items()}
    parts = [f"{name} {estimate(one)} (90 %: {interval(one)})" for name, one in found.items()]
    unit = next(iter(found.values())).unit
    line = f"{plain(cause['effect'])}: {', '.join(parts)}"
    hidden = HIDDEN.get(cause["effect"])
    return line if hidden is None else f"{line}; hidden: {with_unit(f'{hidden:g}', unit)}"


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
