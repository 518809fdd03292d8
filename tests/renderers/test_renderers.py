import numpy as np
import pytest
import torch
from torch.func import functional_call

from renderers import Camera, DrawnCartPole, LayeredRenderer, MLPRenderer

SKY = 245


def draw(x, theta, **settings):
    """One frame as floating point."""
    return DrawnCartPole(**settings)(np.array([x]), np.array([theta]))[0].astype(float)


def seen_angle(frame, camera, x):
    """Angle and column of the pole in a frame, from the pixels well above the hinge: an estimator of its own."""
    rows = np.arange(int(camera.row) - 35, int(camera.row) - 8)
    darkness = SKY - frame[rows]
    column = (darkness * np.arange(camera.width)).sum(1) / darkness.sum(1)
    slope, at_hinge = np.polyfit(camera.row - rows, column - camera.column - camera.scale * x, 1)
    return np.arctan(slope), at_hinge


class TestDrawn:
    def test_frames_are_as_large_as_the_camera_says(self):
        frames = DrawnCartPole(Camera(width=64, height=48))(np.zeros(3), np.zeros(3))
        assert frames.shape == (3, 48, 64)
        assert frames.dtype == np.uint8
        assert DrawnCartPole()(np.zeros(1), np.zeros(1)).shape == (1, 100, 120)

    @pytest.mark.parametrize("theta", [0.0, 0.2, -0.3])
    def test_a_pixels_worth_of_metres_moves_the_picture_by_a_pixel(self, theta):
        scale = Camera().scale
        for x in (-0.33, 0.0, 0.121):
            here, there = draw(x, theta), draw(x + 1 / scale, theta)
            assert np.abs(there - here).max() > 40
            np.testing.assert_allclose(there[:, 1:], here[:, :-1], atol=2)

    def test_motion_of_a_tenth_of_a_pixel_is_seen(self):
        here, there = draw(0.0, 0.0), draw(0.1 / Camera().scale, 0.0)
        assert np.abs(there - here).sum() > 100

    @pytest.mark.parametrize("theta", [-0.3, -0.05, 0.0, 0.013, 0.25])
    @pytest.mark.parametrize("x", [-0.8, 0.0, 0.5])
    def test_the_pole_is_seen_where_it_is_and_at_its_angle(self, x, theta):
        angle, at_hinge = seen_angle(draw(x, theta), Camera(), x)
        assert np.degrees(angle - theta) == pytest.approx(0, abs=0.2)
        assert at_hinge == pytest.approx(0, abs=0.1)

    def test_a_positive_angle_leans_to_the_right_and_its_mirror_to_the_left(self):
        right = draw(0.0, 0.3)
        assert (SKY - right[:50, 60:]).sum() > 10 * (SKY - right[:50, :60]).sum()
        np.testing.assert_allclose(draw(0.0, -0.3), right[:, ::-1], atol=3)

    def test_the_reach_of_the_camera_is_where_the_hinge_leaves_the_frame(self):
        for camera in (Camera(), Camera(column=40.0), Camera(width=60, column=29.5, scale=20.0)):
            columns = [camera.column + sign * camera.scale * camera.reach for sign in (-1, 1)]
            assert columns[0] >= -0.5
            assert columns[1] <= camera.width - 0.5
            assert columns[0] == pytest.approx(-0.5) or columns[1] == pytest.approx(camera.width - 0.5)

    def test_a_cart_out_of_sight_leaves_the_still_scene(self):
        np.testing.assert_array_equal(draw(8.0, 0.1), draw(-8.0, 0.0))


def randomised(renderer):
    """In double precision, with weights that are not those of a blank picture."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for name, parameter in renderer.named_parameters():
            if name not in ("origin", "gain", "tilt"):
                parameter += 0.3 * torch.randn(parameter.shape, generator=generator)
    return renderer.double()


@pytest.fixture(params=["layered", "mlp"])
def renderer(request):
    torch.manual_seed(0)
    made = {
        "layered": lambda: LayeredRenderer(24, 30, column=14.5, row=17.5, scale=10.0, reach=1.0),
        "mlp": lambda: MLPRenderer(24, 30),
    }
    return randomised(made[request.param]())


PLACES = (
    torch.tensor([-0.31, 0.123, 0.48], dtype=torch.float64),
    torch.tensor([0.21, -0.034, -0.27], dtype=torch.float64),
)


class TestLearnt:
    def test_frames_have_the_size_asked_for_and_values_between_0_and_1(self, renderer):
        frames = renderer(*PLACES)
        assert frames.shape == (3, 24, 30)
        if isinstance(renderer, LayeredRenderer):
            assert frames.min() >= 0
            assert frames.max() <= 1

    def test_a_row_does_not_depend_on_its_batch(self, renderer):
        together = renderer(*PLACES)
        for b in range(3):
            torch.testing.assert_close(renderer(*(p[b : b + 1] for p in PLACES))[0], together[b])

    def test_gradients_agree_with_finite_differences(self, renderer):
        """In x and theta, and along one direction in all the weights."""
        generator = torch.Generator().manual_seed(1)
        weights = torch.randn(3, 24, 30, generator=generator, dtype=torch.float64)
        parameters = {key: value.detach() for key, value in renderer.named_parameters()}
        along = {
            key: torch.randn(value.shape, generator=generator, dtype=torch.float64) for key, value in parameters.items()
        }

        def total(x, theta, step):
            moved = {key: value + step * along[key] for key, value in parameters.items()}
            return (weights * functional_call(renderer, moved, (x, theta))).sum()

        inputs = [*(p.clone() for p in PLACES), torch.zeros((), dtype=torch.float64)]
        leaves = [value.clone().requires_grad_() for value in inputs]
        grads = torch.autograd.grad(total(*leaves), leaves)
        # So small a step that hardly a pixel crosses from one texel, where bilinear shades have a kink, to the next.
        h = 1e-7
        for position, grad in enumerate(grads):
            assert grad.abs().min() > 1e-3
            for place in range(grad.numel()):
                ends = []
                for step in (-h, h):
                    moved = [value.clone() for value in inputs]
                    moved[position].view(-1)[place] += step
                    ends.append(float(total(*moved)))
                assert (ends[1] - ends[0]) / (2 * h) == pytest.approx(float(grad.view(-1)[place]), rel=1e-3, abs=1e-3)

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_dtype_follows(self, renderer, dtype):
        assert renderer.to(dtype)(*(p.to(dtype) for p in PLACES)).dtype == dtype


@pytest.mark.parametrize("place", [float("nan"), float("inf"), -1e30])
def test_a_cart_that_is_nowhere_is_drawn_anywhere(place):
    drawn = randomised(LayeredRenderer(24, 30, column=14.5, row=17.5, scale=10.0, reach=1.0))
    assert drawn(torch.tensor([0.0, place]).double(), torch.zeros(2).double()).shape == (2, 24, 30)


def test_the_layered_renderer_moves_by_a_pixel_for_a_pixels_worth_of_metres():
    renderer = randomised(LayeredRenderer(24, 30, column=14.5, row=17.5, scale=10.0, reach=1.0, detail=1.0))
    with torch.no_grad():
        renderer.background.fill_(0.4)
        for of_the_view in (renderer.stretch, renderer.perspective, renderer.distortion):
            of_the_view.zero_()
        here, there = renderer(PLACES[0], PLACES[1]), renderer(PLACES[0] + 0.1, PLACES[1])
    torch.testing.assert_close(there[:, :, 1:], here[:, :, :-1])
    assert (there - here).abs().max() > 0.03


def test_the_pole_of_the_layered_renderer_turns_like_the_drawn_one():
    """A pole that is dark along the upright must lean to the right at a positive angle, by that angle."""
    camera = Camera()
    renderer = LayeredRenderer(camera.height, camera.width, camera.column, camera.row, camera.scale, reach=1.0).double()
    with torch.no_grad():
        renderer.background.fill_(8.0)
        renderer.cart.opacity.fill_(-30.0)
        renderer.pole.shade.fill_(-8.0)
        renderer.pole.opacity.fill_(-30.0)
        middle = renderer.pole.opacity.shape[2] // 2
        renderer.pole.opacity[..., middle - 1 : middle + 2] = 8.0
    x, theta = torch.tensor([0.2, -0.4], dtype=torch.float64), torch.tensor([0.25, -0.1], dtype=torch.float64)
    frames = renderer(x, theta).detach().numpy() * SKY / (1 / (1 + np.exp(-8.0)))
    for b in range(2):
        angle, at_hinge = seen_angle(frames[b], camera, float(x[b]))
        assert np.degrees(angle - float(theta[b])) == pytest.approx(0, abs=0.5)
        assert at_hinge == pytest.approx(0, abs=0.3)
