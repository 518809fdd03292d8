import pytest
import torch

from tests.scenes import CONTRAST, background, small_renderer
from visadapt.history import LENGTH, History
from visadapt.learning.perception import Paths, PerceptionSettings, kinematics, train_encoder
from visadapt.policies.frame_encoder import FrameEncoder

PERIOD = 0.05


class TestPaths:
    def test_velocities_are_handed_on_from_period_to_period(self):
        """x_{t+1} = x_t + v_t h + a_t h^2 / 2 and v_{t+1} = v_t + a_t h, for one velocity and one a in each period."""
        length = 8
        drawn = Paths(1.0, 0.5, 2.0).draw(50, length, PERIOD, torch.Generator().manual_seed(0))
        assert drawn.shape == (50, length)
        # The same numbers again, in the order of the distribution: position, velocity, accelerations.
        generator = torch.Generator().manual_seed(0)
        x = 2 * torch.rand(50, 1, generator=generator)[:, 0] - 1
        v = 0.5 * torch.randn(50, 1, generator=generator)[:, 0]
        a = 2.0 * torch.randn(50, length - 1, generator=generator)
        for t in range(length):
            torch.testing.assert_close(drawn[:, t], x, atol=1e-5, rtol=0)
            if t < length - 1:
                x, v = x + v * PERIOD + a[:, t] * PERIOD**2 / 2, v + a[:, t] * PERIOD

    def test_spreads_are_as_asked_for(self):
        paths = Paths(reach=1.3, velocity=0.4, acceleration=2.0)
        drawn = paths.draw(20_000, 6, PERIOD, torch.Generator().manual_seed(0)).double()
        assert drawn[:, 0].abs().max() == pytest.approx(1.3, rel=0.01)
        assert drawn[:, 0].mean() == pytest.approx(0.0, abs=0.02)
        changes = drawn.diff(dim=1)
        # v h + a h^2 / 2; and a change of change is h^2 (a_t + a_{t+1}) / 2.
        assert changes[:, 0].std() == pytest.approx(((0.4 * 0.05) ** 2 + (2.0 * 0.05**2 / 2) ** 2) ** 0.5, rel=0.03)
        assert changes.diff(dim=1).std() == pytest.approx(2.0 * 0.05**2 / 2**0.5, rel=0.03)

    def test_without_velocity_and_acceleration_they_stand_still(self):
        drawn = Paths(1.0, 0.0, 0.0).draw(4, 6, PERIOD, torch.Generator().manual_seed(0))
        assert torch.equal(drawn, drawn[:, :1].expand(-1, 6))

    def test_the_scale_is_of_the_size_of_what_is_told(self):
        paths = Paths(1.3, 0.4, 0.0)
        told = kinematics(paths.draw(5000, LENGTH, PERIOD, torch.Generator().manual_seed(0)))
        size = told.square().mean(0).sqrt() / paths.scale(PERIOD)
        assert ((size > 0.8) & (size < 1.25)).all()


def test_kinematics_are_the_latest_position_and_the_changes_up_to_it():
    told = kinematics(torch.tensor([1.0, 2.0, 4.0, 8.0, 16.0]))
    assert told.tolist() == [16.0, 1.0, 2.0, 4.0, 8.0]


# Faster than any cart, so that changes show in frames of 24 px.
SMALL = PerceptionSettings(
    iterations=160,
    streams=16,
    learning_rate=5e-3,
    pixel_noise=0.001,
    cart=Paths(0.8, 2.0, 5.0),
    pole=Paths(0.3, 2.0, 5.0),
)


def learn(checkpoint=None, stop=None):
    def progress(done, total, loss):
        assert total == SMALL.iterations
        if done == stop:
            raise KeyboardInterrupt

    torch.manual_seed(0)
    renderer = small_renderer()
    encoder = FrameEncoder(background(renderer), CONTRAST, n_action=1)
    generator = torch.Generator().manual_seed(1)
    losses = train_encoder(encoder, renderer, PERIOD, SMALL, generator, progress, checkpoint)
    return encoder, losses


@pytest.fixture(scope="module")
def whole():
    return learn()


def test_the_loss_falls_and_positions_are_read_from_frames(whole):
    encoder, losses = whole
    assert len(losses) == SMALL.iterations
    assert sum(losses[-10:]) < 0.5 * sum(losses[:10])
    renderer = small_renderer()
    x = torch.linspace(-0.6, 0.6, 9)
    frames = renderer(x, torch.zeros(9))[:, None].expand(-1, LENGTH, -1, -1)
    with torch.no_grad():
        seen = encoder.kinematics(History(frames, torch.zeros(9, LENGTH, 1)))[:, 0] * SMALL.cart.scale(PERIOD)[0]
    assert (seen - x).square().mean() < 0.25 * x.square().mean()


def test_interrupted_after_a_checkpoint_it_goes_on_to_the_same_numbers(whole, tmp_path):
    path = tmp_path / "partial.safetensors"
    with pytest.raises(KeyboardInterrupt):
        learn(path, stop=105)
    assert path.exists()
    encoder, losses = learn(path)
    assert losses == whole[1]
    for key, value in whole[0].state_dict().items():
        assert torch.equal(value, encoder.state_dict()[key]), key
