"""Where the load that a model misses is concentrated."""

import pytest
import torch

from visadapt.diagnosis.search.disturbance import Disturbance, regions_of


@pytest.mark.parametrize(("first", "last"), [(0, 0), (2, 2), (5, 5), (3, 4)])
def test_a_region_of_episodes_is_of_those_that_were_disturbed(first, last, monkeypatch):
    monkeypatch.setattr("visadapt.diagnosis.search.disturbance.MAX_P_VALUE", 1.0)  # of six episodes none is certain
    generator = torch.Generator().manual_seed(0)
    load = 0.1 * torch.randn(6, 60, 1, generator=generator, dtype=torch.float64)
    load[first : last + 1] += torch.randn(last + 1 - first, 60, 1, generator=generator, dtype=torch.float64)
    episode = torch.arange(6.0, dtype=torch.float64)[:, None].expand(6, 60)
    (found,) = regions_of(Disturbance(load, torch.ones(6, 60), {"episode": episode}), seed=0)
    assert (found.start, found.end) == (first, last)
