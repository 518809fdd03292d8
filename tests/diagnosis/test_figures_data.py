"""The numbers behind the report's figures."""

import numpy as np
import pytest
import torch

from visadapt.diagnosis.figures_data import _spectrum
from visadapt.diagnosis.search.disturbance import Disturbance


@pytest.mark.parametrize("rows", [[100] * 40, [*[100] * 10, *[12] * 90]], ids=["equal", "some long"])
def test_the_spectrum_s_integral_is_the_mean_square_of_the_load(rows):
    generator = torch.Generator().manual_seed(0)
    load = torch.randn(len(rows), 100, 1, generator=generator, dtype=torch.float64)
    valid = (torch.arange(100) < torch.tensor(rows)[:, None]).double()
    found = Disturbance(load * valid[..., None], valid, {})
    chart = _spectrum(("force", "N"), found, found, 0.05)
    integral = np.sum(chart.curves[0].values) * (chart.x[1] - chart.x[0])
    assert integral == pytest.approx(1.0, rel=0.15)
