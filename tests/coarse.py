"""Simulated targets and learnt worlds at less expense than they deserve, where their accuracy is not what is tested."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from visadapt.learning import stability
from visadapt.targets import synthetic


@contextmanager
def coarse_targets(step: float) -> Iterator[None]:
    """Smooth targets are integrated in steps of `step` s, and learnt worlds judged by three plans."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic, "SMOOTH_STEP", step)
        patch.setattr(stability, "CHECKED_PLANS", 3)
        yield
