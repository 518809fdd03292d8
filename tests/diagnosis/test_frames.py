"""A film and its commands are diagnosed as recordings of states are; what cannot be is refused by one clear line."""

import copy
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import torch

import visadapt as va
from renderers import DrawnCartPole, load_renderer
from tests.diagnosis.test_report import SCHEMA
from tests.scenes import small_renderer
from visadapt.cli import main as cli
from visadapt.diagnosis.frames import watch, with_camera
from visadapt.diagnosis.result import Gap, RecordingSummary, Region, Where
from visadapt.diagnosis.search import camera
from visadapt.effects import (
    Blur,
    Brightness,
    CameraRotation,
    CameraShift,
    Gamma,
    Occlusion,
    ViscousFriction,
)
from visadapt.estimation.camera_fit import through
from visadapt.estimation.poses import PoseFinder
from visadapt.targets import Start

RENDERER = va.shipped("renderer")
MOTION = ("viscous_friction", "coulomb_friction", "pole_damping", "actuator_gain", "actuator_delay", "angle_offset")


@pytest.fixture(autouse=True)
def few_frames(monkeypatch):
    """A camera is fitted to half as many frames of a film, for the time it takes."""
    monkeypatch.setattr(camera, "FRAMES", 8)


@pytest.fixture
def only_cameras(monkeypatch):
    """Leaves these effects of the camera to be looked for."""
    return lambda *kinds: monkeypatch.setattr(camera, "SEARCHED", kinds)


def film(path, effects=(), seen=lambda frames: frames, episodes=3, rows=40, seed=2, exploration=0.4, **options):
    """A film of the drawn cart-pole, kept upright with some noise in the command; two grey levels of noise."""
    target = va.SyntheticTarget(lambda batch, generator: effects, camera=DrawnCartPole(), **options)
    policy = va.load_policy(va.shipped("cartpole_frames"))
    runs = va.run(target, policy, episodes, rows, torch.Generator().manual_seed(seed), exploration)
    noise = np.random.default_rng(seed)
    shown = []
    for one in runs:
        frame = 255 * seen(torch.from_numpy(one.episode.frame) / 255).numpy()
        frame = (frame + 2 * noise.standard_normal(frame.shape)).round().clip(0, 255).astype(np.uint8)
        shown.append(va.Episode(time=one.episode.time, action=one.episode.action, frame=frame))
    va.write_recording(path, shown)
    return path


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    """A film in which nothing departs from the source."""
    return film(tmp_path_factory.mktemp("film") / "run.h5", episodes=2, rows=30)


def rewritten(path, **changed):
    """The film with arrays of its first episode changed, each by a function."""
    episodes = va.read_recording(path)
    old = episodes[0]
    arrays = {name: getattr(old, name) for name in ("time", "action", "frame")}
    episodes[0] = va.Episode(**{name: changed.get(name, lambda a: a)(array) for name, array in arrays.items()})
    out = path.with_name("changed.h5")
    va.write_recording(out, episodes[:1])
    return out


def refused(capsys, *arguments, system="cartpole"):
    """The line by which the command refuses its input."""
    assert cli.main(["diagnose", *map(str, arguments), "--system", system]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[-1].startswith("visadapt: ")
    return lines[-1]


def diagnosed(path, **options):
    system = va.CartPole()
    recording = va.load_recording(path, system, frames=True)
    world = va.World(system, period=recording.period)
    return va.diagnose(recording, world, renderer=load_renderer(Path(RENDERER)), **options)


@torch.inference_mode()
def watched(recording, renderer=None):
    """What a recording, or a file of one, was found to show."""
    if isinstance(recording, Path):
        recording = va.load_recording(recording, va.CartPole(), frames=True)
    return watch(recording, va.CartPole(), renderer or load_renderer(Path(RENDERER)))


class Drawn(torch.nn.Module):
    """A renderer of one's own, without parameters: the drawing itself."""

    def forward(self, x, theta):
        return torch.from_numpy(DrawnCartPole()(x.numpy(), theta.numpy())).to(x) / 255


class TestMotion:
    def test_friction_is_found_in_a_film(self, tmp_path, only_effects, only_cameras):
        only_effects(*MOTION)
        only_cameras(Brightness, CameraRotation)
        found = diagnosed(film(tmp_path / "run.h5", [ViscousFriction(coefficient=3.0)]))
        assert found.verdict == "identified"
        assert [cause.effect for cause in found.causes] == ["viscous_friction"]
        assert found.causes[0].parameters["coefficient"].value == pytest.approx(3.0, rel=0.02)

    def test_an_episode_of_one_frame_is_left_out(self, still, only_cameras):
        only_cameras(Brightness, Gamma, Blur)
        recording = va.load_recording(still, va.CartPole(), frames=True)
        first = recording.episodes[0]
        alone = va.Episode(first.time[:1], first.action[:1], frame=first.frame[:1])
        shown = watched(replace(recording, episodes=(first, alone))).positions
        assert [len(episode.time) for episode in shown.episodes] == [len(first.time)]

    @pytest.mark.parametrize("renderer", [Drawn(), load_renderer(Path(RENDERER)).double()])
    def test_a_renderer_without_parameters_or_in_double_precision(self, still, only_cameras, renderer):
        only_cameras(Brightness, Gamma, Blur)
        places, expected = (
            np.concatenate([episode.state for episode in watched(still, each).positions.episodes])
            for each in (renderer, None)
        )
        assert places == pytest.approx(expected, abs=2e-3)

    def test_a_cart_is_found_as_far_as_the_renderer_shows_it(self, only_cameras):
        only_cameras(Brightness, Gamma, Blur)
        time = 0.05 * np.arange(60)
        places = np.stack([4.5 * np.sin(time), 0.1 * np.cos(3 * time)], 1)
        renderer = small_renderer(width=80)  # 8 px a metre
        frame = (255 * renderer(*torch.from_numpy(places).float().T)).round().to(torch.uint8).numpy()
        episode = va.Episode(time, np.zeros((60, 1)), frame=frame)
        (shown,) = watched(va.Recording((episode,), (), 0.05, ("run.h5",)), renderer).positions.episodes
        assert shown.state == pytest.approx(places, abs=0.02)

    def test_frames_that_are_not_explained_are_left_out_with_a_warning(self, still, only_effects, only_cameras):
        only_effects(*MOTION)
        only_cameras(Brightness, CameraRotation)

        def flash(frame):
            frame[[7, 8, 20]] = 0
            return frame

        found = diagnosed(rewritten(still, frame=flash))
        assert any("no pose was found in 3 of" in line and "row 8 of" in line for line in found.warnings)
        assert found.verdict == "no_gap"
        assert np.isnan(found.where.states["x_dot"])


@pytest.fixture(scope="module")
def poses():
    """A renderer, the finder of poses in its frames, and drawn frames in [0, 1] of cart-poles anywhere."""
    renderer = load_renderer(Path(RENDERER)).requires_grad_(False)
    places = np.random.default_rng(0).uniform((-0.8, -0.2), (0.8, 0.2), (8, 2))
    drawn = torch.from_numpy(DrawnCartPole()(*places.T)).float() / 255
    return renderer, PoseFinder(renderer, 1.5), drawn


class WiderThan(torch.nn.Module):
    """A renderer with 30 px more to either side, which repeat the edge."""

    def __init__(self, renderer):
        super().__init__()
        self.renderer, self.wide = renderer, torch.nn.ReplicationPad2d((30, 30, 0, 0))

    def forward(self, x, theta):
        return self.wide(self.renderer(x, theta))


def camera_of(poses, *effects):
    """The camera found in frames with effects and noise."""
    renderer, finder, drawn = poses
    frames = 255 * through(drawn, effects).detach()
    noise = 2 * torch.randn(frames.shape, generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        return camera.find_camera(renderer, finder, (frames + noise).round().clamp(0, 255).to(torch.uint8))


def values(cause):
    return {name: estimate.value for name, estimate in cause.parameters.items()}


class TestCamera:
    def test_a_camera_that_is_as_it_should_be_has_no_fault(self, poses):
        assert camera_of(poses).causes() == []

    def test_a_turned_darker_picture(self, poses, only_cameras):
        only_cameras(CameraRotation, Brightness, Gamma)
        found = camera_of(poses, CameraRotation(angle=0.1), Brightness(gain=0.8, offset=0.1))
        assert {cause.effect: values(cause) for cause in found.causes()} == {
            "camera_rotation": {"angle": pytest.approx(0.1, abs=1e-3)},
            "brightness": {"gain": pytest.approx(0.8, abs=5e-3), "offset": pytest.approx(0.1, abs=5e-3)},
        }

    def test_effects_that_explain_the_frames_as_well_are_causes_with_values_and_share_the_probability(
        self, poses, only_cameras
    ):
        only_cameras(Gamma, Brightness, Blur)
        gamma, brightness = camera_of(poses, Gamma(exponent=1.03)).causes()
        assert (gamma.effect, gamma.indistinguishable_from, gamma.probability) == ("gamma", ("brightness",), 0.5)
        assert (brightness.indistinguishable_from, brightness.probability) == (("gamma",), 0.5)
        assert values(brightness) == {
            "gain": pytest.approx(1.015, abs=0.005),
            "offset": pytest.approx(-0.015, abs=0.005),
        }

    def test_a_box_in_front(self, poses):
        box = {"left": 20.0, "top": 30.0, "right": 45.0, "bottom": 60.0, "grey": 0.35}
        (cause,) = camera_of(poses, Occlusion(**box)).causes()
        assert values(cause) == pytest.approx(box, abs=0.1)

    def test_a_box_in_front_of_a_wide_frame(self, poses, only_cameras):
        only_cameras(Occlusion, Blur)
        seen = WiderThan(poses[0])
        box = {"left": 140.0, "top": 10.0, "right": 165.0, "bottom": 50.0, "grey": 0.2}
        (cause,) = camera_of((seen, PoseFinder(seen, 1.5), seen.wide(poses[2])), Occlusion(**box)).causes()
        assert values(cause) == pytest.approx(box, abs=0.1)
        assert all(low <= one.value <= high for one in cause.parameters.values() for low, high in [one.ci90])

    def test_a_camera_moved_along_a_featureless_track_is_a_cart_elsewhere(self, poses):
        (cause,) = camera_of(poses, CameraShift(dx=4.0, dy=-3.0)).causes()
        assert cause.parameters["dy"].value == pytest.approx(-3.0, abs=0.05)
        assert cause.parameters["dx"].ci90 == (-20.0, 20.0)

    def test_a_camera_moved_along_a_wall_with_posts_is_found_beside_another_fault(self, poses, only_cameras):
        only_cameras(CameraShift, Brightness, Blur)
        renderer, frames = copy.deepcopy(poses[0]), poses[2].clone()
        for post in ((slice(88, 98), slice(20, 32)), (slice(4, 14), slice(95, 110))):
            renderer.background[post] = -2.0
            frames[:, *post] = 0.12
        scene = renderer, PoseFinder(renderer, 1.5), frames
        found = camera_of(scene, CameraShift(dx=4.0, dy=0.0), Brightness(gain=0.5, offset=0.0))
        assert {cause.effect: values(cause) for cause in found.causes()} == {
            "camera_shift": {"dx": pytest.approx(4.0, abs=0.05), "dy": pytest.approx(0.0, abs=0.05)},
            "brightness": {"gain": pytest.approx(0.5, abs=5e-3), "offset": pytest.approx(0.0, abs=5e-3)},
        }

    def test_it_is_a_cause_beside_that_of_the_motion(self, tmp_path, only_effects, only_cameras):
        only_effects("viscous_friction", "coulomb_friction", "actuator_gain")
        only_cameras(Blur, Brightness)

        def blurred(frames):
            return through(frames.float(), [Blur(sigma=1.0)]).detach()

        path = film(tmp_path / "run.h5", [ViscousFriction(coefficient=3.0)], blurred, episodes=2)
        found = diagnosed(path)
        assert (found.verdict, [cause.effect for cause in found.causes]) == ("identified", ["blur", "viscous_friction"])
        assert found.where.stages["camera"] > 0
        assert found.where.stages["dynamics"] > 0
        assert [effect.name for effect in found.effects()] == ["blur", "viscous_friction"]
        jsonschema.Draft202012Validator(SCHEMA).validate(found.to_json())

    def test_an_effect_without_which_hardly_any_misfit_opens_again_is_slight(self, poses, only_cameras):
        only_cameras(Brightness, Blur, Gamma)
        causes = camera_of(poses, Brightness(gain=0.4, offset=0.1), Blur(sigma=0.6)).causes()
        assert {cause.effect: cause.slight for cause in causes} == {"brightness": False, "blur": True}
        assert all(cause.slight == (cause.gap_reopened < 0.01) for cause in causes)

    def test_a_strength_at_the_end_of_its_range_may_lie_beyond_it(self, tmp_path, only_effects, only_cameras):
        only_effects("actuator_gain")
        only_cameras(Brightness, Gamma, Blur)

        def dark(frames):
            return through(frames.float(), [Brightness(gain=0.25, offset=0.1)]).detach()

        found = diagnosed(film(tmp_path / "run.h5", seen=dark, episodes=1, rows=30))
        gain = found.causes[0].parameters["gain"]
        assert gain.value == pytest.approx(0.3)
        assert np.isnan(gain.ci90[0])
        assert gain.ci90[1] > 0.3
        assert any(line.startswith("brightness: gain is at 0.3, the end of the range") for line in found.warnings)

    def test_lost_frames(self, tmp_path, only_effects, only_cameras):
        only_effects(*MOTION)
        only_cameras(Brightness, CameraRotation)
        path = rewritten(film(tmp_path / "run.h5", episodes=1, rows=60), frame=repeat_every_fifth)
        (cause,) = diagnosed(path).causes
        assert cause.effect == "frame_drop"
        assert values(cause)["rate"] == pytest.approx(0.2, abs=0.03)

    def test_lost_frames_beside_a_darker_picture_where_motion_shows_no_gap(self, tmp_path, only_effects, only_cameras):
        only_effects("constant_force")
        only_cameras(Brightness, Gamma, Blur)

        def dark(frames):
            return through(frames.float(), [Brightness(gain=0.7, offset=0.1)]).detach()

        nearly_at_rest = {"start": Start(0.02, 0.0, 0.01, 0.0), "exploration": 0.0}
        path = film(tmp_path / "run.h5", seen=dark, episodes=1, rows=30, **nearly_at_rest)
        found = diagnosed(rewritten(path, frame=repeat_every_fifth))
        assert [cause.effect for cause in found.causes] == ["brightness", "frame_drop"]
        assert "grey levels" in found.gap.measure
        assert found.gap.closed == pytest.approx(1, abs=0.01)

    def test_no_region_of_a_gap_that_motion_does_not_show(self, tmp_path, only_cameras):
        only_cameras(Brightness, Gamma, Blur)

        def dark(frames):
            return through(frames.float(), [Brightness(gain=0.7, offset=0.1)]).detach()

        seen = watched(film(tmp_path / "run.h5", seen=dark, episodes=1, rows=20))
        where = Where({"camera": 0.0}, {}, (Region("x", 0.01, 0.05, 0.6, 0.015),))
        gap = Gap("error", 0.5, 0.5, 0.5, 0.5, np.nan)
        motion = va.Diagnosis("cartpole", RecordingSummary(1, 19, 0.05), "no_gap", where, (), (), gap, "")
        found = with_camera(motion, seen, va.CartPole())
        assert [cause.effect for cause in found.causes] == ["brightness"]
        assert found.where.regions == ()


class TestPixels:
    def test_a_shadow_is_unexplained_and_the_motion_is_told_nevertheless(self, tmp_path, only_effects, only_cameras):
        only_effects("viscous_friction", "pole_damping", "actuator_gain")
        only_cameras(Brightness, Gamma)

        def shaded(frames):
            column = torch.arange(frames.shape[2])
            middle = 20 + 1.5 * torch.arange(len(frames))[:, None]
            return frames * (1 - 0.3 * torch.exp(-0.5 * ((column - middle) / 12).square()))[:, None]

        found = diagnosed(film(tmp_path / "run.h5", [ViscousFriction(coefficient=3.0)], shaded))
        assert (found.verdict, found.causes) == ("unexplained", ())
        assert found.where.pixels.unexplained
        assert any(line.startswith("found in the motion") and "viscous_friction" in line for line in found.warnings)
        jsonschema.Draft202012Validator(SCHEMA).validate(found.to_json())

    def test_what_is_wrong_in_one_place_is_found_there(self, still, only_effects, only_cameras):
        only_effects(*MOTION)
        only_cameras(Brightness, Gamma, Occlusion)

        def blinking(frame):
            frame[::2, 5:15, 80:110] -= 60
            return frame

        pixels = diagnosed(rewritten(still, frame=blinking)).where.pixels
        assert pixels.unexplained
        box = pixels.boxes[0]
        assert (box.left, box.top, box.right, box.bottom) == pytest.approx((80, 5, 110, 15), abs=2)
        assert box.share > 0.9

    def test_a_film_of_states_is_beside_its_predictions(self, still, only_effects, only_cameras):
        only_effects(*MOTION)
        only_cameras(Brightness, CameraRotation)
        found = diagnosed(still)
        assert found.where.pixels.boxes == ()
        frames = found.figures.film
        assert frames.filmed.shape == frames.predicted.shape
        assert np.abs(frames.filmed.astype(float) - frames.predicted).mean() < 5


def repeat_every_fifth(frame):
    frame[5::5] = frame[4:-1:5]
    return frame


class TestBadInput:
    def test_a_film_without_a_renderer(self, still, capsys):
        assert "--renderer" in refused(capsys, still)

    def test_a_film_without_a_renderer_in_python(self, still):
        system = va.CartPole()
        recording = va.load_recording(still, system, frames=True)
        with pytest.raises(
            ValueError, match=r"holds frames alone: give the scene's renderer, by renderer= or --renderer"
        ):
            va.diagnose(recording, va.World(system))

    def test_another_size(self, still, capsys):
        path = rewritten(still, frame=lambda frame: frame[:, :, :100])
        assert "frames of 100 x 100 px (height x width); the renderer draws 100 x 120 px" in refused(
            capsys, path, "--renderer", RENDERER
        )

    def test_another_scene(self, still, capsys, only_cameras):
        only_cameras(Brightness, Gamma)
        path = rewritten(still, frame=lambda frame: 255 - frame)
        assert "it is of another scene" in refused(capsys, path, "--renderer", RENDERER)

    def test_a_frozen_film(self, still, capsys):
        path = rewritten(still, frame=lambda frame: np.repeat(frame[:1], len(frame), 0))
        assert "frames are the same" in refused(capsys, path, "--renderer", RENDERER)

    def test_frames_out_of_order(self, tmp_path, capsys):
        time = 0.05 * np.arange(40)
        frame = DrawnCartPole()(0.6 * np.sin(2 * time), 0.15 * np.cos(3 * time))
        mixed = np.random.default_rng(0).permutation(40)
        va.write_recording(tmp_path / "a.h5", [va.Episode(time=time, action=np.zeros((40, 1)), frame=frame[mixed])])
        line = refused(capsys, tmp_path / "a.h5", "--renderer", RENDERER)
        assert "as no motion does: frames in the order of their rows are right" in line

    def test_a_film_without_times_and_commands(self, tmp_path, capsys):
        (tmp_path / "run.mp4").write_bytes(b"\0\0\0\x18ftypmp42")
        assert "run.mp4: a video, which holds no commands: an HDF5 file" in refused(
            capsys, tmp_path / "run.mp4", "--renderer", RENDERER
        )
        (tmp_path / "run.csv").write_text("time,command\n0,0\n")
        assert "no HDF5 file; times, commands and frames" in refused(
            capsys, tmp_path / "run.csv", "--renderer", RENDERER
        )

    def test_a_film_without_commands(self, still, capsys):
        path = rewritten(still, action=lambda action: action[:, :0])
        assert "0 of action" in refused(capsys, path, "--renderer", RENDERER)

    def test_a_vehicle(self, still, capsys):
        assert "renderers draw a cart-pole" in refused(capsys, still, "--renderer", RENDERER, system="quadrotor")
