import resource
from dataclasses import replace
from pathlib import Path

import imageio.v3 as imageio
import imageio_ffmpeg
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

from tests.full_disk import error_on_a_full_disk
from visadapt.films.cartpole_film import CartPoleFilm, CartPolePanel
from visadapt.films.widgets import RED
from visadapt.recordings import Episode
from visadapt.targets.rollout import Run

PERIOD = 0.05


def make_run(rows: int = 21, survived: bool = True, last_angle: float = 0.0, last_place: float = 0.1) -> Run:
    time = np.arange(rows) * PERIOD
    state = np.stack([0.1 * np.sin(time), 0.1 * np.cos(time), 0.02 * np.cos(3 * time), 0.0 * time], -1)
    state[-1, 0], state[-1, 2] = last_place, last_angle
    frame = np.full((rows, 100, 120), 245, np.uint8)
    episode = Episode(time, 0.3 * np.sin(4 * time)[:, None], state, frame)
    return Run(episode, survived, 2 * (np.sin(time) + 1))


def red_pixels(picture: np.ndarray) -> int:
    return int((np.abs(picture - 255 * np.array(to_rgb(RED))).max(-1) < 30).sum())


def test_a_film_is_decoded_as_it_was_drawn(tmp_path: Path):
    panels = [CartPolePanel("source", make_run()), CartPolePanel("target", make_run(9, False, 0.4))]
    path = tmp_path / "new folder" / "film.mp4"
    done: list[tuple[int, int]] = []
    CartPoleFilm(panels, PERIOD).write(path, lambda now, total, _: done.append((now, total)))
    reader = imageio_ffmpeg.read_frames(path)
    meta = next(reader)
    reader.close()
    assert meta["codec"] == "h264"
    assert meta["pix_fmt"].startswith("yuv420p")
    assert meta["fps"] == 1 / PERIOD
    frames = imageio.imread(path, plugin="FFMPEG")
    assert len(frames) == 21
    assert done == [(i, 21) for i in range(1, 22)]
    for i in (0, 10, 20):
        drawn = CartPoleFilm(panels, PERIOD).still(i * PERIOD)
        assert frames[i].shape == drawn.shape
        assert drawn.shape[0] % 2 == drawn.shape[1] % 2 == 0
        assert np.abs(frames[i].astype(float) - drawn).mean() < 2
    content = path.read_bytes()
    assert content.index(b"moov") < content.index(b"mdat"), "a browser must be able to start before the end"
    assert [entry.name for entry in path.parent.iterdir()] == ["film.mp4"]


def test_the_end_of_an_episode_is_marked_and_the_scene_stands_still():
    panel = CartPolePanel("target", make_run(9, False, 0.4))
    long = CartPolePanel("source", make_run(21))
    assert red_pixels(CartPoleFilm([panel, long], PERIOD).still(0.3)) == 0
    after = CartPoleFilm([panel, long], PERIOD).still(0.5)
    assert red_pixels(after) > 2000
    half = after.shape[1] // 2
    assert np.array_equal(after[:, :half], CartPoleFilm([panel, long], PERIOD).still(0.9)[:, :half])
    assert red_pixels(after[:, half:]) == 0


@pytest.mark.parametrize(
    ("survived", "angle", "place", "failure"),
    [
        (True, 0.0, 0.1, ""),
        (False, -0.35, 0.1, "FELL"),
        (False, 0.1, 1.6, "LEFT THE FRAME"),
        (False, 0.25, 0.1, "ENDED"),
    ],
)
def test_the_panel_says_how_an_episode_ended(survived: bool, angle: float, place: float, failure: str):
    panel = CartPolePanel("target", make_run(9, survived, angle, place))
    assert panel.failure(8, due=5.0) == (f"{failure} at t = 0.40 s" if failure else "")
    assert panel.failure(7, due=5.0) == ""


def test_the_limit_of_the_angle_decides_what_a_fall_is():
    run = make_run(9, False, 0.25)
    assert CartPolePanel("target", run, angle_limit=0.2).failure(8, 5.0).startswith("FELL")


def test_a_force_that_the_target_does_not_tell_is_a_dash():
    run = make_run()
    written = []
    for force in (np.zeros(len(run.episode.time)), None):
        numbers = CartPoleFilm([CartPolePanel("t", replace(run, force=force))], PERIOD).still(0.5)[490:]
        written.append(((numbers[..., 0] > 200) & (numbers[..., 2] < 60)).sum())
    assert 0 < written[1] < 0.3 * written[0]  # a dash in place of +0.00 N


def test_the_force_is_drawn_at_the_cart_on_the_side_it_pushes_from():
    run = make_run()
    orange = [
        CartPoleFilm([CartPolePanel("t", Run(run.episode, True, sign * run.force))], PERIOD).still(0.5)[340:420, 28:508]
        for sign in (1, -1)
    ]
    cart = 28 + 239.5 + 160 * run.episode.state[10, 0] - 28
    for picture, side in zip(orange, (1, -1), strict=True):
        columns = np.nonzero((picture[..., 0] > 200) & (picture[..., 2] < 60))[1]
        assert len(columns) > 200
        assert side * (cart - columns.mean()) > 30


@pytest.mark.parametrize("shape", [(100, 120), (100, 120, 3), (480, 480, 3), (37, 211)])
def test_pictures_of_any_size_fill_the_same_panel(shape: tuple[int, ...]):
    picture = np.full((21, *shape), 90, np.uint8)
    panels = [CartPolePanel("a camera with a title too long for its panel " * 3, make_run(), picture)]
    assert (
        CartPoleFilm(panels, PERIOD).still(0.2).shape
        == CartPoleFilm([CartPolePanel("drawn", make_run())], PERIOD).still(0.2).shape
    )


def test_an_episode_of_one_row_is_a_film_of_one_frame(tmp_path: Path):
    CartPoleFilm([CartPolePanel("target", make_run(1))], PERIOD).write(tmp_path / "film.mp4")
    assert len(imageio.imread(tmp_path / "film.mp4", plugin="FFMPEG")) == 1


def test_scales_are_shared_and_a_fall_does_not_squash_the_rest():
    run = make_run()
    run.episode.state[:, 1] *= 40
    fallen = CartPolePanel("fallen", Run(run.episode, False, run.force))
    assert CartPoleFilm([fallen], PERIOD).full_speed >= 4
    assert CartPoleFilm([fallen, CartPolePanel("upright", make_run())], PERIOD).full_speed == 0.5


def test_a_still_is_a_picture(tmp_path: Path):
    panels = [CartPolePanel("source", make_run())]
    CartPoleFilm(panels, PERIOD).write_still(tmp_path / "still.png", 0.3)
    with Image.open(tmp_path / "still.png") as picture:
        assert np.array_equal(np.asarray(picture), CartPoleFilm(panels, PERIOD).still(0.3))


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda run: CartPolePanel("a", run, np.zeros((20, 10, 10), np.uint8)), "21 rows, but there are 20 pictures"),
        (lambda run: CartPolePanel("a", run, np.zeros((21, 10, 10))), "must be uint8"),  # type: ignore[arg-type]
        (lambda run: CartPolePanel("a", run, np.zeros((21, 10, 10, 4), np.uint8)), "must be uint8"),
        (lambda run: CartPoleFilm([], PERIOD), "at least one panel"),
        (lambda run: CartPoleFilm([CartPolePanel("a", run)], 0.0), "must be positive"),
    ],
)
def test_bad_input_is_one_clear_line(make, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=says) as caught:
        make(make_run())
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_run_without_states_is_refused():
    frame = np.zeros((3, 10, 10), np.uint8)
    run = Run(Episode(np.arange(3.0), np.zeros((3, 1)), None, frame), True, np.zeros(3))
    with pytest.raises(ValueError, match="no states"):
        CartPolePanel("a", run, frame)


@pytest.mark.skipif(not hasattr(resource, "RLIMIT_FSIZE"), reason="needs a limit on the size of files")
def test_a_disk_that_fills_up_leaves_the_old_film(tmp_path: Path):
    """A limit on the size of a file stands for a full disk: ffmpeg is stopped in the middle of writing."""
    old = tmp_path / "film.mp4"
    old.write_bytes(b"the film of yesterday")
    film = CartPoleFilm([CartPolePanel("a", make_run(10))], PERIOD)
    said = error_on_a_full_disk(lambda: film.write(old))
    assert str(old) in said
    assert "was not written" in said
    assert len(said.strip().splitlines()) == 1
    assert old.read_bytes() == b"the film of yesterday"
    assert list(tmp_path.iterdir()) == [old]


def test_an_ffmpeg_that_finds_the_disk_full_is_reported_as_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    fake = tmp_path / "ffmpeg"
    fake.write_text("#!/bin/sh\necho 'av_interleaved_write_frame(): No space left on device' >&2\nexit 228\n")
    fake.chmod(0o755)
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: str(fake))
    with pytest.raises(OSError, match=r"film\.mp4 was not written: disk full"):
        CartPoleFilm([CartPolePanel("a", make_run(5))], PERIOD).write(tmp_path / "film.mp4")
    assert list(tmp_path.iterdir()) == [fake]
