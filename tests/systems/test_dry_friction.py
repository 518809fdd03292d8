"""Dry friction beside states that belong to no joint."""

import torch

import visadapt as va
from tests.cylinder import Cylinder


def test_a_pressure_follows_a_rod_that_stops_within_a_step():
    friction = next(effect for effect in va.catalogue(Cylinder()) if effect.name == "rod.coulomb_friction")
    generator = torch.Generator().manual_seed(0)
    scales = torch.tensor([0.1, 0.02, 1.0])  # slow: most of the rods stop
    start = torch.randn(300, 3, generator=generator, dtype=torch.float64) * scales
    valve = 0.1 * torch.randn(300, 1, generator=generator, dtype=torch.float64)

    def pressure(substeps):
        world = va.World(Cylinder(), [friction(force=300.0)], period=0.01, substeps=substeps).double()
        after = world.integrate(torch.zeros(300), start, valve[:, None].expand(-1, substeps, -1))
        stopped = after[:, 1] == 0
        assert stopped.any()
        assert not stopped.all()
        return after[:, 2].detach()

    exact = pressure(256)
    coarse, fine = ((pressure(n) - exact).square().mean().sqrt() for n in (8, 16))
    assert coarse < 0.002  # MPa, of about 1; 0.007 where the pressure ignored the stop
    assert fine < coarse / 3  # of second order, as without friction
