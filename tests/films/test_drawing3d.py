import math

import numpy as np
import pytest

from visadapt.films.canvas import Canvas
from visadapt.films.drawing3d import NEAREST_M, Pen, PinholeCamera


def test_a_camera_sees_points_where_similar_triangles_put_them():
    camera = PinholeCamera.towards(np.array([0.0, -10.0, 0.0]), np.zeros(3), 500.0, (400, 300))
    seen, depth = camera.project(np.array([[0.0, 0, 0], [2, 0, 0], [0, 0, 1], [2, 10, 1]]))
    np.testing.assert_allclose(seen, [[200, 150], [300, 150], [200, 100], [250, 125]], atol=1e-9)
    np.testing.assert_allclose(depth, [10, 10, 10, 20])


@pytest.mark.parametrize("down", [0.0, 0.3, -0.2])
def test_the_horizon_is_where_endless_ground_is_seen(down: float):
    camera = PinholeCamera.towards(np.zeros(3), np.array([1.0, 2.0, -down]), 500.0, (400, 300))
    far = camera.project(1e9 * np.array([[1.0, 2.0, 0.0], [1.5, 1.5, 0.0]]))[0]
    np.testing.assert_allclose(far[:, 1], camera.horizon, atol=1e-5)
    assert camera.horizon == pytest.approx(150 - 500 * down / math.sqrt(5))


def test_a_camera_around_points_sees_them_all_and_fills_its_picture():
    points = np.random.default_rng(0).normal(size=(50, 3)) * (8, 1, 3)
    seen = PinholeCamera.around(points, np.array([-0.5, -1, 0.6]), (200, 100), 10).project(points)[0]
    assert (seen > 9.99).all()
    assert (seen < (190.01, 90.01)).all()
    gaps = np.array([seen.min(0), (200, 100) - seen.max(0)]) - 10
    assert np.abs(gaps).min(1).max() < 1e-6


def test_a_line_that_passes_the_camera_is_cut_there_and_not_mirrored():
    canvas = Canvas(400, 300)
    pen = Pen(canvas, PinholeCamera.towards(np.zeros(3), np.array([1.0, 0.0, 0.0]), 300.0, (400, 300)))
    pen.line(np.array([[-5.0, -1, -0.5], [5.0, -1, -0.5]]), (0, 0, 0), 2)
    rows, columns = np.nonzero(canvas.pixels[..., 0] < 128)
    assert len(rows) > 100
    assert columns.min() > 255  # to the right and below only, from 60 px and 30 px on outwards
    assert rows.min() > 175
    canvas = Canvas(400, 300)
    Pen(canvas, pen.camera).line(np.array([[-5.0, -1, 0], [NEAREST_M / 2, -1, 0]]), (0, 0, 0))
    assert (canvas.pixels == 255).all()
