"""Dry friction beside states that belong to no joint."""

import torch

import visadapt as va
from tests.cylinder import Cylinder


def coulomb_friction():
    return next(effect for effect in va.catalogue(Cylinder()) if effect.name == "rod.coulomb_friction")


def test_gradients_pass_a_stop_to_the_pressure():
    """By the valve, against finite differences."""
    world = va.World(Cylinder(), [coulomb_friction()(force=300.0)], period=0.01, substeps=4).double()
    start = torch.tensor([[0.0, 0.004, 0.1]], dtype=torch.float64)

    def after(valve):
        return world.integrate(torch.zeros(1), start, valve.expand(1, 4, 1))

    valve = torch.full((1, 1, 1), 0.02, dtype=torch.float64, requires_grad=True)
    assert after(valve)[0, 1] == 0
    assert torch.autograd.gradcheck(lambda v: after(v)[0, 2], valve)


def test_a_pressure_follows_a_rod_that_stops_within_a_step():
    friction = coulomb_friction()
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
