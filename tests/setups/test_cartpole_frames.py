import pytest

from renderers import LayeredRenderer
from visadapt.setups.cartpole import cartpole_frames, from_frames
from visadapt.systems import CartPole
from visadapt.tasks.balance import Balance
from visadapt.weights import shipped
from visadapt.world import World

WIDE = from_frames(World(CartPole()))


def test_the_drawn_camera_sees_as_far_as_the_settings_go():
    assert cartpole_frames().settings == WIDE
    assert cartpole_frames(renderer=shipped("renderer")).settings == WIDE


def test_a_camera_that_sees_half_of_it_is_trained_with_on_half_of_the_track():
    camera = LayeredRenderer(40, 60, column=29.5, row=30.0, scale=30 / 0.725, reach=0.5)
    narrow = cartpole_frames(renderer=camera).settings
    for ours, theirs in ((narrow.source.task, WIDE.source.task), (narrow.tuning.task, WIDE.tuning.task)):
        assert isinstance(ours, Balance)
        assert isinstance(theirs, Balance)
        assert ours.divergence[0] == pytest.approx(theirs.divergence[0] / 2)
        assert ours.start_spread[0] == pytest.approx(theirs.start_spread[0] / 2)
        assert ours.divergence[1:] == theirs.divergence[1:]
    assert narrow.perception.cart.reach == pytest.approx(WIDE.perception.cart.reach / 2)
    assert narrow.perception.pole == WIDE.perception.pole
