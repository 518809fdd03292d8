from dataclasses import replace

import numpy as np
import pytest
import torch

from renderers import Camera, DrawnCartPole
from renderers.drawn import AXLE_GREY, CART_GREY, POLE_GREY, SKY_GREY, TRACK_GREY
from tests.scenes import small_renderer
from visadapt.effects import EFFECTS, CameraDelay, CameraRotation, ConstantForce
from visadapt.estimation.poses import PoseFinder
from visadapt.learning.tracking import Tracker, TrackingError, TrackingWarning
from visadapt.recordings import Episode
from visadapt.setups.cartpole import cartpole_frames
from visadapt.systems import CartPole
from visadapt.targets import SyntheticTarget, constant_force, no_effects, sine_force
from visadapt.world import World

WORLD = World(CartPole())


class Sketch(torch.nn.Module):
    """The drawn scene in closed form, so that no test waits for a fit: edges fade over a pixel."""

    def __init__(self, drawn=None):
        super().__init__()
        self.drawn = drawn or DrawnCartPole()
        self.shades = torch.nn.Parameter(torch.tensor([SKY_GREY, TRACK_GREY, CART_GREY, POLE_GREY, AXLE_GREY]) / 255)

    def forward(self, x, theta):
        drawn, camera = self.drawn, self.drawn.camera
        sky, track, cart, pole, axle = self.shades
        across = (torch.arange(camera.width) - camera.column) / camera.scale - x[:, None, None]
        up = ((camera.row - torch.arange(camera.height)) / camera.scale)[:, None].expand(len(x), -1, camera.width)
        along = across * theta.sin()[:, None, None] + up * theta.cos()[:, None, None]
        aside = across * theta.cos()[:, None, None] - up * theta.sin()[:, None, None]
        base = drawn.cart_height + 0.04

        def inside(*distances):
            covered = 1.0
            for distance in distances:
                covered = covered * (0.5 - distance * camera.scale).clamp(0, 1)
            return covered

        frame = sky.expand(len(x), camera.height, camera.width)
        for shade, covered in (
            (track, inside(up + base, -base - 0.03 - up)),
            (cart, inside(across.abs() - drawn.cart_width / 2, up + 0.04, -base - up)),
            (pole, inside(aside.abs() - drawn.pole_width / 2, along - drawn.pole_length, -along)),
            (axle, inside((across.square() + up.square()).sqrt() - 0.05)),
        ):
            frame = frame + covered * (shade - frame)
        return frame


@pytest.fixture(scope="module")
def tracker():
    return Tracker(Sketch(), WORLD)


def record(draw_effects, steps, seed=0):
    """An episode that a hand-made controller, which sees the true state, and some noise keep upright."""
    generator = torch.Generator().manual_seed(seed)
    target = SyntheticTarget(draw_effects, DrawnCartPole())
    seen, states, actions, frames = target.reset(1, generator), [], [], []
    for _ in range(steps + 1):
        states.append(seen.state[0].numpy())
        frames.append(seen.frame[0].numpy())
        push = seen.state @ torch.tensor([0.06, 0.1, 1.4, 0.26]) + 0.1 * torch.randn(1, generator=generator)
        actions.append(push.clamp(-1, 1).numpy())
        seen = target.step(push[:, None].clamp(-1, 1))
    return Episode(np.arange(steps + 1) * target.period, np.stack(actions), np.stack(states), np.stack(frames))


def blind(episode):
    """What a camera alone recorded."""
    return replace(episode, state=None)


def gap(episode):
    state, action = torch.tensor(episode.state).double(), torch.tensor(episode.action).double()
    return (state[1:] - WORLD.step(WORLD.start(state[:-1]), action[:-1]).state).numpy()


def rms(values):
    return np.sqrt(np.square(values).mean(0))


class TestPoses:
    def test_found_over_the_whole_balance_range_and_wherever_the_hinge_is_in_sight(self, tracker):
        generator = np.random.default_rng(0)
        x, theta = generator.uniform(-1.45, 1.45, 100), generator.uniform(-0.45, 0.45, 100)
        # A pole that leans out of the frame is hardly seen.
        theta = np.where(np.abs(x) > 1.2, -np.sign(x) * np.abs(theta), theta)
        poses = tracker.poses(torch.from_numpy(DrawnCartPole()(x, theta)))
        assert poses.explained.all()
        error = poses.pose.numpy() - np.stack([x, theta], 1)
        assert (rms(error) < [1e-3, 3e-3]).all()
        assert (np.abs(error).max(0) < [3e-3, 1e-2]).all()

    def test_found_as_far_as_a_renderer_shows_the_cart(self):
        renderer = small_renderer(width=80)  # 8 px a metre
        poses = torch.tensor([[-4.6, 0.1], [-2.1, -0.1], [3.3, 0.0], [4.6, 0.1]])
        frames = (255 * renderer(*poses.T)).round().to(torch.uint8)
        assert Tracker(renderer, WORLD).poses(frames).pose.numpy() == pytest.approx(poses.numpy(), abs=0.02)

    def test_the_renderers_own_frames_are_explained_to_rounding(self, tracker):
        pose = torch.tensor([[0.313, -0.121], [-0.878, 0.333]])
        with torch.no_grad():
            frames = (255 * tracker.poses.renderer(*pose.T)).round().to(torch.uint8)
        poses = tracker.poses(frames)
        assert poses.misfit.max() < 0.5 / 255
        np.testing.assert_allclose(poses.pose, pose, atol=1e-4)

    def test_the_covariance_is_that_of_white_errors(self, tracker):
        pose = torch.tensor([0.2, -0.1]).expand(100, 2)
        noise = torch.randn(100, 100, 120, generator=torch.Generator().manual_seed(0))
        with torch.no_grad():
            frames = (255 * tracker.poses.renderer(*pose.T) + 5 * noise).round().clamp(0, 255).to(torch.uint8)
        poses = tracker.poses(frames)
        error = poses.pose - pose
        whitened = torch.linalg.solve(torch.linalg.cholesky(poses.covariance), error[..., None])
        # Noise above white is cut off, and not all pixels count.
        assert 0.7 < float(whitened.square().mean().sqrt()) < 1.3

    def test_a_pole_that_leans_out_of_the_frame_is_known_to_be_uncertain(self, tracker):
        poses = tracker.poses(torch.from_numpy(DrawnCartPole()(np.array([0.0, 1.48]), np.array([0.2, 0.2]))))
        inside, outside = poses.covariance[:, 1, 1].sqrt()
        assert outside > 2 * inside

    def test_what_is_not_the_scene_is_not_explained(self, tracker):
        frames = torch.stack([torch.full((100, 120), grey, dtype=torch.uint8) for grey in (0, SKY_GREY, 255)])
        still = torch.from_numpy(DrawnCartPole()(np.array([9.0]), np.array([0.0])))
        assert not tracker.poses(torch.cat((frames, still))).explained.any()

    def test_other_scenes_and_cameras(self):
        camera = Camera(width=61, height=45, scale=18.0, column=28.0, row=33.0)
        drawn = DrawnCartPole(camera, pole_width=0.1)
        x, theta = np.array([-1.2, 0.3, 1.0]), np.array([0.1, -0.3, 0.02])
        poses = PoseFinder(Sketch(drawn), 1.5)(torch.from_numpy(drawn(x, theta)))
        np.testing.assert_allclose(poses.pose[:, 0], x, atol=3e-3)
        np.testing.assert_allclose(poses.pose[:, 1], theta, atol=1e-2)


class TestTracks:
    def test_states_and_gap_of_the_papers_target_come_from_frames_alone(self, tracker):
        episode = record(sine_force, 60, seed=1)
        track = tracker.track([blind(episode)])[0]
        error = track.state - episode.state
        assert (rms(error) < [1e-3, 1e-2, 3e-3, 2e-2]).all()
        true, found = gap(episode), gap(track)
        unexplained = np.square(true - found).sum(0) / np.square(true - true.mean(0)).sum(0)
        assert (unexplained < 0.05).all()

    def test_without_a_gap_none_is_found(self, tracker):
        found = gap(tracker.track([blind(record(no_effects, 60))])[0])
        # 2 N would change the velocities by 0.09 m/s and 0.13 rad/s.
        assert (rms(found)[[1, 3]] < [2e-3, 1e-2]).all()

    def test_frames_of_a_camera_that_is_known_to_be_turned_show_the_same_states(self):
        turned = [CameraRotation(angle=0.06)]
        episode = record(lambda batch, generator: turned, 40)
        (track,) = cartpole_frames(World(CartPole(), turned)).label([blind(episode)])
        assert (rms(track.state - episode.state) < [2e-3, 1e-2, 5e-3, 2e-2]).all()

    @pytest.mark.parametrize("steps", [1, 2, 4])
    def test_short_episodes_have_sensible_states(self, tracker, steps):
        episode = record(constant_force(2.0), steps)
        track = tracker.track([blind(episode)])[0]
        error = np.abs(track.state - episode.state)
        assert (error[:, [0, 2]] < [2e-3, 6e-3]).all()
        assert (error[:, [1, 3]] < [0.1, 0.2]).all()

    def test_a_single_row_says_where_it_is(self, tracker):
        episode = record(no_effects, 0)
        track = tracker.track([blind(episode)])[0]
        np.testing.assert_allclose(track.state[0, [0, 2]], episode.state[0, [0, 2]], atol=3e-3)

    def test_no_episodes_have_no_tracks(self, tracker):
        assert tracker.track([]) == []

    def test_several_episodes_share_their_noise(self, tracker):
        episodes = [record(constant_force(2.0), 12, seed=seed) for seed in range(3)]
        for episode, track in zip(episodes, tracker.track([blind(e) for e in episodes]), strict=True):
            force = gap(track)[:, 1] / gap(episode)[:, 1]
            assert np.abs(force - 1).max() < 0.15

    def test_states_of_the_recording_are_not_looked_at_and_nothing_else_is_touched(self, tracker):
        episode = record(no_effects, 3)
        lying = tracker.track([replace(episode, state=episode.state + 1)])[0]
        np.testing.assert_array_equal(lying.state, tracker.track([blind(episode)])[0].state)
        assert lying.frame is episode.frame
        assert lying.action is episode.action
        assert lying.state.dtype == episode.action.dtype


class TestWhatCannotBeTracked:
    def test_a_blank_frame_is_left_out_with_one_line_and_bridged(self, tracker):
        episode = record(sine_force, 20)
        episode.frame[7] = 0
        with pytest.warns(TrackingWarning, match=r"episode 0: .* 1 of 21 frames, row 7 the first") as caught:
            track = tracker.track([blind(episode)])[0]
        assert len(caught) == 1
        assert "\n" not in str(caught[0].message)
        explained = tracker.poses(torch.from_numpy(episode.frame)).explained
        assert explained.tolist() == [row != 7 for row in range(21)]
        assert (np.abs(track.state - episode.state)[7] < [5e-3, 0.05, 1e-2, 0.1]).all()

    @pytest.mark.parametrize(("first", "last"), [(0, 21), (5, 16)])
    def test_too_many_of_them_are_an_error(self, tracker, first, last):
        episode = record(no_effects, 25)
        episode.frame[first:last] = SKY_GREY
        with pytest.raises(TrackingError, match=f"row {first} the first"):
            tracker.track([blind(episode)])

    def test_recordings_that_do_not_fit_are_refused(self, tracker):
        episode = record(no_effects, 3)
        with pytest.raises(TrackingError, match="episode 1 has no frames"):
            tracker.track([episode, replace(episode, frame=None)])
        with pytest.raises(TrackingError, match=r"50 x 120 .* draws 100 x 120"):
            tracker.track([replace(episode, frame=episode.frame[:, :50])])
        with pytest.raises(TrackingError, match=r"0.1 s apart; the period is 0.05 s"):
            tracker.track([replace(episode, time=2 * episode.time)])

    def test_a_camera_that_is_known_to_be_late_is_refused(self):
        setup = cartpole_frames(World(CartPole(), [CameraDelay(delay=0.05)]))
        with pytest.raises(TrackingError, match="states are not estimated from frames with camera_delay"):
            setup.label([blind(record(no_effects, 3))])

    def test_a_world_with_effects_is_refused(self):
        with pytest.raises(TrackingError, match="source physics alone"):
            Tracker(Sketch(), World(CartPole(), [ConstantForce(force=1.0)]))

    def test_no_effect_is_added_to_the_catalogue(self):
        assert not [name for name, effect in EFFECTS.items() if "tracking" in effect.__module__]
