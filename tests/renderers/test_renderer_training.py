import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from benchmarks.pose_estimator import measure
from datasets import cartpole_frames
from renderers import Camera, DrawnCartPole, LayeredRenderer, MLPRenderer, RendererError, load_renderer, save_renderer
from renderers.training import fit
from visadapt.estimation.poses import PoseFinder
from visadapt.weights import shipped

MLP = Path(__file__).parents[2] / "assets/renderer_mlp.safetensors"
SMALL = Camera(width=48, height=40, scale=16.0, column=23.5, row=29.5)


@pytest.fixture(scope="module")
def small():
    """Frames of a small camera: x, theta, frames."""
    rng = np.random.default_rng(3)
    x, theta = rng.uniform(-1.5, 1.5, 400), rng.uniform(-1.0, 1.0, 400)
    frames = DrawnCartPole(SMALL)(x, theta)
    return torch.from_numpy(x).float(), torch.from_numpy(theta).float(), torch.from_numpy(frames)


def from_aside(frames):
    """Frames (N, H, W) as a camera would see them that is turned to the side and downwards, through a wide lens."""
    height, width = frames.shape[1:]
    u, v = np.meshgrid((np.arange(width) - width / 2) / width, (np.arange(height) - height / 2) / width)
    u, v = (each * (1 + 0.2 * (u**2 + v**2)) for each in (u, v))
    nearer = 1 + 0.3 * u - 0.15 * v
    column, row = width * (u / nearer) + width / 2, width * ((v + 0.05 * u) / nearer) + height / 2
    columns, rows = column.astype(np.float32), row.astype(np.float32)
    seen = [cv2.remap(one, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for one in frames]
    return np.stack(seen)


def made(kind):
    torch.manual_seed(0)
    if kind == "mlp":
        return MLPRenderer(SMALL.height, SMALL.width)
    # The hinge is guessed a pixel and a half away, and a metre 5 % too short.
    return LayeredRenderer(SMALL.height, SMALL.width, column=22.0, row=28.5, scale=15.2, reach=1.1)


def states(seed, count):
    """Positions at which the whole cart and half of the pole, or more, are in the frame, and angles near upright."""
    rng = np.random.default_rng(seed)
    far = Camera().reach - 0.25
    return rng.uniform(-far, far, count), rng.uniform(-0.3, 0.3, count)


class TestMeasure:
    def test_drawn_frames_are_read_to_a_few_millimetres_and_tenths_of_a_degree(self):
        scene = DrawnCartPole()
        x, theta = states(5, 300)
        seen_x, seen_theta = measure(scene(x, theta), scene)
        assert np.abs(seen_x - x).max() < 0.004
        # The largest are of poles that lean out of the frame: few of their pixels are seen.
        assert np.degrees(np.sqrt(np.square(seen_theta - theta).mean())) < 0.1
        assert np.degrees(np.abs(seen_theta - theta).max()) < 0.5

    def test_a_cart_cut_by_the_edge_of_the_frame_is_placed_by_its_other_edge(self):
        scene = DrawnCartPole()
        x = np.array([-1.48, -1.4, 1.4, 1.48])
        np.testing.assert_allclose(measure(scene(x, -0.3 * np.sign(x)), scene)[0], x, atol=0.005)

    def test_large_angles_up_to_80_degrees(self):
        scene = DrawnCartPole()
        theta = np.radians([-79.0, -60.0, 45.0, 79.0])
        np.testing.assert_allclose(measure(scene(np.zeros(4), theta), scene)[1], theta, atol=np.radians(0.3))

    def test_floating_point_frames_are_read_like_bytes(self):
        scene = DrawnCartPole()
        frames = scene(*states(6, 5))
        np.testing.assert_allclose(measure(frames / 255, scene), measure(frames, scene))

    def test_nothing_is_read_where_there_is_nothing(self):
        scene = DrawnCartPole()
        x, theta = measure(
            np.concatenate([scene(np.array([8.0]), np.zeros(1)), np.zeros((1, 100, 120), np.uint8)]), scene
        )
        assert np.isnan(x[0])
        assert np.isnan(theta).all()

    def test_frames_of_another_size_are_refused(self):
        with pytest.raises(ValueError, match=r"\(1, 40, 48\).*100, 120"):
            measure(np.zeros((1, 40, 48), np.uint8), DrawnCartPole())


class TestFit:
    @pytest.mark.parametrize(("kind", "steps", "share"), [("layered", 200, 0.05), ("mlp", 200, 0.7)])
    def test_the_error_falls_below_a_share_of_the_frames_variance(self, small, kind, steps, share):
        x, theta, frames = small
        renderer, calls = made(kind), []
        fit(renderer, x, theta, frames, steps, torch.Generator().manual_seed(0), progress=lambda *a: calls.append(a))
        truth = frames.float() / 255
        with torch.no_grad():
            error = (renderer(x, theta) - truth).square().mean()
        assert error < share * truth.var(0).mean()
        assert [call[:2] for call in calls] == [(step + 1, steps) for step in range(steps)]

    def test_the_layered_renderer_finds_the_camera(self, small):
        renderer = made("layered")
        x, theta, frames = small
        fit(renderer, x, theta, frames, 300, torch.Generator().manual_seed(0))
        origin, gain = renderer.origin.detach().numpy(), renderer.gain.detach().numpy()
        np.testing.assert_allclose(origin, [SMALL.column, SMALL.row], atol=0.1)
        np.testing.assert_allclose(gain, [SMALL.scale, 0.0], atol=0.1)

    def test_a_camera_that_looks_from_aside_through_a_wide_lens_is_found(self, small):
        x, theta, frames = small
        seen = torch.from_numpy(from_aside(frames.numpy()))
        renderer = made("layered")
        fit(renderer, x[40:], theta[40:], seen[40:], 600, torch.Generator().manual_seed(0))
        for parameter in renderer.parameters():
            parameter.requires_grad_(False)
        poses = PoseFinder(renderer, 1.2)(seen[:40])
        whole = (x[:40].abs() < 1.0) & poses.explained
        assert whole.sum() > 20
        error = (poses.pose - torch.stack((x, theta), -1)[:40])[whole].abs().median(0).values
        assert error[0] < 0.004  # m, 0.06 px: pictures that move as seen by a square camera leave 0.010 m, 0.027 rad
        assert error[1] < 0.012

    @pytest.mark.parametrize("kind", ["layered", "mlp"])
    def test_the_same_seed_gives_the_same_weights(self, small, kind):
        x, theta, frames = small
        first, second = made(kind), made(kind)
        for renderer in (first, second):
            fit(renderer, x, theta, frames, 5, torch.Generator().manual_seed(4))
        for key, value in first.state_dict().items():
            assert torch.equal(value, second.state_dict()[key]), key


class TestShipped:
    def test_position_and_angle_read_from_its_frames_are_right_to_a_centimetre_and_half_a_degree(self):
        scene = DrawnCartPole()
        x, theta = states(77, 200)
        with torch.no_grad():
            frames = load_renderer(shipped("renderer"), (100, 120))(
                torch.from_numpy(x).float(), torch.from_numpy(theta).float()
            ).numpy()
        seen_x, seen_theta = measure(frames, scene)
        assert np.abs(seen_x - x).max() < 0.01
        assert np.degrees(np.abs(seen_theta - theta).max()) < 0.5

    def test_the_papers_mlp_is_there_too(self):
        assert isinstance(load_renderer(MLP, (100, 120)), MLPRenderer)


class TestFiles:
    @pytest.mark.parametrize("kind", ["layered", "mlp"])
    def test_a_saved_renderer_renders_the_same(self, small, kind, tmp_path):
        x, theta, frames = small
        renderer = made(kind)
        fit(renderer, x, theta, frames, 3, torch.Generator().manual_seed(0))
        save_renderer(tmp_path / "r.safetensors", renderer, {"seed": 0})
        loaded = load_renderer(tmp_path / "r.safetensors", (40, 48))
        assert type(loaded) is type(renderer)
        assert torch.equal(loaded(x[:5], theta[:5]), renderer(x[:5], theta[:5]))

    def test_files_that_are_no_renderers_are_named_in_one_line(self, tmp_path):
        whole = tmp_path / "whole.safetensors"
        save_renderer(whole, made("layered"), {})
        paths = {name: tmp_path / f"{name}.safetensors" for name in ("none", "torn", "text", "foreign", "newer")}
        paths["torn"].write_bytes(whole.read_bytes()[:-100])
        paths["text"].write_text("not a checkpoint")
        save_file({"a": torch.zeros(1)}, paths["foreign"])
        save_file({"a": torch.zeros(1)}, paths["newer"], {"renderers": json.dumps({"format": 2})})
        for path in paths.values():
            with pytest.raises(RendererError, match=f"^{path}: ") as caught:
                load_renderer(path)
            assert "\n" not in str(caught.value)

    @pytest.mark.parametrize(
        ("spoil", "says"),
        [
            (lambda weights: weights.pop("tilt"), r'Missing key\(s\) .* "tilt"'),
            (lambda weights: weights.update(extra=torch.zeros(1)), r'Unexpected key\(s\) .* "extra"'),
            (lambda weights: weights.update(gain=torch.zeros(3)), r"size mismatch for gain: .*\[3\].*\[2\]"),
        ],
    )
    def test_weights_of_another_architecture_are_refused(self, spoil, says, tmp_path):
        renderer = made("layered")
        weights = dict(renderer.state_dict())
        spoil(weights)
        header = {"format": 1, "kind": "layered", "arguments": renderer.arguments, "training": {}}
        save_file(weights, tmp_path / "r.safetensors", {"renderers": json.dumps(header)})
        with pytest.raises(RendererError, match=f"another architecture: .*{says}") as caught:
            load_renderer(tmp_path / "r.safetensors")
        assert "\n" not in str(caught.value)

    def test_frames_of_another_size_are_refused(self, tmp_path):
        save_renderer(tmp_path / "r.safetensors", made("mlp"), {})
        with pytest.raises(RendererError, match="48 x 40 px, 120 x 100 are needed"):
            load_renderer(tmp_path / "r.safetensors", (100, 120))


class TestFrames:
    SETTINGS = cartpole_frames.Settings(frames=50, seed=2)

    def test_states_are_as_asked_for_and_depend_on_the_seed_alone(self):
        made = cartpole_frames.make(cartpole_frames.Settings(frames=500, seed=2))
        far = Camera().reach + 0.2
        assert np.abs(made.x).max() < far
        assert np.abs(made.x).max() > 0.95 * far
        assert 0.65 < (np.abs(made.theta) < 0.45).mean() < 0.9
        again = cartpole_frames.make(cartpole_frames.Settings(frames=500, seed=2))
        np.testing.assert_array_equal(made.frames, again.frames)

    def test_a_data_set_is_read_as_it_was_written(self, tmp_path):
        path = tmp_path / "frames.h5"
        cartpole_frames.main(cartpole_frames.Settings(out=path, frames=50, seed=2))
        made, read = cartpole_frames.make(self.SETTINGS), cartpole_frames.read(path)
        for name in ("x", "theta", "frames"):
            np.testing.assert_array_equal(getattr(read, name), getattr(made, name))

    def test_a_file_that_is_no_data_set_is_named(self, tmp_path):
        (tmp_path / "torn.h5").write_text("torn")
        for name in ("none.h5", "torn.h5"):
            with pytest.raises(ValueError, match=name):
                cartpole_frames.read(tmp_path / name)
