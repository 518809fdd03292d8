"""The residual: a learnt correction, which can represent any gap and names none.

Delta_phi of the paper (equation 10): the grounded model is f_hat(s, a) + Delta(history, phi).
"""

from __future__ import annotations

from torch import Tensor, nn

from visadapt.effects.base import Effect, Stage
from visadapt.history import History

__all__ = ["Residual"]


class Residual(Effect):
    """Adds to the state after each period a correction that a network computes from recent observations and actions.

    Args:
        network: maps a `History`, whose last action is the one being executed, to (B, n_state) in units of `scale`;
            only a `networks.ResidualNetwork` can be grounded.
        scale: (n_state,) typical size of a correction per period, in state units.

    >>> import torch, visadapt as va
    >>> from visadapt.policies.networks import StateResidualNetwork
    >>> residual = va.Residual(StateResidualNetwork(n_state=4), torch.ones(4))
    >>> va.World(va.CartPole(), [residual]).has_residual
    True
    """

    name = "residual"
    stage = Stage.ANY
    equation = "s' = f_hat(s, a) + scale * network(last observations, last actions)"
    source = "the paper, equation 10"

    scale: Tensor

    def __init__(self, network: nn.Module, scale: Tensor) -> None:
        super().__init__()
        self.network = network
        self.register_buffer("scale", scale.clone())

    def delta(self, history: History) -> Tensor:
        """Correction (B, n_state) to the state at the end of the period."""
        out: Tensor = self.network(history)
        return out * self.scale.to(out)
