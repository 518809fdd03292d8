"""A film and its commands are diagnosed as recordings of states are; what cannot be is refused by one clear line."""

from pathlib import Path

import numpy as np
import pytest
import torch

import visadapt as va
from renderers import DrawnCartPole, load_renderer
from visadapt.cli import main as cli
from visadapt.effects import ViscousFriction

RENDERER = va.shipped("renderer")


def film(path, effects=(), camera=lambda frames: frames, episodes=5, rows=60, seed=2):
    """A film of the drawn cart-pole, kept upright with some noise in the command; two grey levels of noise."""
    target = va.SyntheticTarget(lambda batch, generator: effects, camera=DrawnCartPole())
    policy = va.load_policy(va.shipped("cartpole_frames"))
    runs = va.run(target, policy, episodes, rows, torch.Generator().manual_seed(seed), exploration=0.4)
    noise = np.random.default_rng(seed)
    shown = []
    for one in runs:
        frame = 255 * camera(torch.from_numpy(one.episode.frame) / 255).numpy()
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


class TestMotion:
    def test_friction_is_found_in_a_film(self, tmp_path):
        found = diagnosed(film(tmp_path / "run.h5", [ViscousFriction(coefficient=3.0)]))
        assert found.verdict == "identified"
        assert [cause.effect for cause in found.causes] == ["viscous_friction"]
        assert found.causes[0].parameters["coefficient"].value == pytest.approx(3.0, rel=0.02)

    def test_frames_that_are_not_explained_are_left_out_with_a_warning(self, still):
        def flash(frame):
            frame[[7, 8, 20]] = 0
            return frame

        found = diagnosed(rewritten(still, frame=flash))
        assert any("does not explain 3 of" in line and "row 8 " in line for line in found.warnings)
        assert found.verdict == "no_gap"
        assert np.isnan(found.where.states["x_dot"])


class TestBadInput:
    def test_a_film_without_a_renderer(self, still, capsys):
        assert "--renderer" in refused(capsys, still)

    def test_another_size(self, still, capsys):
        path = rewritten(still, frame=lambda frame: frame[:, :, :100])
        assert "frames of 100 x 100 px (height x width); the renderer draws 100 x 120 px" in refused(
            capsys, path, "--renderer", RENDERER
        )

    def test_another_scene(self, still, capsys):
        path = rewritten(still, frame=lambda frame: 255 - frame)
        assert "it is of another scene" in refused(capsys, path, "--renderer", RENDERER)

    def test_a_frozen_film(self, still, capsys):
        path = rewritten(still, frame=lambda frame: np.repeat(frame[:1], len(frame), 0))
        assert "frames are the same" in refused(capsys, path, "--renderer", RENDERER)

    def test_a_film_without_times_and_commands(self, tmp_path, capsys):
        (tmp_path / "run.mp4").write_bytes(b"\0\0\0\x18ftypmp42")
        assert "no HDF5 file; times, commands and frames" in refused(
            capsys, tmp_path / "run.mp4", "--renderer", RENDERER
        )

    def test_a_film_without_commands(self, still, capsys):
        path = rewritten(still, action=lambda action: action[:, :0])
        assert "0 of action" in refused(capsys, path, "--renderer", RENDERER)

    def test_a_vehicle(self, still, capsys):
        assert "renderers draw a cart-pole" in refused(capsys, still, "--renderer", RENDERER, system="quadrotor")
