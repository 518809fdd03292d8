"""Which fitted effects of a camera are causes: not those that may do nothing."""

import pytest
import torch

from visadapt.diagnosis.search.camera import may_do_nothing
from visadapt.effects import CameraShift, CameraZoom, Occlusion
from visadapt.estimation.camera_fit import CameraFit


def fitted(camera, values, deviations):
    values, deviations = (torch.tensor(each, dtype=torch.float64) for each in (values, deviations))
    return CameraFit(camera, values, torch.zeros(1, 2), 1e-4, deviations.square().diag(), torch.zeros(1, 4, 4))


@pytest.mark.parametrize(
    ("box", "deviations", "idle"),
    [
        ((40.0, 75.0, 68.0, 75.2), (0.1, 0.1, 0.1, 0.1), {Occlusion}),  # 0.2 px high, and perhaps not that
        ((0.0, 85.4, 119.8, 84.4), (0.1, 0.1, 0.1, 0.1), {Occlusion}),  # its end lies above its start
        ((40.0, 30.0, 68.0, 75.0), (30.0, 0.1, 30.0, 0.1), {Occlusion}),  # where it ends along the track is unknown
        ((40.0, 70.0, 68.0, 75.0), (0.5, 0.5, 0.5, 0.5), set()),
    ],
)
def test_a_covered_box_that_may_be_empty_does_nothing(box, deviations, idle):
    fit = fitted((CameraZoom, Occlusion), (1.03, *box, 0.5), (0.001, *deviations, 0.1))
    assert may_do_nothing(fit, frozenset()) == idle


@pytest.mark.parametrize(("dy", "idle"), [(0.01, {CameraShift}), (0.1, set())])
def test_a_shift_within_its_interval_does_nothing(dy, idle):
    fit = fitted((CameraShift,), (8.0, dy), (1.0, 0.02))
    assert may_do_nothing(fit, frozenset({"dx"})) == idle
