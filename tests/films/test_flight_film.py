import resource
from dataclasses import replace
from pathlib import Path
from typing import cast

import imageio.v3 as imageio
import imageio_ffmpeg
import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgb
from PIL import Image

from tests.full_disk import error_on_a_full_disk
from visadapt.films.camera import FOLLOWING_CAMERA, NEAREST_M, ChaseCamera
from visadapt.films.flight_film import FlightFilm
from visadapt.films.flight_panel import FlightPanel
from visadapt.films.vehicle_shapes import drawn_parts, vehicle_parts
from visadapt.films.widgets import RED, VIOLET
from visadapt.recordings import Episode
from visadapt.systems import FixedWing, Quadrotor
from visadapt.systems.rigid_body import from_angles, rotation
from visadapt.targets.rollout import Run
from visadapt.tasks.base import FlightTask
from visadapt.tasks.follow import Follow
from visadapt.tasks.reach import Reach
from visadapt.tasks.references import Reference

SPEED = 1.5
"""m/s of the reference, along x"""


def along(seconds: float = 1.0) -> Follow:
    """A straight reference at a steady speed."""
    time = torch.arange(round(seconds / 0.1) + 1) * 0.1
    motion = torch.zeros(4, 1, len(time), 3)
    motion[0, 0, :, 0], motion[1, 0, :, 0] = SPEED * time, SPEED
    return Follow(Reference.of(motion, 0.1))


def beside(aside: tuple[float, float, float] = (0.0, 0.0, 0.0), rows: int = 11) -> np.ndarray:
    """States (rows, 13) of a quadrotor that flies beside its reference all the way."""
    state = np.zeros((rows, 13))
    state[:, 0], state[:, 3], state[:, 6] = SPEED * 0.1 * np.arange(rows), SPEED, 1.0
    state[:, :3] += aside
    return state


def flown(state: np.ndarray, survived: bool = True, force: np.ndarray | None = None) -> FlightPanel:
    rows = len(state)
    episode = Episode(np.arange(rows) * 0.1, np.zeros((rows, 4)), state)
    run = Run(episode, survived, np.zeros((rows, 3)) if force is None else force)
    return FlightPanel("a flight", run, Quadrotor(), along(), torch.tensor([0, 0]))


def beside_with(force: np.ndarray | None) -> FlightPanel:
    panel = following()
    return FlightPanel("a flight", replace(panel.run, force=force), Quadrotor(), along(), torch.tensor([0, 0]))


def following(aside: tuple[float, float, float] = (0.0, 0.0, 0.0), rows: int = 11, survived: bool = True):
    return flown(beside(aside, rows), survived)


def reaching(miss: float) -> FlightPanel:
    """A fixed wing that passes its target at a distance, to the left."""
    time = np.arange(140) * 0.05
    state = np.zeros((140, 13))
    state[:, 0], state[:, 1], state[:, 3], state[:, 6] = 11.5 * time, miss, 11.5, 1.0
    run = Run(Episode(time, np.zeros((140, 4)), state), True, None)
    return FlightPanel("a flight", run, FixedWing(), Reach(), torch.tensor([50.0, 0.0, 0.0]))


def count(picture: np.ndarray, colour: str) -> int:
    return int((np.abs(picture - 255 * np.array(to_rgb(colour))).max(-1) < 30).sum())


def test_positions_between_rows_go_through_the_rows_and_errors_are_the_course_s():
    panel = following((0.0, 0.03, 0.04))
    np.testing.assert_allclose(panel.position[::5], panel.states[:, :3], atol=1e-6)
    np.testing.assert_allclose(panel.position[:, 0], SPEED * panel.times, atol=1e-6)
    states = torch.from_numpy(panel.states)[None]
    assert panel.score[-1] == pytest.approx(float(along().misses(states, torch.tensor([[0, 0]])).mean()), abs=1e-6)
    assert panel.score[-1] == pytest.approx(0.05)
    wing = reaching(0.2)
    states = torch.from_numpy(np.array(wing.run.episode.state))[None]
    assert wing.worst == pytest.approx(float(Reach().misses(states, torch.tensor([[50.0, 0.0, 0.0]]))))
    assert wing.passed == pytest.approx(50 / 11.5, abs=0.051)
    np.testing.assert_allclose(wing.nearest, (50, 0.2, 0), atol=1e-6)
    assert wing.end == pytest.approx(wing.passed + 0.5, abs=0.051)


def test_attitudes_between_rows_do_not_care_about_the_sign_of_a_quaternion():
    turned = from_angles(torch.tensor([[0.1 * k, -0.3, 0.2] for k in range(11)]))
    state = beside()
    state[:, 6:10] = turned * torch.tensor([1.0, -1.0]).repeat(6)[:11, None]
    attitude = flown(state).attitude
    np.testing.assert_allclose(attitude[::5], rotation(turned), atol=1e-5)
    middle = rotation(from_angles(torch.tensor([[0.05, -0.3, 0.2]])))[0]
    np.testing.assert_allclose((attitude[2] + attitude[3]) / 2, middle, atol=0.02)


def test_a_camera_sees_points_where_similar_triangles_put_them_and_none_behind_it():
    camera = ChaseCamera((0.0, -10.0, 0.0), (0.0, 0.0, 0.0), 500.0)
    points = np.array([[0.0, 0, 0], [2, 0, 0], [0, 0, 1], [2, 10, 1], [0, NEAREST_M / 2 - 10, 0], [0, -20, 0]])
    seen, depth = camera.project(points + np.array([3.0, 4.0, 5.0]), np.array([3.0, 4.0, 5.0]))
    np.testing.assert_allclose(seen[:4], [[0, 0], [100, 0], [0, 50], [50, 25]], atol=1e-9)
    np.testing.assert_allclose(depth[:4], [10, 10, 10, 20])
    assert np.isnan(seen[4:]).all()


@pytest.mark.parametrize("vehicle", [Quadrotor(), FixedWing()])
@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (0.8, -0.4, 2.0)])
def test_a_vehicle_is_drawn_where_it_is_as_it_is_turned(vehicle, angles: tuple[float, float, float]):
    camera, place = ChaseCamera((-2.0, -4.0, 1.5), (0.0, 0.0, 0.0), 500.0), np.array([0.4, 1.0, -0.2])
    turned = rotation(from_angles(torch.tensor([angles])))[0].double().numpy()
    parts = vehicle_parts(vehicle)
    drawn = drawn_parts(parts, place, turned, lambda points: camera.project(points, np.zeros(3)))[1]
    assert len(drawn["verts"]) == len(drawn["facecolors"]) == len(parts)
    corners = np.concatenate([part.corners for part in parts])
    expected = camera.project(place + corners @ turned.T, np.zeros(3))[0]
    shown = np.concatenate(drawn["verts"])
    np.testing.assert_allclose(shown.min(0), expected.min(0), atol=0.1)
    np.testing.assert_allclose(shown.max(0), expected.max(0), atol=0.1)


@pytest.mark.parametrize("aside", [(0.3, 0.0, 0.0), (-0.3, 0.0, 0.2), (0.0, 0.3, -0.3)])
def test_the_error_is_drawn_from_the_reference_to_the_vehicle(aside: tuple[float, float, float]):
    scene = FlightFilm([following(aside), following()]).still(0.02)[56:416, 28:508]
    ends = FOLLOWING_CAMERA.project(np.stack([np.zeros(3), np.array(aside)]), np.zeros(3))[0] * (1, -1) + (240, 180)
    np.testing.assert_allclose(ends[0], (240, 180), atol=1e-6)
    between = ends[0] + np.linspace(0.2, 0.8, 9)[:, None] * (ends[1] - ends[0])
    near = [scene[round(y) - 2 : round(y) + 2, round(x) - 2 : round(x) + 2] for x, y in between]
    assert sum(count(part, RED) > 0 for part in near) >= 7  # the thrust's arrow may cover some


def test_a_hidden_force_is_drawn_towards_where_it_pushes():
    columns = []
    for newtons in (2.0, -2.0):
        panel = flown(beside(), force=np.tile((newtons, 0.0, 0.0), (11, 1)))
        scene = FlightFilm([panel]).still(0.5)[56:416, 28:508]
        violet = np.abs(scene - 255 * np.array(to_rgb(VIOLET))).max(-1) < 30
        assert violet.sum() > 150
        columns.append(np.nonzero(violet)[1].mean())
    assert columns[0] > 260
    assert columns[1] < 220
    assert count(FlightFilm([following()]).still(0.5)[56:416], VIOLET) == 0


def test_a_force_that_the_target_does_not_tell_is_a_dash():
    known, unknown = beside_with(np.zeros((11, 3))), beside_with(None)
    written = [count(FlightFilm([panel]).still(0.5)[416:], VIOLET) for panel in (known, unknown)]
    assert 0 < written[1] < 0.3 * written[0]  # a dash in place of 0.00 N


def test_outlines_have_the_vehicles_sizes():
    wing = np.concatenate([part.corners for part in vehicle_parts(FixedWing())])
    assert np.ptp(wing[:, 1]) == pytest.approx(1.54)
    rotors = [part.corners[:-1].mean(0) for part in vehicle_parts(Quadrotor()) if len(part.corners) > 8]
    assert len(rotors) == 4
    np.testing.assert_allclose(np.linalg.norm(np.array(rotors)[:, :2], axis=1), 0.2, atol=1e-9)


def test_a_film_is_decoded_as_it_was_drawn(tmp_path: Path):
    panels = [following((0.0, 0.05, 0.0), rows=4)]
    path = tmp_path / "new folder" / "film.mp4"
    done: list[tuple[int, int]] = []
    FlightFilm(panels).write(path, lambda now, total, _: done.append((now, total)))
    reader = imageio_ffmpeg.read_frames(path)
    meta = next(reader)
    reader.close()
    assert meta["codec"] == "h264"
    assert meta["pix_fmt"].startswith("yuv420p")
    assert meta["fps"] == 25
    frames = imageio.imread(path, plugin="FFMPEG")
    assert len(frames) == round((0.3 + 1.5) * 25) + 1
    assert done[-1] == (len(frames), len(frames))
    film = FlightFilm(panels)
    for i in (0, 20, len(frames) - 1):
        drawn = film.still(i * 0.04)
        assert frames[i].shape == drawn.shape
        assert drawn.shape[0] % 2 == drawn.shape[1] % 2 == 0
        assert np.abs(frames[i].astype(float) - drawn).mean() < 2
    assert [entry.name for entry in path.parent.iterdir()] == ["film.mp4"]


def test_a_still_is_a_picture_and_its_end_stands_still(tmp_path: Path):
    panels = [following(), following((0.0, 0.05, 0.0))]
    FlightFilm(panels).write_still(tmp_path / "still.png", 0.6)
    film = FlightFilm(panels)
    with Image.open(tmp_path / "still.png") as picture:
        assert np.array_equal(np.asarray(picture), film.still(0.6))
    assert np.array_equal(film.still(1.0), film.still(9.0))


def test_flights_that_failed_are_marked_as_such_from_then_on():
    state = beside()
    state[6:, 1] = 2.0
    strays = flown(state)
    assert strays.failed == pytest.approx(0.56, abs=0.04)
    lost = following(rows=7, survived=False)
    assert lost.failed == pytest.approx(0.6)
    for panel, before, after in ((strays, 0.4, 0.8), (lost, 0.5, 0.7)):
        banner = slice(60, 120), slice(28, 508)
        film = FlightFilm([following(), panel])
        assert count(film.still(before)[:, 544:][banner], RED) == 0
        still = film.still(after)
        assert count(still[:, 544:][banner], RED) > 2000
        assert count(still[banner], RED) == 0
    missed, hit = reaching(1.3), reaching(0.01)
    assert missed.failed == pytest.approx(missed.passed)
    assert hit.failed is None
    film = FlightFilm([missed, hit])
    assert count(film.still(4.0)[60:120], RED) == 0
    after_it = film.still(4.7)[60:120]
    assert count(after_it[:, :510], RED) > 2000
    assert count(after_it[:, 510:], RED) == 0


def test_a_flight_that_strays_beyond_all_bounds_is_drawn_all_the_same():
    state, panel = beside(), following()
    state[5:, :6] = 1e30
    strayed = flown(state, survived=False, force=np.full((11, 3), 1e30))
    film, other = FlightFilm([strayed, panel]), FlightFilm([panel, panel])
    for t in (0.45, 0.5, 1.0):
        assert film.still(t).shape == other.still(t).shape
    assert film.scales.far == FlightFilm([panel]).scales.far


def test_a_flight_of_one_row_is_a_picture():
    assert FlightFilm([following(rows=1)]).still(0.0).ndim == 3


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: FlightFilm([]).still(0.0), "at least one panel"),
        (lambda: FlightFilm([following(), reaching(0.1)]).still(0.0), "film them apart"),
        (lambda: following(rows=12), "12 rows, its reference only 11"),
        (
            lambda: FlightPanel("a", following().run, Quadrotor(), cast(FlightTask, object()), torch.zeros(2)),
            "no picture is known of a task object",
        ),
        (lambda: flown(np.zeros((3, 4))), "no states of a quadrotor"),
    ],
)
def test_bad_input_is_one_clear_line(make, says: str):
    with pytest.raises(ValueError, match=says) as caught:
        make()
    assert "\n" not in str(caught.value)


@pytest.mark.skipif(not hasattr(resource, "RLIMIT_FSIZE"), reason="needs a limit on the size of files")
def test_a_disk_that_fills_up_leaves_the_old_film(tmp_path: Path):
    """A limit on the size of a file stands for a full disk: ffmpeg is stopped in the middle of writing."""
    old = tmp_path / "film.mp4"
    old.write_bytes(b"the film of yesterday")
    film = FlightFilm([following(rows=1)])
    said = error_on_a_full_disk(lambda: film.write(old))
    assert "was not written" in said
    assert len(said.strip().splitlines()) == 1
    assert old.read_bytes() == b"the film of yesterday"
    assert list(tmp_path.iterdir()) == [old]
