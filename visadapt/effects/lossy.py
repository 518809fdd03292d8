"""What Dropout and FrameDrop share: rows or frames that are lost at random, so that the last one is repeated."""

from __future__ import annotations

import torch
from torch import Tensor

from visadapt.effects.base import Effect, Parameter


class Lossy(Effect):
    """Loses what it reads with probability `rate`."""

    repeats_readings = True
    source = "Schenato et al. (2007), Foundations of control and estimation over lossy networks, section II"
    table = (Parameter("rate", "1", 0.0, 0.5, 0.0),)

    def lost(self, read: Tensor, generator: torch.Generator | None) -> Tensor:
        """Which (B,) of B rows `read` (B, ...) are lost, drawn anew at every call.

        Raises:
            ValueError: there is no generator.
        """
        if generator is None:
            raise ValueError(f"{self.name} is random: it needs a torch.Generator")
        drawn = torch.rand(len(read), generator=generator, device=generator.device).to(read)
        return drawn < self.value("rate", read)
