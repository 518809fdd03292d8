"""A small learnt renderer with random pictures, for tests that need frames and no likeness."""

import torch

from renderers import LayeredRenderer
from visadapt.learning.perception import PerceptionSettings, kinematics_units
from visadapt.policies.networks import ImageResidualNetwork, StateHistoryResidualNetwork, StateResidualNetwork
from visadapt.systems import CartPole

HEIGHT, WIDTH = 20, 24
CONTRAST = 0.2


def small_renderer(seed=0, dtype=torch.float32, width=WIDTH):
    """Cart and pole clearly seen on a background of noise, 8 px per m."""
    generator = torch.Generator().manual_seed(seed)
    renderer = LayeredRenderer(HEIGHT, width, column=(width - 1) / 2, row=14.5, scale=8.0, reach=1.0)
    with torch.no_grad():
        for values, mean, spread in (
            (renderer.background, 1.0, 0.5),
            (renderer.cart.shade, -1.0, 1.0),
            (renderer.cart.opacity, 1.0, 1.0),
            (renderer.pole.shade, -1.0, 1.0),
            (renderer.pole.opacity, 1.0, 1.0),
        ):
            values.copy_(mean + spread * torch.randn(values.shape, generator=generator))
    return renderer.to(dtype).requires_grad_(False)


def background(renderer):
    return renderer.background.sigmoid()


def observing(renderer):
    """What the camera would show of states (B, 4)."""
    return lambda state: renderer(state[:, 0], state[:, 2])


def stir(module, seed=0, spread=1.0):
    """Give every weight a random value, those that begin at zero too; `spread` 1 keeps most units out of saturation."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for weight in module.parameters():
            inputs = weight[0].numel() if weight.dim() > 1 else 10
            weight.copy_(spread * inputs**-0.5 * torch.randn(weight.shape, generator=generator))
    return module


def image_residual_network(renderer):
    """A residual network for the small renderer's frames, 0.05 s apart, of the default cart-pole."""
    unit = kinematics_units(PerceptionSettings(), 0.05)
    return ImageResidualNetwork(background(renderer), CONTRAST, CartPole(), 0.05, unit)


def state_residual_network(with_history):
    """A residual network for states 0.05 s apart of the default cart-pole."""
    return StateHistoryResidualNetwork(CartPole(), 0.05) if with_history else StateResidualNetwork(4)
