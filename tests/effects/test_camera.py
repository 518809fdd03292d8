"""What a camera effect does to a picture, in pixels and greys; gradients are tested with all effects."""

from functools import partial

import numpy as np
import pytest
import torch
from scipy import ndimage

from visadapt.effects import (
    Blur,
    Brightness,
    CameraDelay,
    CameraRotation,
    CameraShift,
    CameraZoom,
    FrameDrop,
    Gamma,
    Occlusion,
)
from visadapt.systems import CartPole
from visadapt.world import World

HEIGHT, WIDTH = 21, 31


def shown(frame, *effects):
    """A frame (H, W) as a camera with these effects shows it."""
    world = World(CartPole(), [effect.double() for effect in effects])
    at = world.start(torch.zeros(1, 4, dtype=torch.float64))
    return world.show(at, lambda state: frame[None])[0][0].detach()


@pytest.fixture
def picture():
    generator = torch.Generator().manual_seed(0)
    return torch.rand(HEIGHT, WIDTH, generator=generator, dtype=torch.float64)


def dot(column, row):
    """A frame that is black but for one pixel; the centre of the frame is column 15, row 10."""
    frame = torch.zeros(HEIGHT, WIDTH, dtype=torch.float64)
    frame[row, column] = 1.0
    return frame


def test_a_shift_moves_what_was_at_a_pixel_and_repeats_the_edge(picture):
    out = shown(picture, CameraShift(dx=3.0, dy=-2.0))
    torch.testing.assert_close(out[:-2, 3:], picture[2:, :-3], rtol=0, atol=1e-12)
    torch.testing.assert_close(out[:-2, 0], picture[2:, 0], rtol=0, atol=1e-12)


def test_frames_saturate_as_those_of_a_target_do(picture):
    out = shown(picture, Brightness(gain=1.6, offset=-0.2))
    torch.testing.assert_close(out, (1.6 * picture - 0.2).clamp(0, 1))
    assert out.min() == 0
    assert out.max() == 1


def test_a_quarter_turn_takes_right_to_below():
    assert shown(dot(19, 10), CameraRotation(angle=np.pi / 2))[14, 15] == pytest.approx(1.0)


def test_a_zoom_of_two_doubles_the_distance_from_the_centre():
    assert shown(dot(17, 8), CameraZoom(scale=2.0))[6, 19] == pytest.approx(1.0)


def test_turn_zoom_and_shift_are_one_warp_in_this_order_however_they_are_listed():
    effects = CameraShift(dx=1.0, dy=2.0), CameraRotation(angle=np.pi / 2), CameraZoom(scale=2.0)
    # Right by 2 becomes below by 2, then by 4, then the shift.
    out = shown(dot(17, 10), *effects)
    assert out[10 + 4 + 2, 15 + 1] == pytest.approx(1.0)
    assert out.max() == pytest.approx(1.0)  # not interpolated thrice


def test_a_box_covers_its_pixels_up_to_but_not_including_the_last(picture):
    out = shown(picture, Occlusion(left=4.0, top=2.0, right=9.0, bottom=5.5, grey=0.25))
    assert (out[2:5, 4:9] == 0.25).all()
    torch.testing.assert_close(out[5, 4:9], 0.5 * (picture[5, 4:9] + 0.25))
    out[2:6, 4:9] = picture[2:6, 4:9]
    torch.testing.assert_close(out, picture)


def test_blur_is_the_gaussian_of_scipy(picture):
    expected = ndimage.gaussian_filter(picture.numpy(), 1.25, mode="nearest", radius=12)
    np.testing.assert_allclose(shown(picture, Blur(sigma=1.25)), expected, atol=1e-12)


def test_greys_are_raised_to_the_power_before_gain_and_offset(picture):
    out = shown(picture, Brightness(gain=0.75, offset=0.125), Gamma(exponent=2.0))
    torch.testing.assert_close(out, 0.75 * picture**2 + 0.125)


def test_a_late_frame_shows_an_earlier_scene():
    world = World(CartPole(), [CameraDelay(delay=0.05).double().requires_grad_(False)])

    def draw(state):
        return state[:, :1, None].expand(-1, 2, 2)

    at = world.start(torch.tensor([[0.0, 1.0, 0.0, 0.0]], dtype=torch.float64))
    frame, at = world.show(at, draw)
    before = float(at.state[0, 0])
    assert float(frame[0, 0, 0]) == before
    at = world.step(at, torch.zeros(1, 1, dtype=torch.float64))
    frame, _ = world.show(at, draw)
    assert at.state[0, 0] > 0.04
    assert float(frame[0, 0, 0]) == pytest.approx(before)


def test_a_lost_frame_is_the_one_before_it_and_the_first_is_never_lost():
    world = World(CartPole(), [FrameDrop(rate=0.5)])
    generator, at = torch.Generator().manual_seed(0), World(CartPole(), [FrameDrop(rate=0.5)]).start(torch.zeros(1, 4))
    numbers = []
    for number in range(200):
        picture = torch.full((1, 2, 3), number / 200)
        frame, at = world.show(at, partial(lambda shown, state: shown, picture), generator)
        numbers.append(round(200 * frame[0, 0, 0].item()))
    repeated = np.diff(numbers, prepend=-1) == 0
    assert numbers[0] == 0
    assert 70 < repeated.sum() < 130
    assert all(numbers[k] == k for k in np.flatnonzero(~repeated))


def test_a_policy_s_loss_has_a_gradient_in_the_camera_s_parameters(picture):
    world = World(CartPole(), [CameraRotation(angle=0.1), Blur(sigma=1.0)])
    frame, _ = world.show(world.start(torch.zeros(1, 4)), lambda state: picture[None].float())
    frame.square().sum().backward()
    assert all(
        abs(float(effect.get_parameter(name).grad)) > 0.01
        for effect, name in zip(world.effects, ("angle", "sigma"), strict=True)
    )
