"""A film of one episode of a policy on a target, whatever both are."""

from __future__ import annotations

import os

import torch

from visadapt.evaluation.cartpole_score import EPISODE_STEPS
from visadapt.films.cartpole_panel import Panel
from visadapt.films.flight_film import FlownPanel, write_flight_film
from visadapt.films.video import write_film
from visadapt.policies import Policy
from visadapt.systems import CartPole
from visadapt.targets import FlightTarget, SyntheticTarget, Target
from visadapt.targets.rollout import FILM_SEED, run


def film(
    policy: Policy,
    target: Target,
    path: str | os.PathLike[str],
    title: str = "",
    seed: int = FILM_SEED,
    steps: int | None = None,
) -> None:
    """Run `policy` for one episode on `target` and film it as an mp4 (H.264); its steps are not counted.

    Args:
        title: over the film; the target's name without it.
        seed: of the start and of the hidden effects.
        steps: at most; the task's without it, or 250.

    Raises:
        ValueError: a target that no film is known of: neither flights nor a cart on a track.
        DiskFullError: the disk is full; nothing stands under the film's name that did not before.

    >>> import visadapt as va, tempfile, pathlib
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "film.mp4"
    >>> va.film(va.load_policy(va.shipped("cartpole_states")), va.SyntheticTarget(), path, steps=3)
    >>> path.exists()
    True
    """
    title, generator = title or target.name, torch.Generator().manual_seed(seed)
    policy.eval()
    if isinstance(target, FlightTarget):
        flown = run(target, policy, 1, steps or target.task.steps, generator, strict=False)[0]
        write_flight_film(path, [FlownPanel(title, flown, target.system, target.task, target.first[0])])
        return
    if target.n_action != len(CartPole.actions) or policy.n_state != len(CartPole.states):
        raise ValueError(f"{target.name}: no film is known of it; flights and carts on a track can be filmed")
    shown = run(target, policy, 1, steps or EPISODE_STEPS, generator)[0]
    if isinstance(target, SyntheticTarget):
        panel = Panel.redrawn(title, shown, target.camera, target.angle_limit)
    elif shown.episode.frame is not None:
        panel = Panel(title, shown, shown.episode.frame, force_known=False)
    else:
        panel = Panel.redrawn(title, shown)
    write_film(path, [panel], target.period)
