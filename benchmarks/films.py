"""Diagnosis of films: one effect each, of the camera or of motion, or none: python -m benchmarks.films

Films of the drawn cart-pole, with 8 bits and 2 grey levels of noise, that the shipped renderer explains. The camera's
faults are made by the library's own effects, so this shows what is told apart, not how other cameras fare.
"""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import visadapt as va
from renderers import DrawnCartPole, load_renderer
from visadapt.effects import EFFECTS, CameraEffect, Effect

NOISE = 2.0  # Grey levels

CASES: dict[str, dict[str, dict[str, float]]] = {
    "none": {},
    "camera_shift": {"camera_shift": {"dx": 0.0, "dy": -5.0}},
    "camera_rotation": {"camera_rotation": {"angle": 0.08}},
    "camera_zoom": {"camera_zoom": {"scale": 1.1}},
    "blur": {"blur": {"sigma": 1.0}},
    "brightness": {"brightness": {"gain": 0.75, "offset": 0.05}},
    "gamma": {"gamma": {"exponent": 1.4}},
    "occlusion": {"occlusion": {"left": 20.0, "top": 30.0, "right": 45.0, "bottom": 55.0, "grey": 0.35}},
    "camera_delay": {"camera_delay": {"delay": 0.05}},
    "frame_drop": {"frame_drop": {"rate": 0.1}},
    "viscous_friction": {"viscous_friction": {"coefficient": 3.0}},
    "actuator_gain": {"actuator_gain": {"scale": 0.8}},
    "rotation and friction": {"camera_rotation": {"angle": 0.08}, "viscous_friction": {"coefficient": 3.0}},
}


def film(effects: list[Effect], episodes: int, rows: int, seed: int) -> list[va.Episode]:
    """Episodes of frames and commands of a policy with noise, which itself sees an unaltered camera."""
    motion = [effect for effect in effects if not isinstance(effect, CameraEffect)]
    target = va.SyntheticTarget(lambda batch, generator: motion, camera=DrawnCartPole())
    generator = torch.Generator().manual_seed(seed)
    policy = va.load_policy(va.shipped("cartpole_frames"))
    runs = va.run(target, policy, episodes, rows, generator, exploration=0.4)
    noise = np.random.default_rng(seed)
    return [_filmed(one.episode, effects, generator, noise) for one in runs if len(one.episode.time) > 15]


def _filmed(
    episode: va.Episode, effects: list[Effect], generator: torch.Generator, noise: np.random.Generator
) -> va.Episode:
    world = va.World(va.CartPole(), [effect for effect in effects if isinstance(effect, CameraEffect)])
    assert episode.state is not None
    states = torch.from_numpy(episode.state)
    at, grain = world.start(states[:1]), torch.zeros(1)
    clean: list[torch.Tensor] = []
    frames: list[torch.Tensor] = []

    def draw(state: torch.Tensor) -> torch.Tensor:
        drawn = torch.from_numpy(DrawnCartPole()(state[:, 0].double().numpy(), state[:, 2].double().numpy()))
        return drawn.float() / 255

    for state in states:
        seen, at = world.show(replace(at, state=state[None]), draw, generator)
        # A frame that is shown again has the noise of the first time.
        if not clean or not torch.equal(seen, clean[-1]):
            grain = torch.from_numpy(NOISE * noise.standard_normal(seen.shape))
        clean.append(seen)
        frames.append((255 * seen + grain).round().clamp(0, 255).to(torch.uint8))
    return va.Episode(time=episode.time, action=episode.action, frame=torch.cat(frames).numpy())


def main(names: list[str]) -> None:
    """Diagnose the films of these cases, all of them by default, and print a line for each."""
    renderer = load_renderer(Path(va.shipped("renderer"))).requires_grad_(False)
    for name in names or CASES:
        effects = [EFFECTS[effect](**values).requires_grad_(False) for effect, values in CASES[name].items()]
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "film.h5"
            va.write_recording(path, film(effects, 6, 60, 100 + list(CASES).index(name)))
            recording = va.load_recording(path, va.CartPole(), frames=True)
        began = time.perf_counter()
        found = va.diagnose(recording, va.World(va.CartPole()), renderer=renderer)
        carrying = [cause for cause in found.causes if not cause.slight]
        named = "; ".join(
            f"{cause.effect}({', '.join(f'{p}={one.value:.5g}' for p, one in cause.parameters.items())})"
            for cause in carrying
        )
        stages = "; ".join(f"{stage} {share:.2f}" for stage, share in found.where.stages.items() if share > 0)
        truth = "; ".join(f"{e}({', '.join(f'{p}={v:g}' for p, v in vs.items())})" for e, vs in CASES[name].items())
        seconds = f"{time.perf_counter() - began:.0f} s"
        print(truth or "none", found.verdict, named, stages, recording.samples, seconds, sep=" | ", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
