"""Control from pixels: the pieces of one task put together, pretraining in the source, adaptation to a target."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from renderers import LayeredRenderer, RendererError, load_renderer
from visadapt.effects import Residual
from visadapt.learning.grounding import GroundSettings
from visadapt.learning.joint import Adapted, AdaptSettings, adapt
from visadapt.learning.perception import PerceptionSettings, learn_to_see, scale
from visadapt.learning.policy import TuneSettings, train_or_load
from visadapt.learning.tracking import Tracker
from visadapt.policies import ImagePolicy
from visadapt.policies.networks import FrameEncoder, ImageResidualNetwork
from visadapt.progress import Report, staged
from visadapt.recordings import Episode
from visadapt.storage.checkpoints import load_network, save_network
from visadapt.targets import Target
from visadapt.targets.rollout import see_frames
from visadapt.tasks.base import Balance
from visadapt.tasks.cost import CENTRED_CARTPOLE
from visadapt.world import World

CONTRAST = 0.2
"""Grey levels, of 1, that frames are divided by before the networks see them."""


@dataclass(frozen=True)
class PixelSettings:
    """How a task from pixels is trained; defaults are the CartPole's."""

    perception: PerceptionSettings = field(default_factory=PerceptionSettings)
    source: TuneSettings = field(default_factory=lambda: TuneSettings(Balance(CENTRED_CARTPOLE), iterations=2500))
    """the policy in the source"""
    adapted: TuneSettings = field(
        default_factory=lambda: TuneSettings(
            Balance(
                CENTRED_CARTPOLE,
                start_spread=(0.3, 0.1, 0.1, 0.1),
                # A kick would look like a force to the residual, which would go on pushing.
                kick=(0.0, 0.0, 0.0, 0.0),
                divergence=(1.2, 2.0, 0.25, 3.0),
                first_divergence=0.4,
            ),
            iterations=50,
            batch=32,
            learning_rate=2e-4,
            longest=25,
            recorded=0.8,
        )
    )
    """the policy in the grounded source, in each round"""
    ground: GroundSettings = field(default_factory=GroundSettings)


class PixelTask:
    """A source world and a renderer of its states, with the networks that see through it.

    Args:
        source: the physics known beforehand; its states begin with x, x_dot, theta, theta_dot.
        renderer: states to frames, trained.
    """

    def __init__(self, source: World, renderer: LayeredRenderer, settings: PixelSettings | None = None) -> None:
        self.source = source
        self.renderer = renderer.requires_grad_(False).eval()
        self.settings = settings or PixelSettings()
        self.background = renderer.background.sigmoid().detach()

    @classmethod
    def load_renderer(cls, source: World, path: Path, settings: PixelSettings | None = None) -> PixelTask:
        """A task seen through the renderer in a file; raises RendererError where it is not a LayeredRenderer."""
        renderer = load_renderer(path)
        if not isinstance(renderer, LayeredRenderer):
            raise RendererError(f"{path}: holds a {type(renderer).__name__}, a LayeredRenderer is needed")
        return cls(source, renderer, settings)

    def observe(self, state: Tensor) -> Tensor:
        """What the camera would show of simulated states: frames (B, H, W) in [0, 1]."""
        frame: Tensor = self.renderer(state[:, 0], state[:, 2])
        return frame

    def encoder(self) -> FrameEncoder:
        """A new encoder."""
        return FrameEncoder(self.background, CONTRAST, n_action=1)

    def policy(self) -> ImagePolicy:
        """A new policy."""
        return ImagePolicy(self.background, CONTRAST)

    def residual(self, encoder: FrameEncoder) -> Residual:
        """A new residual that sees as `encoder` does, and begins at zero."""
        unit = scale(self.settings.perception, self.source.period)
        network = ImageResidualNetwork(self.background, CONTRAST, self.source.system, self.source.period, unit)
        network.encoder.load_state_dict(encoder.state_dict())
        return Residual(network, torch.ones(4))

    def pretrain(self, folder: Path, seed: int, report: Report | None = None) -> tuple[FrameEncoder, ImagePolicy]:
        """Train encoder and policy in the source alone, in `folder`, going on from what is there."""
        torch.manual_seed(seed)
        encoder, policy = self.encoder(), self.policy()
        seen = folder / "encoder.safetensors"
        if seen.exists():
            load_network(seen, encoder)
        else:
            settings, generator = self.settings.perception, torch.Generator().manual_seed(seed)
            partial = folder / "encoder.partial.safetensors"
            learn_to_see(
                encoder, self.renderer, self.source.period, settings, generator, staged(report, "perception"), partial
            )
            save_network(seen, encoder, {"seed": seed, **asdict(settings)})
            partial.unlink(missing_ok=True)
        policy.encoder.load_state_dict(encoder.state_dict())
        train_or_load(
            folder / "policy.safetensors",
            policy,
            self.source,
            self.observe,
            self.settings.source,
            torch.Generator().manual_seed(seed + 1),
            {"seed": seed, **asdict(self.settings.source)},
            staged(report, "source policy"),
        )
        return encoder, policy

    def load(self, folder: Path) -> tuple[FrameEncoder, ImagePolicy]:
        """Encoder and policy that `pretrain` left in `folder`; raises CheckpointError where they do not fit."""
        encoder, policy = self.encoder(), self.policy()
        load_network(folder / "encoder.safetensors", encoder)
        load_network(folder / "policy.safetensors", policy)
        return encoder, policy

    @cached_property
    def tracker(self) -> Tracker:
        """Estimates states from frames."""
        return Tracker(self.renderer, self.source)

    def label(self, episodes: list[Episode]) -> list[Episode]:
        """The same episodes with states estimated from their frames alone; too short ones, of 1 or 2 rows, go."""
        return [
            track.episode for track in self.tracker.track([episode for episode in episodes if len(episode.time) > 2])
        ]

    def adapt(
        self,
        policy: ImagePolicy,
        encoder: FrameEncoder,
        target: Target,
        folder: Path,
        budget: int,
        round_samples: int,
        seed: int,
        observations: str = "camera",
        told_states: bool = False,
        report: Report | None = None,
    ) -> Adapted:
        """Adapt `policy`, in place, to `target` with at most `budget` counted samples: Algorithm 1 in `folder`.

        Args:
            observations: whether grounding shows the residual the "camera"'s frames, or "rendered" ones.
            told_states: whether grounding learns from states that the target tells, as the paper does, or from
                states estimated from frames alone.
        """
        torch.manual_seed(seed)
        settings = AdaptSettings(
            self.settings.adapted, self.settings.ground, budget, round_samples, observations, seed=seed
        )
        return adapt(
            policy,
            self.residual(encoder),
            self.source,
            target,
            self.observe,
            see_frames,
            settings,
            folder,
            None if told_states else self.label,
            report,
        )
